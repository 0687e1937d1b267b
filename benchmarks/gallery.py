"""The gallery: every method on scenes that may be shown, in the light of rendered towns. Pictures, figures and the page.

    python -m benchmarks gallery RUN ... [--output docs/gallery] [--shared DIR] [any field]

References are towns of another seed. Photographs of --shared may give a style too; they themselves are never written.
"""

import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from fprf.checks import at_least
from fprf.cli.parsing import parse
from fprf.errors import FprfError
from fprf.io.atomic import write_text
from fprf.io.images import write_image
from fprf.plugins.encoders.config import BundledSemanticConfig, EncoderConfig
from fprf.training.loading import Trained, load_run

from . import style_runs
from .common import ROOT, SHARED
from .pictures import sheet
from .restyle import STYLIZERS
from .style_runs import PLAIN, Row, mean_rows
from .styles import judges, observer, say

SETS = (("autumn",), ("winter",), ("sunset",), ("night",), ("autumn", "night"))
LICENCES = {
    "town": "rendered by this project",
    "street_lund": "photographs of OpenSfM's `data/lund` (Mapillary, BSD 2-Clause)",
}
ABOUT = {
    PLAIN: "the trained scene as it is",
    "reinhard": "colour transfer of each view alone (Reinhard et al. 2001)",
    "histogram": "histogram matching of each view alone",
    "adain": "one mean and deviation for the whole scene",
    "local-adain": "the paper: every point mixes the local styles that its semantics resemble",
    "region-ot": "scene regions match local styles, all channels at once",
    "region-tone": "half of the features' change, channel by channel, then each region's colours carried over; the default",
}


@dataclass(frozen=True, kw_only=True)
class GalleryConfig:
    """What is shown."""

    runs: tuple[Path, ...] = ()
    """Trained runs, of scenes that may be shown."""
    shared: Path = SHARED
    """Folder with data/styles and weights; what is absent is skipped."""
    semantic: EncoderConfig = BundledSemanticConfig()
    """Finds the regions that methods are judged in, where DeepLab's weights are absent."""
    photographs: tuple[str, ...] = ("dusk_city", "snow_avenue")
    """Photographs of data/styles whose style is shown on scenes that are no towns."""
    view: float = 0.4
    """Which view is shown, as a share of the capture, in [0, 1)."""
    longest: int = 320
    """Longer side of a picture."""
    output: Path = ROOT / "docs/gallery"
    """Folder of the page."""

    def __post_init__(self) -> None:
        at_least("longest", self.longest, 64)


def page(sections: list[str]) -> str:
    methods = "\n".join(f"| {name} | {text} |" for name, text in ABOUT.items())
    intro = (
        "# Gallery\n\nEvery method on the same view. The references are other towns, in another light; where "
        "a photograph gave the style it is not shown. *structure*: what is left of the picture's own structure, 1 = all of it. "
        "*style distance*: to the reference, region by region, 1 = no change, 0 = its statistics. Made by "
        "`python -m benchmarks gallery RUN ...`.\n\n| method | |\n|---|---|\n"
    )
    return intro + methods + "\n\n" + "\n".join(sections)


def figures(rows: dict[str, Row]) -> str:
    def cell(value: float | None) -> str:
        return "" if value is None else f"{value:.2f}"

    names = [name for name in rows if name != PLAIN]
    lines = ["| | " + " | ".join(names) + " |", "|---" * (len(names) + 1) + "|"]
    for key, label in (("structure", "structure"), ("style_distance", "style distance")):
        lines.append(f"| {label} | " + " | ".join(cell(rows[name][key]) for name in names) + " |")
    return "\n".join(lines)


def arranged(case: style_runs.Case, photograph: bool) -> list[dict[str, Tensor]]:
    """The pictures in rows: references and what needs no scene, then the stylizers."""
    above = {name: image for name, image in case.row.items() if name not in STYLIZERS}
    if photograph:
        above = {name: image for name, image in above.items() if not name.startswith("reference")}
    return [above, {name: case.row[name] for name in STYLIZERS}]


def gallery(config: GalleryConfig) -> None:
    sections, styles = [], config.shared / "data/styles"
    for root in config.runs:

        def references(trained: Trained, folder: Path) -> Iterator[style_runs.References]:
            yield from style_runs.town_references(SETS, folder)
            if style_runs.town_folder(trained) is None and styles.is_dir():
                yield from style_runs.photographs([[name] for name in config.photographs], styles, config.longest)

        views = [int(config.view * len(load_run(root, "cpu").known.names))]
        cases = list(
            style_runs.contests(
                root,
                references,
                judges(config.shared),
                observer(config.shared, config.semantic),
                views=views,
                longest=config.longest,
                full=False,
                say=say,
            )
        )
        scene = cases[0].scene
        sections.append(f"## {scene}\n\n{LICENCES.get(scene, '')}\n\nMeans over the styles below:\n")
        sections.append(figures(mean_rows(case.rows for case in cases)) + "\n")
        for case in cases:
            photograph = case.style.classes is None
            name = f"{scene}-{case.style.name}.jpg"
            write_image(config.output / name, sheet(arranged(case, photograph), height=round(config.longest * 0.75)))
            told = "a photograph, not shown" if photograph else "shown first"
            sections.append(
                f"### {case.style.name} ({told})\n\n![{scene}, {case.style.name}]({name})\n\n{figures(case.rows)}\n"
            )
    write_text(config.output / "README.md", page(sections))


def main(argv: list[str]) -> int:
    torch.set_num_threads(1)
    roots = []
    args = argv
    while args and not args[0].startswith("-"):
        roots.append(Path(args.pop(0)))
    try:
        gallery(
            replace(
                parse(GalleryConfig(), args, prog="python -m benchmarks gallery", description=__doc__ or ""), runs=tuple(roots)
            )
        )
    except FprfError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0
