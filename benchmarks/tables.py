"""Write the tables of the documents from the results, between `<!-- table: NAME -->` and `<!-- end -->`, and
a drawing.

    python -m benchmarks tables [--check]

`--check` writes nothing, and ends with 1 where a page is not as the results are.
"""

import argparse
import json
import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from .curves import drawing

RESULTS = Path(__file__).resolve().parent / "results"
DOCS = RESULTS.parents[1] / "docs"
CURVES = DOCS / "images" / "minutes.svg"
PLACE = re.compile(r"(<!-- table: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)
Rows = Iterable[Iterable[str]]


def splat_training(found: Any) -> Rows:
    """Training of Gaussians in the fewest, the most, and five minutes: what was planned, and how near it
    comes.
    """
    yield "capture", "size", "minutes", "steps", "Gaussians", "PSNR", "SSIM", "LPIPS", "memory"
    minutes = {
        name: float(re.findall(r"--minutes ([\d.]+)|$", row["command"])[0] or 0)
        for name, row in found.items()
    }
    for name, row in found.items():
        beside = [minutes[other] for other in found if found[other]["scene"] == row["scene"]]
        if minutes[name] not in (min(beside), 5.0, max(beside)):
            continue
        yield (
            row["scene"],
            row["size"],
            f"{minutes[name]:g}" if minutes[name] else "",
            str(row["steps"]),
            str(row["gaussians"]),
            f"{row['psnr']:.2f} dB",
            f"{row['ssim']:.3f}",
            f"{row['lpips']:.3f}",
            "not measured" if row["peak_rss_mib"] is None else f"{row['peak_rss_mib']:.0f} MiB",
        )


def training_steps(found: Any) -> Rows:
    """What a step of training Gaussians costs."""
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


TABLES: Mapping[str, Callable[[Any], Rows]] = {
    "splat_training": splat_training,
    "training_steps": training_steps,
    "methods": methods,
    "restyle_town_gaussians": restyle_town_gaussians,
    "splat_restyle": splat_restyle,
}


def markdown(rows: Rows) -> str:
    """A table whose first row is its head; columns but the first are aligned to the right."""
    head, *rest = [list(row) for row in rows]
    return "".join(
        "| " + " | ".join(line) + " |\n" for line in [head, ["---", *["---:"] * (len(head) - 1)], *rest]
    )


def filled(page: str, results: Path = RESULTS) -> str:
    """A page with its tables made anew."""

    def table(place: re.Match[str]) -> str:
        found = json.loads((results / f"{place[2]}.json").read_text("utf-8"))
        return place[1] + markdown(TABLES[place[2]](found)) + place[3]

    return PLACE.sub(table, page)


def drawn(results: Path = RESULTS) -> str:
    """The drawing of `docs/images/minutes.svg`."""
    return drawing(json.loads((results / "splat_training.json").read_text("utf-8")))


def main(argv: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks tables", description=__doc__)
    parser.add_argument("--check", action="store_true", help="write nothing; end with 1 where a page differs")
    asked = parser.parse_args(argv)
    made = {path: filled(path.read_text("utf-8")) for path in sorted(DOCS.glob("*.md"))} | {CURVES: drawn()}
    old = [path for path, text in made.items() if not path.is_file() or path.read_text("utf-8") != text]
    for path in old:
        print(path.name)
        if not asked.check:
            path.write_text(made[path], "utf-8")
    return int(asked.check and bool(old))
