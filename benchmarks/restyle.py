"""Every method restyles a town by references of other towns, judged by the town in that light."""

import math
import os
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from fprf.checks import at_least, between, positive
from fprf.cli.parsing import parse
from fprf.errors import ConfigError, UsageError
from fprf.io.images import Picture, to_uint8, write_image
from fprf.methods import fprf_lite
from fprf.plugins import registry
from fprf.plugins.stylizers.config import (
    AdainConfig,
    LocalAdainConfig,
    RegionOtConfig,
    RegionToneConfig,
    StylizerConfig,
)
from fprf.progress import Display
from fprf.scenes import Scene, SceneView
from fprf.style.config import StyleConfig, labels
from fprf.style.dictionary import Encoders, StyleDictionary, build_dictionary, encode_photograph
from fprf.style.files import StyleFile
from fprf.style.restyle import apply_dictionary
from fprf.training.driver import train
from fprf.training.loading import open_run
from fprf.types import Want

from .common import ReportConfig, console, write_report
from .report import Column, contact_sheet, markdown, printed, provenance, words
from .single_image import encoded, flat_look, flat_scene, histogram_matching, reinhard, render_flat
from .steadiness import published, steadiness
from .town.truth import (
    CUT,
    Matched,
    Reference,
    Row,
    Stage,
    best_class_maps,
    code_classes,
    match_rates,
    mean_rows,
    photograph,
    places,
    psnr_of_kind,
    score,
    set_stage,
    town_settings,
    true_class_maps,
    true_views,
    winners,
    without,
)
from .town.write import cached_town

PLAIN = "no change"
FLAT = "2d"
"""The recommended stylizer on every picture alone, as if there were no scene."""
GLOBAL = ("reinhard", "histogram", "adain")
"""Rivals of the recommended stylizer: colours of each picture alone, and features without regions."""
STYLIZERS: Mapping[str, StylizerConfig] = {
    "adain": AdainConfig(),
    "local-adain": LocalAdainConfig(),
    "region-ot": RegionOtConfig(),
    "region-tone": RegionToneConfig(),
}
_SHARP = 0.01
"""Relative temperature at which a point takes one code alone."""


@dataclass(frozen=True, kw_only=True)
class RestyleConfig(ReportConfig):
    """Restyling judged by the truth: a town in the light of other towns, against itself in that very
    light.
    """

    run: Path | None = None
    """Run folder, trained on a town (`python -m benchmarks town FOLDER`); none = fprf-lite is trained on one
    first.
    """
    minutes: float = 2.0
    """Training time, where no run is given."""
    palettes: tuple[str, ...] = ("autumn", "winter", "sunset", "night")
    """Lights that are asked for."""
    seeds: tuple[int, ...] = (7, 11, 13)
    """Three other towns, which the references show."""
    views: int = 4
    """Held-out views that are judged."""
    frames: int = 8
    """Frames of the path on which consistency is measured; at least 8, so that there is a pair 7 apart."""
    longest: int = 120
    """Longer side in pixels of views and frames."""
    stylizer: StylizerConfig = RegionToneConfig()
    """The method that is to be recommended."""
    clusters: int = StyleConfig.clusters
    """Style codes per reference, for all methods."""
    blend: float = StyleConfig.blend
    """Share of the overall style in each local one, for all methods, in [0, 1]."""
    missing: tuple[str, ...] = tuple(CUT)
    """Kinds of things that a reference is without, one after the other."""
    sheet: Path | None = None
    """Picture of all methods side by side, .png or .jpg; none = none."""
    device: str = "auto"
    """cpu, cuda, mps, or auto."""

    def __post_init__(self) -> None:
        positive("minutes", self.minutes)
        at_least("views", self.views, 1)
        at_least("frames", self.frames, 8)
        at_least("longest", self.longest, 16)
        at_least("clusters", self.clusters, 1)
        between("blend", self.blend, 0.0, 1.0)
        at_least("palettes", len(self.palettes), 1)
        at_least("seeds", len(self.seeds), 3)
        for kind in self.missing:
            if kind not in CUT:
                raise ConfigError(
                    f"missing: {kind!r} is no kind of thing of the town; allowed are {', '.join(CUT)}"
                )


Image = Annotated[Tensor, "H W 3"]
T = TypeVar("T")


class Shown(NamedTuple):
    """One method on the views and frames, given in one list."""

    pictures: list[Image]
    taken: list[Annotated[Tensor, "N T"]] | None
    """Share of each style code in each pixel; None where nothing is matched."""
    style_seconds: float
    """To make the style of the references, encoders included."""
    view_seconds: float
    """To colour one view whose geometry is there already."""


def lineup(recommended: StylizerConfig) -> dict[str, StylizerConfig]:
    """Stylizers by name, the recommended one last; it takes the place of its like."""
    name = registry.name_of(StylizerConfig.group, type(recommended))
    others = {other: config for other, config in STYLIZERS.items() if other != name}
    return {**others, "nearest-code": LocalAdainConfig(temperature=_SHARP), name: recommended}


def dictionary_of(
    paths: Sequence[Path], encoders: Encoders, *, clusters: int, blend: float, masks: Sequence[Path] = ()
) -> tuple[StyleDictionary, float]:
    """The style dictionary of photographs on a scene, or of what masks select of them, and the seconds it
    took.
    """
    start = time.perf_counter()
    photographs = [
        encode_photograph(path, encoders, name=name, mask=mask)
        for path, name, mask in zip(paths, labels(tuple(paths)), masks or (None,) * len(paths), strict=True)
    ]
    made = build_dictionary(photographs, clusters=clusters, blend=blend, seed=encoders.seed)
    return made, time.perf_counter() - start


def nothing(views: Sequence[SceneView]) -> Shown:
    """The scene as it is."""
    pictures, seconds = _each(views, lambda view: view.restyled().rgb)
    return Shown(pictures, None, 0.0, seconds)


def transfers(plain: Sequence[Image], references: Sequence[Image]) -> dict[str, Shown]:
    """Transfers of colour of every picture alone, towards all pixels of all references."""
    style = torch.cat([image.reshape(-1, 3) for image in references])
    shown = {}
    for name, transfer in {"reinhard": reinhard, "histogram": histogram_matching}.items():

        def moved(view: Image, transfer: Callable[[Tensor, Tensor], Tensor] = transfer) -> Image:
            return transfer(view.reshape(-1, 3), style).reshape(view.shape)

        pictures, seconds = _each(plain, moved)
        shown[name] = Shown(pictures, None, 0.0, seconds)
    return shown


def in_scene(
    scene: Scene,
    views: Sequence[SceneView],
    config: StylizerConfig,
    dictionary: StyleDictionary,
    encoders: Encoders,
    paths: Sequence[Path],
    bold: float = StyleConfig.bold,
) -> Shown:
    """A stylizer of the scene."""
    start = time.perf_counter()
    style = StyleConfig(references=tuple(paths), stylizer=config, bold=bold)
    look = apply_dictionary(scene, StyleFile(style), encoders, dictionary).restyle
    spent = time.perf_counter() - start
    pictures, seconds = _each(views, lambda view: view.restyled(look).rgb)
    matched = Want.SEMANTIC in look.stylizer.needs
    return Shown(pictures, [view.paint(look.match) for view in views] if matched else None, spent, seconds)


def one_by_one(
    scene: Scene,
    plain: Sequence[Image],
    config: StylizerConfig,
    dictionary: StyleDictionary,
    encoders: Encoders,
) -> Shown:
    """The stylizer on each picture as a photograph of its own: its own statistics and regions, the same
    dictionary.
    """
    guided = encoders.guided
    decoder = scene.decoder
    regions = len(encoders.scene_style.share)
    seed = encoders.seed
    taken = []

    def restyled(view: Image) -> Image:
        view = view.to(encoders.device)
        semantic = None
        if encoders.semantic is not None:
            semantic = encoded(view, encoders.semantic, guided, encoders.basis)
        size = (view.shape[0], view.shape[1])
        content = view.flatten(0, 1) if decoder is None else encoded(view, encoders.content, guided)
        flat = flat_scene(content, semantic, size, regions=regions, seed=seed)
        look = flat_look(flat, dictionary, config, decoder)
        if semantic is not None:
            taken.append(look.match(semantic).cpu())
        return render_flat(flat, look, decoder).cpu()

    with torch.inference_mode():
        pictures, seconds = _each(plain, restyled)
    return Shown(pictures, taken or None, 0.0, seconds)


def _each(views: Sequence[T], function: Callable[[T], Image]) -> tuple[list[Image], float]:
    """The pictures and the mean seconds of one."""
    start = time.perf_counter()
    pictures = [function(view) for view in views]
    return pictures, (time.perf_counter() - start) / max(1, len(views))


MATCHED = "true classes"
BOUND = "best class maps"
"""No methods: they know classes, or even the truth (see `scores`)."""
GOALS: Mapping[str, tuple[str, float, str, str]] = {
    "over_no_change_db": ("≥", 3.0, "dB", "PSNR over no change"),
    "over_best_global_db": (
        "≥",
        1.5,
        "dB",
        f"PSNR over the best of {GLOBAL[0]}, {GLOBAL[1]} and {GLOBAL[2]}",
    ),
    "over_2d_db": ("≥", 1.5, "dB", "PSNR over itself on single pictures (2d)"),
    "match_inside": ("≥", 0.90, "", "match inside"),
    "consistency": ("≤", 0.05, "", "consistency"),
}
"""Goals of the recommended stylizer with three references: figures with their units, and what they are of."""
JUDGED = "three"

Progress = Callable[[int, int, str], None]


class Case(NamedTuple):
    """One palette with one set of references."""

    light: str
    set: str
    references: list[Reference]
    truth: list[Tensor]
    shown: dict[str, list[Tensor]]
    """The judged views by method."""
    rows: dict[str, Row]
    classes: dict[str, dict[str, float]]
    """ΔE2000 by method and class."""


def restyle(
    config: RestyleConfig, root: Path, folder: Path, progress: Progress
) -> tuple[dict[str, Any], list[Case]]:
    """The document and the cases. `folder` takes the references' files."""
    opened = open_run(root, config.device)
    trained = opened.run.load_config()[0]
    scene = opened.scene
    settings = town_settings(trained)
    stage = set_stage(
        scene, opened.known, settings, views=config.views, frames=config.frames, longest=config.longest
    )
    encoders = scene.encoders()
    results = cases(config, stage, encoders, folder, progress)
    missing = without_kinds(config, stage, encoders, folder, progress) if config.missing else {}
    sets = dict.fromkeys(case.set for case in results)
    means = {name: mean_rows([case.rows for case in results if case.set == name]) for name in sets}
    best = list(lineup(config.stylizer))[-1]
    plain = [view.restyled().rgb for view in stage.shown]
    document = {
        "benchmark": "restyle",
        "settings": {
            "method": opened.method,
            "trained_steps": opened.step,
            "train_seconds": round(opened.seconds, 1),
            "town_seed": settings.seed,
            "trained_palette": settings.palette,
            "trained_size": [settings.width, settings.height],
            "reference_seeds": list(config.seeds),
            "seed": trained.seed,
            "views": len(stage.views),
            "frames": len(stage.path),
            "view_size": [int(side) for side in stage.views.size[0]],
            "clusters": config.clusters,
            "blend": config.blend,
            "regions": len(encoders.scene_style.share),
            "semantic_encoder": scene.semantic_encoder,
        },
        "recommended": best,
        "reconstruction": score(
            plain, true_views(stage, settings.palette), [each.labels for each in stage.truth]
        )[0],
        "means": means,
        "verdict": verdict(means[JUDGED], best),
        "missing": missing,
        "palettes": {
            light: {
                case.set: {"rows": case.rows, "delta_e_by_class": case.classes}
                for case in results
                if case.light == light
            }
            for light in config.palettes
        },
    }
    return document, results


def restyle_sheet(found: Sequence[Case]) -> Picture:
    """A row for each palette: three references, the truth, the first view by every method."""
    rows = [case for case in found if case.set == JUDGED]
    columns = [*("reference" for _ in rows[0].references), "truth", *rows[0].shown]
    pictures = {
        case.light: [
            *(r.image for r in case.references),
            case.truth[0],
            *(views[0] for views in case.shown.values()),
        ]
        for case in rows
    }
    return contact_sheet(pictures, columns, height=min(120, rows[0].truth[0].shape[0]))


def cases(
    config: RestyleConfig, stage: Stage, encoders: Encoders, folder: Path, progress: Progress
) -> list[Case]:
    """Every palette with every set of references. Raises UsageError for references that would show the run's
    own town.
    """
    if stage.settings.seed in config.seeds:
        raise UsageError(
            f"--seeds: {stage.settings.seed} is the town of the run itself; references show other towns"
        )
    width, height = (int(side) for side in stage.scene.cameras.size[0])
    chosen = places(config.seeds, (width, height))
    total = len(config.palettes) * len(chosen)
    results: list[Case] = []
    for light in config.palettes:
        truth = true_views(stage, light)
        for name, where in chosen.items():
            progress(len(results), total, f"restyling, {light}")
            references = [photograph(place, light) for place in where]
            paths = [folder / f"{name}-{reference.name}.png" for reference in references]
            for path, reference in zip(paths, references, strict=True):
                write_image(path, to_uint8(reference.image))
            results.append(_case(config, stage, encoders, (light, name), references, paths, truth))
    progress(total, total, "restyling")
    return results


PAINTED = "paint alone"
LIT = "light or paint"
"""The recommended stylizer with `bold` 1, and as it is."""


def without_kinds(
    config: RestyleConfig, stage: Stage, encoders: Encoders, folder: Path, progress: Progress
) -> dict[str, dict[str, dict[str, Row]]]:
    """PSNR inside and elsewhere by kind that is masked out of the one reference, by palette and method; and
    their means.
    """
    width, height = (int(side) for side in stage.scene.cameras.size[0])
    place = places(config.seeds, (width, height))["one"][0]
    found: dict[str, dict[str, dict[str, Row]]] = {kind: {} for kind in config.missing}
    for number, light in enumerate(config.palettes):
        progress(number, len(config.palettes), f"references that lack something, {light}")
        truth = true_views(stage, light)
        reference = photograph(place, light)
        path = folder / f"{reference.name}.png"
        write_image(path, to_uint8(reference.image))
        for kind in config.missing:
            mask = folder / f"{reference.name}-without-{kind}.png"
            write_image(mask, to_uint8(without(reference, kind).float()[..., None].expand(-1, -1, 3)))
            dictionary, _ = dictionary_of(
                [path], encoders, clusters=config.clusters, blend=config.blend, masks=[mask]
            )
            shown = {PLAIN: nothing(stage.shown).pictures}
            for name, bold in ((PAINTED, 1.0), (LIT, StyleConfig.bold)):
                made = in_scene(stage.scene, stage.shown, config.stylizer, dictionary, encoders, [path], bold)
                shown[name] = made.pictures
            found[kind][light] = {
                name: psnr_of_kind(views, stage, truth, kind) for name, views in shown.items()
            }
    rows = [row for lights in found.values() for row in lights.values()]
    return {**found, "mean": {"all palettes": mean_rows(rows)}}


def verdict(rows: Mapping[str, Row], best: str) -> dict[str, Any]:
    """Figures of the recommended stylizer beside GOALS."""
    ours = rows[best]
    baseline = max(GLOBAL, key=lambda name: rows[name]["psnr"] or -math.inf)
    reached = {
        "over_no_change_db": _less(ours["psnr"], rows[PLAIN]["psnr"]),
        "over_best_global_db": _less(ours["psnr"], rows[baseline]["psnr"]),
        "over_2d_db": _less(ours["psnr"], rows[FLAT]["psnr"]),
        "match_inside": ours["match_inside"],
        "consistency": ours["consistency"],
    }
    met = {
        name: None if (value := reached[name]) is None else value <= goal if sign == "≤" else value >= goal
        for name, (sign, goal, _, _) in GOALS.items()
    }
    return {
        "goals": {name: goal for name, (_, goal, _, _) in GOALS.items()},
        "reached": reached,
        "met": met,
        "best_global": baseline,
    }


def _case(
    config: RestyleConfig,
    stage: Stage,
    encoders: Encoders,
    names: tuple[str, str],
    references: list[Reference],
    paths: Sequence[Path],
    truth: list[Tensor],
) -> Case:
    scene = stage.scene
    views = [*stage.shown, *stage.passed]
    dictionary, spent = dictionary_of(paths, encoders, clusters=config.clusters, blend=config.blend)
    stylizers = lineup(config.stylizer)
    best = list(stylizers)[-1]
    found = {PLAIN: nothing(views)}
    plain = found[PLAIN].pictures
    found |= transfers(plain, [reference.image for reference in references])
    found[FLAT] = one_by_one(scene, plain, config.stylizer, dictionary, encoders)
    for name, stylizer in stylizers.items():
        found[name] = in_scene(scene, views, stylizer, dictionary, encoders, paths)
    known = {path.name: reference for path, reference in zip(paths, references, strict=True)}
    classes = code_classes(dictionary, known, encoders, encoders.guided)
    count = len(stage.shown)
    rows = {}
    by_class = {}
    shown = {name: each.pictures[:count] for name, each in found.items()}
    labels = [each.labels for each in stage.truth]
    known_plain = list(zip(plain[:count], labels, strict=True))
    shown[MATCHED] = true_class_maps(
        known_plain, [(reference.image, reference.classes) for reference in references]
    )
    shown[BOUND] = best_class_maps(known_plain, truth)
    for name in [*(each for each in shown if each != best), best]:
        rows[name], by_class[name] = score(shown[name], truth, labels)
        rows[name] |= _rest(stage, found.get(name), plain[count:], classes, references, spent)
    return Case(*names, references, truth, {name: shown[name] for name in rows}, rows, by_class)


PUBLISHED = {f"{gap}_{figure}": (gap, figure) for gap in ("short", "long") for figure in ("lpips", "rmse")}
"""Figures of `steadiness.published` by their names in a row."""
SECONDS = ("style_seconds", "view_seconds")


def _rest(
    stage: Stage,
    method: Shown | None,
    plain_path: Sequence[Tensor],
    classes: Tensor,
    references: Sequence[Reference],
    spent: float,
) -> Row:
    """Match rates, consistency and seconds; None where a method has none."""
    row: Row = dict.fromkeys(
        (*Matched._fields, "consistency", "warp_short", "warp_long", *PUBLISHED, *SECONDS)
    )
    if method is None:
        return row
    count = len(stage.shown)
    if method.taken is not None:
        truth = [each.labels for each in stage.truth]
        taken = [
            winners(share, classes).view(like.shape)
            for share, like in zip(method.taken[:count], truth, strict=True)
        ]
        row |= match_rates(taken, truth, references)._asdict()
        row["style_seconds"] = method.style_seconds + spent
    depths = [each.depth for each in stage.path_truth]
    steady = steadiness(plain_path, method.pictures[count:], depths, stage.path)
    row |= {"consistency": steady.score, "warp_short": steady.short, "warp_long": steady.long}
    reported = published(method.pictures[count:], depths, stage.path)
    row |= {name: reported[gap][figure] for name, (gap, figure) in PUBLISHED.items()}
    row["view_seconds"] = method.view_seconds
    return row


def _less(a: float | None, b: float | None) -> float | None:
    return None if a is None or b is None else a - b


COLUMNS: tuple[Column, ...] = (
    ("psnr", "PSNR dB", ".2f"),
    ("ssim", "SSIM", ".3f"),
    ("lpips", "LPIPS", ".3f"),
    ("delta_e", "ΔE2000", ".1f"),
    ("match", "match", ".1%"),
    ("match_inside", "match inside", ".1%"),
    ("match_kind", "match kind", ".1%"),
    ("consistency", "consistency", ".3f"),
    ("style_seconds", "style s", ".2f"),
    ("view_seconds", "view s", ".3f"),
)
LACKING: tuple[Column, ...] = (("inside", "PSNR inside, dB", ".2f"), ("elsewhere", "elsewhere, dB", ".2f"))
_ABOUT = """# Restyling with a true answer

Nobody knows what a photographed scene would look like at night. Of a rendered town we know: a palette changes colours and
light and nothing else. A scene is trained on one town in one palette; references are pictures of *other* towns in another
palette; the truth is the scene's own town rendered in that palette from the same, held-out cameras.

`one` reference is a view along a street. `three` are pictures of three towns: one shows mostly façades, one mostly plants, one
the street and its sky.

- **PSNR, SSIM, ΔE2000** against the truth. The scene as it is, against its own palette, is the line *reconstruction*: a style
  cannot be sharper than the render that it changes.
- **match**: pixels that take most of a style code of their own true class (12 classes; a code's class is that of most pixels
  that it was made of). **match inside**: the same without pixels at the border of two classes. **match kind**: of their own
  kind (sky, plants, ground, buildings, lamps, cars).
- **consistency**: what a method adds to the error between frames of a path, warped by true depth, plus the sharpness that it
  loses; 0 = as steady and sharp as the unstylised render (`fprf/evaluation/metrics.py`).
- **style s**: to make the style of the references, once. **view s**: to colour a view whose geometry is there (for `reinhard`,
  `histogram` and `2d`: a rendered picture).
- **LPIPS**: AlexNet, version 0.1, to the truth; less is nearer. The JSON also has consistency as other papers report it
  (`short_lpips`, `short_rmse`, `long_lpips`, `long_rmse`: `published` in `benchmarks/steadiness.py`).
- **2d** is the recommended stylizer on each picture alone, with the picture's own statistics and regions.
- **true classes** is no method: it knows the classes, and carries the colours of each to those of the same class in the
  references, as a perfect match would.
- **without sky, plants, ground, houses**: one reference out of which a kind of thing is masked. *Paint alone* paints it with
  what is least unlike it; *light or paint* gives it the light of the reference (docs/method.md).
- **best class maps** is none either: it knows the truth, and gives every true class the affine map of colours that comes
  nearest to it. What it misses is light: shadows, lit windows and the lamps' cones lie where the town's geometry puts them,
  another town's picture cannot tell where, and no map of colours makes them.
"""
_USE = """## Use it for another system

`python -m benchmarks restyle RUN --output restyle.json --page restyle.md --sheet restyle.jpg` makes all of this again. The
town in any palette is a scene folder that `python -m benchmarks town FOLDER --palette night` writes. Another system's frames
of the same cameras are scored by `python -m benchmarks peer`
([protocol.md](protocol.md)).
"""


def restyle_page(document: Mapping[str, Any], *, picture: str | None = None) -> str:
    """Markdown; `picture` is the sheet's path as the page should name it."""
    settings = document["settings"]
    parts = [_ABOUT]
    lights = ", ".join(document["palettes"])
    size = "x".join(str(side) for side in settings["view_size"])
    parts.append(
        f"Town {settings['town_seed']} in palette {settings['trained_palette']}, {settings['method']}, "
        f"{settings['trained_steps']} steps in {settings['train_seconds']:.0f} s; palettes {lights}; references of towns "
        f"{', '.join(map(str, settings['reference_seeds']))}; {settings['views']} held-out views and "
        f"{settings['frames']} frames of {size}; seed {settings['seed']}. {words(document['provenance'])}.\n"
    )
    parts += [_verdict(document), ""]
    for name, rows in document["means"].items():
        parts += [
            f"## Mean over palettes, {name} reference{'s' * (name != 'one')}\n",
            markdown(rows, COLUMNS, first="method"),
            "",
        ]
    for kind, lights in document["missing"].items():
        rows = mean_rows(list(lights.values()))
        heading = "any of them (mean)" if kind == "mean" else kind
        parts += [
            f"## One reference without {heading}, mean over palettes\n",
            markdown(rows, LACKING, first="method"),
            "",
        ]
    own = document["reconstruction"]
    parts.append(f"Reconstruction: {own['psnr']:.2f} dB, SSIM {own['ssim']:.3f}, ΔE {own['delta_e']:.1f}.\n")
    if picture:
        parts.append(f"![all methods, one view of each palette, three references]({picture})\n")
    parts.append("## By palette\n")
    for light, sets in document["palettes"].items():
        for name, images in sets.items():
            parts += [f"### {light}, {name}\n", markdown(images["rows"], COLUMNS, first="method"), ""]
    parts += ["## ΔE2000 by class, three references, mean over palettes\n", _by_class(document), "", _USE]
    return "\n".join(parts)


def _verdict(document: Mapping[str, Any]) -> str:
    judged = document["verdict"]
    lines = [
        f"Recommended: `{document['recommended']}`; the best global baseline is `{judged['best_global']}`.\n"
    ]
    lines += ["| with three references | reached | goal | |", "|---|---:|---:|---|"]
    for name, (sign, _, unit, label) in GOALS.items():
        reached = judged["reached"][name]
        met = judged["met"][name]
        value = "–" if reached is None else f"{reached:.3g} {unit}".strip()
        verdict = {None: "not known", True: "met", False: "**not met**"}[met]
        lines.append(f"| {label} | {value} | {sign} {judged['goals'][name]:g} {unit} | {verdict} |")
    return "\n".join(lines)


def _by_class(document: Mapping[str, Any]) -> str:
    tables = [sets["three"]["delta_e_by_class"] for sets in document["palettes"].values()]
    methods = list(tables[0])
    kinds = list(tables[0][next(iter(tables[0]))])
    rows = {
        method: {kind: sum(t[method][kind] for t in tables) / len(tables) for kind in kinds}
        for method in methods
    }
    return markdown(rows, [(kind, kind, ".1f") for kind in kinds], first="method")


def main(argv: list[str]) -> int:
    """`python -m benchmarks restyle [RUN]`."""
    about = (RestyleConfig.__doc__ or "").strip()
    config = parse(
        RestyleConfig(), argv, prog="python -m benchmarks restyle", description=about, positional=("run",)
    )
    with tempfile.TemporaryDirectory(prefix="fprf-restyle-") as made:
        root = config.run
        if root is None:
            run = Path(made) / "run"
            town = replace(
                fprf_lite(), data=cached_town(), output=run, minutes=config.minutes, device=config.device
            )
            root = train(town, "fprf-lite")
        with Display() as display:
            document, found = restyle(config, root, Path(made), display.count)
    document["provenance"] = provenance(config.device)
    for name, rows in document["means"].items():
        console().print(
            printed(f"mean over {len(config.palettes)} palettes, references: {name}", rows, COLUMNS)
        )
    picture = None
    if config.sheet is not None:
        write_image(config.sheet, restyle_sheet(found))
        if config.page is not None:
            picture = Path(os.path.relpath(config.sheet, config.page.parent)).as_posix()
    write_report(config, document, lambda: restyle_page(document, picture=picture))
    return 0
