"""Write what the documents take from the results: tables between `<!-- table: NAME -->` and `<!-- end -->`, links between
`<!-- of: NAME -->` and `<!-- end -->`, and a drawing. Both say what a result is older than.

    python -m benchmarks tables [--check] [--before CHANGE]

`--check` writes nothing, and ends with 1 where a page is not as the results are. A result whose sources have changed is
refused: measure it again (`python -m benchmarks record NAME`), or say by `--before` what has changed.
"""

import argparse
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from fprf.errors import UsageError
from fprf.io.atomic import write_json

from .curves import SCENES, drawing
from .evidence import DERIVED, OF, ROOT, document, link, pages, read_result, result_files, stale

CURVES = ROOT / "docs" / "images" / "minutes.svg"
PLACE = re.compile(r"(<!-- table: (\w+)(?: of (\w+))? -->\n).*?(<!-- end -->)", re.DOTALL)
"""`NAME`, or `NAME of RESULT` where they differ."""
Rows = Iterable[Iterable[str]]
_SHORT = 5.0
"""Minutes up to which `minutes` has the captures of the drawing."""


def splat_training(found: Any) -> Rows:
    """Training of Gaussians with other poses, of other captures, and for longer than `minutes`: what was planned,
    and how near it comes.
    """
    yield "capture", "size", "minutes", "steps", "Gaussians", "PSNR", "SSIM", "LPIPS", "memory"
    given = {
        name: float(re.findall(r"--minutes ([\d.]+)|$", row["command"])[0] or 0)
        for name, row in found.items()
    }
    for name, row in found.items():
        longest = max(given[other] for other in found if found[other]["scene"] == row["scene"])
        shown = given[name] == longest or (given[name] == _SHORT and "own-poses" in name)
        if not shown or (row["scene"] in SCENES and given[name] <= _SHORT):
            continue
        yield (
            row["scene"],
            row["size"],
            f"{given[name]:g}" if given[name] else "",
            str(row["steps"]),
            str(row["gaussians"]),
            f"{row['psnr']:.2f} dB",
            f"{row['ssim']:.3f}",
            f"{row['lpips']:.3f}",
            "not measured" if row["peak_rss_mib"] is None else f"{row['peak_rss_mib']:.0f} MiB",
        )


def training_steps(found: Any) -> Rows:
    """Cost of a step of training Gaussians."""
    yield "photograph", "Gaussians", "a step", "Gaussians and a step", "a photograph"
    for row in found["steps"]:
        size = "x".join(map(str, row["size"]))
        told = f"{row['mib']:.0f} MiB", f"{row['mib_of_a_photograph']:.0f} MiB"
        yield size, str(row["gaussians"]), f"{1000 * row['seconds']:.0f} ms", *told


def methods(found: Any) -> Rows:
    """The two methods for a CPU on captures; the better one is bold."""
    yield "capture", "photographs", "size", "`fprf-splats`", "`fprf-lite`"
    for scene, row in found.items():
        pair = [row["fprf-splats"], row["fprf-lite"]]
        bold = ["**" if each["psnr"] == max(other["psnr"] for other in pair) else "" for each in pair]
        told = [
            f"{mark}{each['psnr']:.2f} dB{mark}, {each['ssim']:.3f}"
            for mark, each in zip(bold, pair, strict=True)
        ]
        yield scene, str(row["training_views"]), "x".join(map(str, row["size"])), *told


def minutes(found: Any) -> Rows:
    """Captures against minutes of training."""
    yield "capture", "size", "minutes", "steps", "Gaussians", "PSNR", "SSIM", "LPIPS", "memory"
    for row in found.values():
        psnr = f"{row['psnr']:.2f} dB"
        if "psnr_fitted_poses" in row:
            psnr += f" ({row['psnr_fitted_poses']:.2f} dB)"
        yield (
            row["scene"],
            row["size"],
            f"{row['minutes']:g}",
            str(row["train_steps"]),
            str(row["gaussians"]),
            psnr,
            f"{row['ssim']:.3f}",
            f"{row['lpips']:.3f}",
            "not measured" if row["peak_rss_mib"] is None else f"{row['peak_rss_mib']:.0f} MiB",
        )


def restyle_town_gaussians(found: Any) -> Rows:
    """Restyled town against its truth, with one and with three references."""
    yield (
        "style",
        "one: over no change",
        "LPIPS",
        "right class inside",
        "three: over no change",
        "LPIPS",
        "right class inside",
    )
    ways = [found["means"][many] for many in ("one", "three")]
    for name in ways[0]:
        cells = []
        for way in ways:
            row = way[name]
            inside = row["match_inside"]
            gained = row["psnr"] - way["no change"]["psnr"]
            cells += [f"{gained:.2f} dB", f"{row['lpips']:.3f}", "" if inside is None else f"{inside:.3f}"]
        yield name, *cells


def splat_restyle(found: Any) -> Rows:
    """Seconds and memory of restyling captures."""
    yield "capture", "Gaussians", "first look", "each further style", "peak memory"
    for row in found["captures"]:
        seconds = [f"{row[key]:.2g} s" for key in ("look_seconds", "style_seconds")]
        yield row["capture"], str(row["gaussians"]), *seconds, f"{row['peak_mib']:.0f} MiB"


def palettes(found: Any) -> Rows:
    """The restyled town light by light, one reference; the best of each row is bold."""
    ways = ["no change", "reinhard", "histogram", "adain", "local-adain", "region-ot", "region-tone"]
    yield "", *ways
    for palette, ran in found["palettes"].items():
        rows = [ran["one"]["rows"][way] for way in ways]
        highest = max(row["psnr"] for row in rows)
        nearest = min(row["lpips"] for row in rows)
        cells = []
        for row in rows:
            psnr = "**" if row["psnr"] == highest else ""
            lpips = "**" if row["lpips"] == nearest else ""
            cells.append(f"{psnr}{row['psnr']:.2f}{psnr}, {lpips}{row['lpips']:.3f}{lpips}")
        yield palette, *cells


def cells(found: Any) -> Rows:
    """Gaussians in one piece and in cells, and blocks of fields."""
    yield (
        "capture",
        "one piece",
        "cells",
        "blocks of `fprf-lite`",
        "error at cell borders over that elsewhere",
    )
    for scene, row in found.items():
        ways = [row[way]["psnr"] for way in ("one_piece", "in_cells", "fprf_lite_blocks")]
        ratio = row["in_cells"]["border_error_over_inside"]
        yield (
            scene,
            *(f"**{psnr:.2f} dB**" if psnr == max(ways) else f"{psnr:.2f} dB" for psnr in ways),
            f"{ratio:.2f}",
        )


ENCODERS = {
    "bundled-semantic": "`bundled-semantic`",
    "concat": "`bundled-semantic` and `dinov2`: the default",
    "vgg19": "`vgg19`",
}
"""Rows of the table of encoders: how each begins in the result, and what it is called in the page."""


def semantic_matching(found: Any) -> Rows:
    """Encoders that fprf ships."""
    yield "encoder", "triplets", "town"
    for row in found["rows"]:
        told = ENCODERS.get(row["encoder"].partition(":")[0])
        if told:
            yield told, f"{row['triplets']['matching']:.3f}", f"{row['town']['match']:.3f}"


def gpu(found: Any) -> Rows:
    """Quality after a minute of a GPU, beside the goal."""
    yield "method", "PSNR", "goal", "SSIM", "LPIPS"
    goals = {row["name"]: row.get("goal") for row in found["rows"]}
    for method, name in (("fprf-splats", "held-out PSNR of 3D Gaussians"), ("fprf", "held-out PSNR")):
        row = found["metrics"][method]
        goal = "" if goals[name] is None else f"{goals[name]:.0f} dB"
        if goals[name] is not None and row["psnr"] < goals[name]:
            goal += ": missed"
        yield f"`{method}`", f"{row['psnr']:.1f} dB", goal, f"{row['ssim']:.3f}", f"{row['lpips']:.3f}"


FASTER = {
    "train": "training with all features",
    "render": "rendering",
    "stylised, region-tone": "restyled rendering, `region-tone`",
    "stylised, region-ot": "restyled rendering, `region-ot`",
    "stylised, local-adain": "restyled rendering, `local-adain`",
    "cached view restyled, region-tone": "a cached view in another style",
}
"""Rows of the table of speed: names in the result, and in the page."""


def speed_fox(found: Any) -> Rows:
    """Fields against plain torch without skipping, in one run."""
    yield "fox at half its size", "fprf", "plain torch", "ratio", "largest error, or of the gradient"
    for row in found["rows"]:
        if row["name"] in FASTER:
            ours, plain = (
                f"{row[key]:.3g} ms" if row["unit"] == "ms" else f"{row[key]:.0f} {row['unit']}"
                for key in ("figure", "peer")
            )
            yield FASTER[row["name"]], ours, plain, f"{row['ratio']:.1f}", f"{row['error']:.2g}"


TABLES: Mapping[str, Callable[[Any], Rows]] = {
    "cells": cells,
    "gpu": gpu,
    "semantic_matching": semantic_matching,
    "speed_fox": speed_fox,
    "splat_training": splat_training,
    "training_steps": training_steps,
    "methods": methods,
    "minutes": minutes,
    "palettes": palettes,
    "restyle_town_gaussians": restyle_town_gaussians,
    "splat_restyle": splat_restyle,
}


def markdown(rows: Rows) -> str:
    """A table whose first row is its head; columns but the first are aligned to the right."""
    head, *rest = [list(row) for row in rows]
    return "".join(
        "| " + " | ".join(line) + " |\n" for line in [head, ["---", *["---:"] * (len(head) - 1)], *rest]
    )


def filled(path: Path, root: Path = ROOT) -> str:
    """A page with its tables and links to results made anew."""
    results = result_files(root)

    def table(place: re.Match[str]) -> str:
        origin, found = read_result(results[place[3] or place[2]])
        found.pop(DERIVED, None)
        below = f"\n*{origin.mark[:1].upper()}{origin.mark[1:]}.*\n\n" if origin.mark else ""
        return place[1] + markdown(TABLES[place[2]](found)) + below + place[4]

    def quoted(place: re.Match[str]) -> str:
        return f"<!-- of: {place[1]} -->{link(place[1], path, root)}<!-- end -->"

    return OF.sub(quoted, PLACE.sub(table, path.read_text("utf-8")))


def drawn(root: Path = ROOT) -> str:
    """The drawing of `docs/images/minutes.svg`."""
    _, found = read_result(result_files(root)["minutes"])
    found.pop(DERIVED, None)
    return drawing(found)


def mark(change: str, root: Path = ROOT) -> list[str]:
    """Say in every result whose sources have changed unsaid that it is of before a change; without one they are refused.
    Returns their names.
    """
    old = [(name, path) for name, path in result_files(root).items() if stale(read_result(path)[0], root)]
    if old and not change:
        names = ", ".join(name for name, _ in old)
        raise UsageError(
            f"{names}: sources have changed since; measure again (python -m benchmarks record NAME), "
            'or say what has changed (python -m benchmarks tables --before "CHANGE")'
        )
    for _, path in old:
        origin, found = read_result(path)
        write_json(path, document(replace(origin, before=change), found))
    return [name for name, _ in old]


def main(argv: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks tables", description=__doc__)
    parser.add_argument("--check", action="store_true", help="write nothing; end with 1 where a page differs")
    parser.add_argument(
        "--before", default="", metavar="CHANGE", help="what has changed since stale results were measured"
    )
    asked = parser.parse_args(argv)
    if not asked.check:
        for name in mark(asked.before):
            print(f"{name}: before {asked.before}")
    made = {path: filled(path) for path in pages()} | {CURVES: drawn()}
    old = [path for path, text in made.items() if not path.is_file() or path.read_text("utf-8") != text]
    for path in old:
        print(path.relative_to(ROOT))
        if not asked.check:
            path.write_text(made[path], "utf-8")
    return int(asked.check and bool(old))
