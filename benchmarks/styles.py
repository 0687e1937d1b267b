"""Restyling side by side: every stylizer, and transfers of colour alone, on painted photographs and on trained runs.

    python benchmarks/styles.py [RUN ...] [--shared DIR] [--sheets DIR] [--output JSON] [any field]

structure, ssim: kept of the unstylised picture, 1 = all of it. style_distance: to the references, region by region, 1 = no
change, in the eyes of VGG-19, which no shipped part of the product uses. consistency: warp error between neighbouring views.
Sheets show other people's photographs: they are written only where asked for.
"""

import json
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import style_runs
import style_triplets
import torch
from sheets import sheet

from fprf.checks import at_least
from fprf.cli.parsing import parse
from fprf.errors import FprfError
from fprf.evaluation.contest import GOALS, RECOMMENDED, Row, mean_rows, verdict
from fprf.interfaces import Encoder
from fprf.io.atomic import write_json
from fprf.io.images import write_image
from fprf.plugins.encoders.config import BundledContentConfig, BundledSemanticConfig, EncoderConfig, RandomConfig, Vgg19Config
from fprf.plugins.encoders.segmenter_config import DeepLabConfig

HERE = Path(__file__).resolve().parents[1]
LAYERS = ("relu1_1", "relu2_1", "relu3_1")
COLUMNS = ("structure", "ssim", "style_distance", "full_distance", "consistency_rmse", "consistency_relative")
SHEET_ROWS = 12


@dataclass(frozen=True, kw_only=True)
class StylesConfig:
    """What is compared, and by whom it is judged."""

    runs: tuple[Path, ...] = ()
    """Trained runs."""
    shared: Path = HERE.parent / "shared"
    """Folder with data/pst, data/styles, data/pairings.json and weights; what is absent is skipped."""
    content: EncoderConfig = BundledContentConfig()
    """Content encoder of the photographs (runs bring their own); its decoder must ship."""
    semantic: EncoderConfig = BundledSemanticConfig()
    """Semantic encoder of the photographs (runs bring their own)."""
    triplets: int = 40
    """How many triplets, at most, evenly spread; 0 = runs alone."""
    views: int = 4
    """Neighbouring views of each run."""
    longest: int = 256
    """Longer side of photographs and views."""
    full: bool = False
    """Also compare whole covariances; several times as slow."""
    sheets: Path | None = None
    """Folder for contact sheets; none = none."""
    output: Path = HERE / "benchmarks/results/styles.json"
    """Figures."""

    def __post_init__(self) -> None:
        at_least("triplets", self.triplets, 0)
        at_least("views", self.views, 1)
        at_least("longest", self.longest, 64)


def judges(shared: Path) -> dict[str, Encoder]:
    """VGG-19 where its weights are; untrained convolutions, which see colours and grain, elsewhere."""
    weights = shared / "weights/vgg19_imagenet.safetensors"
    if weights.is_file():
        return {layer: Vgg19Config(layer=layer, weights=weights).build() for layer in LAYERS}
    return {f"random stride {n}": RandomConfig(channels=64, stride=n).build() for n in (1, 2, 4)}


def observer(shared: Path, otherwise: EncoderConfig) -> Encoder:
    """Who finds the regions of runs: DeepLab where its weights are."""
    weights = shared / "weights/deeplabv3_mobilenetv2_pascal.safetensors"
    return DeepLabConfig(weights=weights).build() if weights.is_file() else otherwise.build()


def say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def show(title: str, rows: dict[str, Row]) -> None:
    columns = [c for c in COLUMNS if any(c in row for row in rows.values())]
    print(f"\n{title:24}" + "".join(f"{c:>22}" for c in columns))
    for name, row in rows.items():
        cells = ("" if row.get(c) is None else f"{row[c]:.3f}" for c in columns)
        print(f"{name:24}" + "".join(f"{cell:>22}" for cell in cells))


def triplets(config: StylesConfig) -> dict[str, object]:
    folder, pictures = config.shared / "data/pst", {}
    if not config.triplets or not folder.is_dir():
        return {}
    tools = style_triplets.Tools.of(config.content, config.semantic)

    def seen(name: str, images: dict[str, torch.Tensor]) -> None:
        say(f"triplet {name}")
        pictures[name] = images

    limits = {"count": config.triplets, "longest": config.longest, "full": config.full}
    found = style_triplets.contests(folder, tools, judges(config.shared), seen=seen, **limits)
    if config.sheets is not None:
        names = list(pictures)
        for first in range(0, len(names), SHEET_ROWS):
            rows = [pictures[name] for name in names[first : first + SHEET_ROWS]]
            write_image(config.sheets / f"triplets-{first // SHEET_ROWS}.jpg", sheet(rows))
    result = {}
    for source, contests in found.items():
        means = mean_rows(contests.values())
        show(f"triplets, {source}", means)
        result[source] = {"means": means, "verdict": verdict(means), "triplets": contests}
    return {"content": tools.content.identity, "semantic": tools.semantic.identity, **result}


def runs(config: StylesConfig) -> dict[str, object]:
    result: dict[str, object] = {}
    for root in config.runs:
        data = config.shared / "data"
        cases = list(
            style_runs.contests(
                root,
                style_runs.suited(data / "pairings.json", data / "styles", config.longest),
                judges(config.shared),
                observer(config.shared, config.semantic),
                views=config.views,
                longest=config.longest,
                full=config.full,
                say=say,
            )
        )
        means = mean_rows(case.rows for case in cases)
        show(f"{root.name}", means)
        result[root.name] = {
            "scene": cases[0].scene,
            "means": means,
            "verdict": verdict(means),
            "styles": {case.style.name: case.rows for case in cases},
        }
        if config.sheets is not None:
            write_image(config.sheets / f"run-{root.name}.jpg", sheet([case.row for case in cases]))
    return result


def main() -> int:
    torch.set_num_threads(1)
    start = time.perf_counter()
    roots = []
    args = sys.argv[1:]
    while args and not args[0].startswith("-"):  # as many positional arguments as there are
        roots.append(Path(args.pop(0)))
    try:
        config = replace(parse(StylesConfig(), args, prog="styles.py", description=__doc__ or ""), runs=tuple(roots))
        document = {
            "benchmark": "styles",
            "recommended": RECOMMENDED,
            "goals": dict(GOALS),
            "judges": list(judges(config.shared)),
            "longest": config.longest,
            "triplets": triplets(config),
            "runs": runs(config),
            "seconds": time.perf_counter() - start,
        }
    except FprfError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    write_json(config.output, document)
    for name, part in {**document["triplets"], **document["runs"]}.items():
        if isinstance(part, dict):
            print(name, json.dumps(part["verdict"], indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
