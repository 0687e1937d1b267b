"""Restyling side by side: every stylizer, and transfers of colour alone, on painted photographs and on trained runs.

    python -m benchmarks styles [RUN ...] [--shared DIR] [--sheets DIR] [--output JSON] [any field]

structure, ssim: kept of the unstylised picture, 1 = all of it. gradient_kept, range_kept: contrast inside of regions (mean
gradient; from the 1 % to the 99 % quantile of luma), where the references have as much. style_distance: to the references,
region by region, 1 = no change, in the eyes of VGG-19, which no shipped part of the product uses. consistency: warp error
between neighbouring views.
Sheets show other people's photographs: they are written only where asked for.
"""

import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import torch
import torch.nn.functional as F
from torch import Tensor

from fprf.checks import at_least
from fprf.cli.parsing import parse
from fprf.datamanagers.basis import Basis, fit_basis
from fprf.datamanagers.config import GuidedConfig
from fprf.datamanagers.images import load_image
from fprf.errors import FprfError
from fprf.interfaces import Decoder, Encoder
from fprf.io.images import shrink, write_image
from fprf.plugins.decoders.config import MlpDecoderConfig
from fprf.plugins.encoders.config import (
    BundledContentConfig,
    BundledSemanticConfig,
    EncoderConfig,
    RandomConfig,
    Vgg19Config,
)
from fprf.plugins.stylizers.config import AdainConfig
from fprf.style.dictionary import Reference, build_dictionary

from . import style_runs
from .common import RESULTS, SHARED, report
from .pictures import sheet
from .restyle import STYLIZERS
from .semantic_matching import COLOURS, Triplet, read_triplets, triplet_names
from .single_image import encoded, flat_look, flat_scene, render_flat
from .style_runs import GOALS, PLAIN, RECOMMENDED, Exhibit, Row, colour_baselines, judge_exhibit, mean_rows, verdict

DIM, REGIONS, CLUSTERS = 32, 16, 20
"""Of `fprf-lite`: semantic components, regions of a scene, codes of a reference."""
SOURCES = ("painted", "encoder")


@torch.no_grad()
def cells_basis(image: Annotated[Tensor, "H W 3"], encoder: Encoder, dim: int) -> Basis:
    """The principal components of the encoder's features on a photograph: what a scene fits on its training views."""
    maps: Tensor = encoder(image.permute(2, 0, 1)[None])[0].float()
    return fit_basis(maps.flatten(1).T, dim)


def painted(regions: Annotated[Tensor, "H W"], kinds: int, size: tuple[int, int]) -> Annotated[Tensor, "N D"]:
    """One channel a region, 1 where a pixel of a picture of `size` (height, width) lies in it: the nearest painted one."""
    near = F.interpolate(regions[None, None].double(), size, mode="nearest-exact")[0, 0].long()
    return F.one_hot(near.flatten(), kinds).float()


def flat_reference(
    name: str,
    content: Annotated[Tensor, "N C"],
    semantic: Annotated[Tensor, "N D"] | None,
    colour: Annotated[Tensor, "N 3"] | None = None,
    *,
    samples: int = 20_000,
) -> Reference:
    """A photograph's features, and its colours, as a reference; about `samples` pixels of it, in even steps."""
    some = slice(0, None, max(1, len(content) // samples))
    parts = content.new_zeros(len(content[some]), 0) if semantic is None else semantic[some]
    return Reference(name, content[some], parts, colour=None if colour is None else colour[some])


@dataclass(frozen=True)
class Tools:
    content: Encoder
    semantic: Encoder
    decoder: Decoder

    @classmethod
    def of(cls, content: EncoderConfig, semantic: EncoderConfig) -> "Tools":
        encoder = content.build()
        decoder = MlpDecoderConfig().build(encoder=encoder.identity, channels=encoder.channels)
        return cls(encoder, semantic.build(), decoder)


def photograph(path: Path, longest: int) -> Tensor:
    return torch.from_numpy(shrink(load_image(path), longest)).float() / 255


def restyled(triplet: Triplet, tools: Tools, source: str) -> dict[str, Tensor]:
    """The content photograph by every stylizer, its parts told apart by the painted regions or by the encoder."""
    guided, size = GuidedConfig(), (triplet.content.shape[0], triplet.content.shape[1])
    here, there = (encoded(image, tools.content, guided) for image in (triplet.content, triplet.style))
    if source == "painted":
        kinds = len(COLOURS)
        where = painted(triplet.content_regions, kinds, size)
        where_there = painted(triplet.style_regions, kinds, (triplet.style.shape[0], triplet.style.shape[1]))
    else:
        basis = cells_basis(triplet.content, tools.semantic, DIM)
        where, where_there = (encoded(image, tools.semantic, guided, basis) for image in (triplet.content, triplet.style))
    flat = flat_scene(here, where, size, regions=len(COLOURS) if source == "painted" else REGIONS)
    dictionary = build_dictionary(
        [flat_reference("style", there, where_there, triplet.style.reshape(-1, 3))],
        clusters=len(COLOURS) if source == "painted" else CLUSTERS,
    )
    configs = {"decoded": AdainConfig(features=0.0), **STYLIZERS} if source == SOURCES[0] else STYLIZERS
    return {
        name: render_flat(flat, flat_look(flat, dictionary, config, tools.decoder), tools.decoder)
        for name, config in configs.items()
    }


def peer(folder: Path, triplet: Triplet) -> dict[str, Tensor]:
    """What the paper of the triplets made of it, where that lies beside them."""
    path = folder / "dpst_result" / f"{triplet.name}.jpg"
    if not path.is_file():
        return {}
    image = torch.from_numpy(load_image(path)).float().permute(2, 0, 1)[None] / 255
    size = (triplet.content.shape[0], triplet.content.shape[1])
    return {"luan et al.": F.interpolate(image, size, mode="area")[0].permute(1, 2, 0)}


def contests(
    folder: Path,
    tools: Tools,
    judges: dict[str, Encoder],
    *,
    count: int,
    longest: int,
    full: bool,
    seen: Callable[[str, dict[str, Tensor]], None],
) -> dict[str, dict[str, dict[str, Row]]]:
    """Rows by source of the regions, triplet and method. `seen` is shown all pictures of a triplet."""
    found: dict[str, dict[str, dict[str, Row]]] = {source: {} for source in SOURCES}
    for name in _spread(triplet_names(folder), count):
        (triplet,) = read_triplets(folder, names=[name], size=None)
        triplet = triplet._replace(
            content=photograph(folder / "content" / f"{name}.jpg", longest),
            style=photograph(folder / "style" / f"{name}.jpg", longest),
        )
        common = {PLAIN: triplet.content}
        common |= {k: v[0] for k, v in colour_baselines([triplet.content], [triplet.style]).items()}
        common |= peer(folder, triplet)
        made = {source: restyled(triplet, tools, source) for source in SOURCES}
        every = {**common, **{f"{source}/{k}": image for source in SOURCES for k, image in made[source].items()}}
        exhibit = Exhibit(
            plain=[triplet.content],
            styled={k: [image] for k, image in every.items()},
            regions=[triplet.content_regions],
            references=[triplet.style],
            reference_regions=[triplet.style_regions],
        )
        rows = judge_exhibit(exhibit, judges, full=full)
        for source in SOURCES:
            found[source][name] = {k: rows[k] for k in common} | {k: rows[f"{source}/{k}"] for k in made[source]}
        seen(name, {"style": triplet.style, **every})
    return found


def _spread(names: Sequence[str], count: int) -> list[str]:
    """So many of the names, evenly spread."""
    kept = min(count, len(names))
    return [names[i * len(names) // kept] for i in range(kept)]


LAYERS = ("relu1_1", "relu2_1", "relu3_1")
COLUMNS = (
    "structure",
    "ssim",
    "gradient_kept",
    "range_kept",
    "style_distance",
    "full_distance",
    "consistency_rmse",
    "consistency_relative",
)
SHEET_ROWS = 12


@dataclass(frozen=True, kw_only=True)
class StylesConfig:
    """What is compared, and by whom it is judged."""

    runs: tuple[Path, ...] = ()
    """Trained runs."""
    shared: Path = SHARED
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
    output: Path = RESULTS / "styles.json"
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
    """Who finds the regions of runs."""
    return otherwise.build()


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
    tools = Tools.of(config.content, config.semantic)

    def seen(name: str, images: dict[str, torch.Tensor]) -> None:
        say(f"triplet {name}")
        pictures[name] = images

    found = contests(
        folder, tools, judges(config.shared), seen=seen, count=config.triplets, longest=config.longest, full=config.full
    )
    if config.sheets is not None:
        names = list(pictures)
        for first in range(0, len(names), SHEET_ROWS):
            rows = [pictures[name] for name in names[first : first + SHEET_ROWS]]
            write_image(config.sheets / f"triplets-{first // SHEET_ROWS}.jpg", sheet(rows))
    result = {}
    for source, cases in found.items():
        means = mean_rows(cases.values())
        show(f"triplets, {source}", means)
        result[source] = {"means": means, "verdict": verdict(means), "triplets": cases}
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


def main(argv: list[str]) -> int:
    torch.set_num_threads(1)
    start = time.perf_counter()
    roots = []
    args = argv
    while args and not args[0].startswith("-"):  # as many positional arguments as there are
        roots.append(Path(args.pop(0)))
    try:
        config = replace(
            parse(StylesConfig(), args, prog="python -m benchmarks styles", description=__doc__ or ""), runs=tuple(roots)
        )
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
    report(config.output, document)
    for name, part in {**document["triplets"], **document["runs"]}.items():
        if isinstance(part, dict):
            print(name, json.dumps(part["verdict"], indent=1))
    return 0
