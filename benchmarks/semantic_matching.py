"""Encoders compared by finding like with like: the matching rate on painted triplets, and the classes of the town in
every light.

    python -m benchmarks semantic_matching [--encoder NAME [--encoder.FIELD VALUE ...]] [--triplets DIR] [--output JSON]

One encoder a call; its row replaces the row of the same encoder in the output. Without triplets the town
alone is measured.

`confidence` is what the confidence of `fprf.style.light` says: each painted region that both photographs show
is asked for twice, with the style photograph as it is, and without the region. A pixel of the region has a
right match the first time and none the second; both times weigh alike. The rate of a bin of confidences is
the share of the pixels with a right match in it.
"""

import json
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from fprf.cli.parsing import parse
from fprf.datamanagers.basis import Basis, fit_basis
from fprf.datamanagers.images import load_image
from fprf.errors import DataError
from fprf.interfaces import Encoder
from fprf.ops.config import GuidedConfig
from fprf.plugins.encoders.config import SEMANTICS, EncoderConfig
from fprf.plugins.stylizers.config import RegionToneConfig
from fprf.style.dictionary import Reference, build_dictionary, semantics_of
from fprf.style.light import light_of
from fprf.style.scene_style import scene_style

from .common import SHARED, report
from .style_metrics import MIXED, whole_cells
from .town.layout import build_town
from .town.palettes import PALETTES, palette
from .town.render import colours, geometry, walk

COLOURS = ("black", "white", "blue", "green", "red", "yellow", "magenta", "cyan", "grey")
"""Names by region id."""
_CODES = (0x000000, 0xFFFFFF, 0x0000FF, 0x00FF00, 0xFF0000, 0xFFFF00, 0xFF00FF, 0x00FFFF, 0x808080)

SIZE = (512, 384)
"""Width and height at which the matching measure sees every photograph."""


class Triplet(NamedTuple):
    """Two photographs [H W 3], sRGB in [0, 1], and their painted regions [H W], int64 in 0..8. Sizes may
    differ.
    """

    name: str
    content: Annotated[Tensor, "H W 3"]
    style: Annotated[Tensor, "G F 3"]
    content_regions: Annotated[Tensor, "H W"]
    style_regions: Annotated[Tensor, "G F"]


def triplet_names(folder: Path) -> list[str]:
    """Sorted. Raises DataError where there is none."""
    names = sorted(path.stem for path in (folder / "content").glob("*.jpg"))
    if not names:
        raise DataError(f"{folder}: no content/*.jpg; name a folder with content, style and segmentation")
    return names


def read_triplets(
    folder: Path, *, names: Sequence[str] = (), size: tuple[int, int] | None = SIZE
) -> list[Triplet]:
    """The triplets of a folder, or those named; photographs at `size` (None: as they are), regions always as
    painted.

    Raises DataError for a file that is absent, unreadable or painted in other colours.
    """
    return [
        Triplet(
            name,
            _photo(folder / "content" / f"{name}.jpg", size),
            _photo(folder / "style" / f"{name}.jpg", size),
            read_regions(folder / "segmentation" / f"{name}_content.png"),
            read_regions(folder / "segmentation" / f"{name}_style.png"),
        )
        for name in (names or triplet_names(folder))
    ]


def read_regions(path: Path) -> Annotated[Tensor, "H W"]:
    """Region ids of a painted mask. Raises DataError for colours that are none of the nine."""
    pixels = load_image(path).astype(np.int64)
    code = (pixels[..., 0] << 16) | (pixels[..., 1] << 8) | pixels[..., 2]
    found = np.full(code.shape, -1, dtype=np.int64)
    for region, colour in enumerate(_CODES):
        found[code == colour] = region
    if (found < 0).any():
        raise DataError(
            f"{path}: {float((found < 0).mean()):.1%} of the pixels have none of the colours {', '.join(COLOURS)}"
        )
    return torch.from_numpy(found)


def _photo(path: Path, size: tuple[int, int] | None) -> Annotated[Tensor, "H W 3"]:
    return torch.from_numpy(load_image(path, size)).float() / 255


_NEAREST = 3
_COARSE = 16
"""Pixels a cell, on the grid that decides which regions count: the same ones for every encoder."""
_SHARE = 0.01
"""A region counts where it fills this share of both images."""
_FINEST = 8
"""Features finer than this many pixels a cell are averaged: a comparison of all cells is quadratic."""


def matching_rate(
    content: Annotated[Tensor, "N C"],
    style: Annotated[Tensor, "M C"],
    content_labels: Annotated[Tensor, "N"],
    style_labels: Annotated[Tensor, "M"],
    regions: Sequence[int],
) -> float:
    """Mean hit rate over the regions, in [0, 1]. Chance: 1 / len(regions). Cells of other labels only count
    as centre.

    Raises DataError where a region has no cell on one of the sides.
    """
    for region in regions:
        if not (bool((content_labels == region).any()) and bool((style_labels == region).any())):
            raise DataError(
                f"semantic matching: no cell of region {region} in one of the images; leave the region out"
            )
    centre = torch.cat([content, style]).mean(0)
    near = F.normalize(content - centre, dim=1)
    far = F.normalize(style - centre, dim=1)
    scores = []
    for region in regions:
        like = near @ far[style_labels == region].T
        scores.append(like.topk(min(_NEAREST, like.shape[1]), dim=1).values.mean(1))
    found = torch.stack(scores, 1).argmax(1)
    hits = [
        float((found[content_labels == region] == place).double().mean())
        for place, region in enumerate(regions)
    ]
    return math.fsum(hits) / len(hits)


def shared_regions(triplet: Triplet) -> list[int]:
    """Regions that fill at least 1 % of both images with whole cells of 16 pixels."""
    shares = []
    for regions, image in (
        (triplet.content_regions, triplet.content),
        (triplet.style_regions, triplet.style),
    ):
        cells = whole_cells(regions, (image.shape[0] // _COARSE, image.shape[1] // _COARSE))
        shares.append(
            {
                r
                for r in set(cells.flatten().tolist())
                if r != MIXED and float((cells == r).double().mean()) >= _SHARE
            }
        )
    return sorted(shares[0] & shares[1])


@torch.no_grad()
def semantic_matching(
    encoder: Encoder, triplets: Sequence[Triplet]
) -> dict[str, float | int | dict[str, float]]:
    """`matching` (mean rate), `chance`, `triplets` (those with at least two shared regions), `per_triplet` by
    name.

    Raises DataError where no triplet has two regions to tell apart.
    """
    rates = {}
    chances = []
    for triplet in triplets:
        regions = shared_regions(triplet)
        if len(regions) < 2:
            continue
        content, style = (_features(encoder, image) for image in (triplet.content, triplet.style))
        rates[triplet.name] = matching_rate(
            content.flatten(1).T,
            style.flatten(1).T,
            whole_cells(triplet.content_regions, (content.shape[1], content.shape[2])).flatten(),
            whole_cells(triplet.style_regions, (style.shape[1], style.shape[2])).flatten(),
            regions,
        )
        chances.append(1 / len(regions))
    if not rates:
        raise DataError(
            "semantic matching: no pair of images shares two regions; there is nothing to tell apart"
        )
    return {
        "matching": math.fsum(rates.values()) / len(rates),
        "chance": math.fsum(chances) / len(chances),
        "triplets": len(rates),
        "per_triplet": rates,
    }


def class_match(
    features: Annotated[Tensor, "N C"],
    labels: Annotated[Tensor, "N"],
    known: Annotated[Tensor, "M C"],
    known_labels: Annotated[Tensor, "M"],
) -> tuple[float, dict[int, float]]:
    """Share of cells whose nearest class centroid of the known side is their own class: overall, and class by
    class.

    MIXED cells, and cells of classes that the known side lacks, don't count. Raises DataError where none is
    left.
    """
    classes = sorted(set(known_labels.tolist()) - {MIXED})
    inside = torch.isin(labels, torch.tensor(classes, dtype=labels.dtype, device=labels.device))
    if not bool(inside.any()):
        raise DataError("class match: no cell of a class that both sides show")
    known = known - known[known_labels != MIXED].mean(0)
    centroids = torch.stack([known[known_labels == c].mean(0) for c in classes])
    here = features[inside] - features[inside].mean(0)
    nearest = (F.normalize(here, dim=1) @ F.normalize(centroids, dim=1).T).argmax(1)
    right = torch.tensor(classes, device=labels.device)[nearest] == labels[inside]
    kinds = {
        c: float(right[labels[inside] == c].double().mean())
        for c in classes
        if bool((labels[inside] == c).any())
    }
    return float(right.double().mean()), kinds


def palette_match(
    cells: Mapping[str, tuple[Annotated[Tensor, "N C"], Annotated[Tensor, "N"]]], known: str
) -> dict[str, float | dict[str, float]]:
    """`class_match` of every palette but `known`, whose centroids are used: `match` and `class_mean` over the
    palettes, `per_palette`, and `itself`, that of the known palette: what the classes' overlap alone costs.
    """
    rates = {}
    means = []
    for name, (features, labels) in cells.items():
        if name != known:
            rates[name], kinds = class_match(features, labels, *cells[known])
            means.append(math.fsum(kinds.values()) / len(kinds))
    if not rates:
        raise DataError(
            f"class match: {known!r} is the only palette; render at least one other to compare with"
        )
    return {
        "match": math.fsum(rates.values()) / len(rates),
        "class_mean": math.fsum(means) / len(means),
        "itself": class_match(*cells[known], *cells[known])[0],
        "per_palette": rates,
    }


def _features(encoder: Encoder, image: Annotated[Tensor, "H W 3"]) -> Annotated[Tensor, "C h w"]:
    found: Tensor = encoder(image.permute(2, 0, 1)[None]).float()
    height, width = (
        min(n, max(1, side // _FINEST)) for n, side in zip(found.shape[-2:], image.shape[:2], strict=True)
    )
    return F.adaptive_avg_pool2d(found, (height, width))[0]


@torch.no_grad()
def town_cells(
    encoder: Encoder, palettes: Sequence[str], *, seeds: Sequence[int], views: int, size: tuple[int, int]
) -> dict[str, tuple[Annotated[Tensor, "N C"], Annotated[Tensor, "N"]]]:
    """Features and class ids (MIXED at borders) of all cells, by palette; `size` is (width, height) of a
    view.

    Raises DataError for a palette that does not exist.
    """
    looks = {name: palette(name) for name in palettes}
    features: dict[str, list[Tensor]] = {name: [] for name in looks}
    labels: list[Tensor] = []
    for seed in seeds:
        town = build_town(seed)
        for view in walk(seed=seed, views=views, width=size[0], height=size[1]):
            kinds = torch.from_numpy(geometry(town, view)[1].astype("int64"))
            for name, look in looks.items():
                image = torch.from_numpy(colours(town, view, look, 1)).permute(2, 0, 1)[None].clamp(0, 1)
                found: Tensor = encoder(image).float()[0]
                features[name].append(found.flatten(1).T)
            labels.append(whole_cells(kinds, (found.shape[1], found.shape[2])).flatten())
    return {name: (torch.cat(parts), torch.cat(labels)) for name, parts in features.items()}


_CHANNELS = 31
_REGIONS = 16
_STEP = 5
_BINS = 10
"""Principal components and regions, as of a capture; pixels between samples; bins of confidence."""
_FEWEST = 50
"""Samples that a style must have left."""


@torch.inference_mode()
def measured_confidence(encoder: Encoder, triplet: Triplet) -> tuple[list[Tensor], list[Tensor]]:
    """Confidence of pixels with a right match and of those without, one tensor for each region."""
    cells = encoder(triplet.content.permute(2, 0, 1)[None])[0].float()
    basis = fit_basis(cells.flatten(1).T, _CHANNELS)
    here, _, _, kinds = _sampled(triplet.content, triplet.content_regions, encoder, basis)
    there, beyond, colour, shown = _sampled(triplet.style, triplet.style_regions, encoder, basis)
    scene = scene_style(here[:, :3], here, torch.ones(len(here)), None, _REGIONS, 0)
    regions = shared_regions(triplet)
    right = []
    wrong = []
    for gone in (None, *regions):
        left = shown != gone if gone is not None else torch.ones_like(shown, dtype=torch.bool)
        if int(left.sum()) < _FEWEST:
            continue
        dictionary = build_dictionary(
            [Reference("style", there[left, :3], there[left], colour=colour[left], beyond=beyond[left])]
        )
        light = light_of(
            scene, dictionary, RegionToneConfig(), (scene.region_mean, scene.region_covariance), bold=0.5
        )
        assert light is not None  # a photograph has several regions
        sure = light.confidence(here)[:, 0]
        if gone is None:
            right = [sure[kinds == region] for region in regions]
        else:
            wrong.append(sure[kinds == gone])
    return right, wrong


def rates(encoder: Encoder, triplets: Sequence[Triplet]) -> dict[str, object]:
    """Share of right matches by bins of confidence, all regions alike, and how far both differ (`rms`).

    `auc` is the rate at which a right match is surer than a wrong one; of the same bin half count.
    """
    right: list[Tensor] = []
    wrong: list[Tensor] = []
    for triplet in triplets:
        if len(shared_regions(triplet)) > 1:
            found = measured_confidence(encoder, triplet)
            right = right + found[0]
            wrong = wrong + found[1]
    edges = torch.linspace(0, 1, _BINS + 1)
    counts = []
    for side in (right, wrong):
        shares = [torch.histogram(part.cpu(), edges)[0] / len(part) for part in side if len(part)]
        counts.append(torch.stack(shares).double().mean(0))
    rate = counts[0] / (counts[0] + counts[1]).clamp_min(1e-9)
    middle = (edges[:-1] + edges[1:]) / 2
    above = counts[1].cumsum(0) - counts[1] / 2
    return {
        "confidence": [round(float(x), 2) for x in middle],
        "rate": [round(float(x), 3) for x in rate],
        "right": [round(float(x), 4) for x in counts[0]],
        "wrong": [round(float(x), 4) for x in counts[1]],
        "auc": round(float(counts[0] @ above), 4),
        "rms": round(math.sqrt(float(((middle - rate).square() * (counts[0] + counts[1]) / 2).sum())), 4),
    }


def _sampled(
    image: Annotated[Tensor, "H W 3"], painted: Annotated[Tensor, "h w"], encoder: Encoder, basis: Basis
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Semantics, what lies beyond the basis, colours and painted regions at every n-th pixel."""
    height, width = image.shape[:2]
    y, x = torch.meshgrid(
        torch.arange(_STEP // 2, height, _STEP), torch.arange(_STEP // 2, width, _STEP), indexing="ij"
    )
    x = x.flatten()
    y = y.flatten()
    semantic, beyond = semantics_of(image, encoder, basis, GuidedConfig())(torch.stack([x, y], 1))
    kinds = painted[y * painted.shape[0] // height, x * painted.shape[1] // width]
    return semantic, beyond, image[y, x], kinds


GOALS = {"matching": 0.88, "match": 0.90}


@dataclass(frozen=True, kw_only=True)
class BenchmarkConfig:
    """Measurements and their data."""

    encoder: EncoderConfig = SEMANTICS
    """The semantic encoder."""
    colours: bool = False
    """Measure plain colours instead of the encoder: the floor."""
    triplets: Path = SHARED / "data/pst"
    """Folder with content, style and segmentation."""
    most: int = 1000
    """Triplets that are measured, at most."""
    palette: str = "day"
    """Palette of the town whose class centroids are used; the cells of all the others are classified."""
    seeds: tuple[int, ...] = (0, 1)
    """Towns."""
    views: int = 5
    """Views of each town."""
    size: tuple[int, int] = (256, 192)
    """Width and height of a view."""
    output: Path | None = None
    """JSON file that the row is added to."""


class Colours(Encoder):
    @property
    def identity(self) -> str:
        return "colours"

    @property
    def channels(self) -> int:
        return 3

    def forward(self, image: Tensor) -> Tensor:
        return F.avg_pool2d(image, 8)


def measure(config: BenchmarkConfig) -> dict[str, object]:
    encoder = Colours() if config.colours else config.encoder.build()
    row: dict[str, object] = {"encoder": encoder.identity, "channels": encoder.channels}
    start = time.perf_counter()
    if config.triplets.is_dir():
        painted = read_triplets(config.triplets)[: config.most]
        row |= {"triplets": semantic_matching(encoder, painted), "confidence": rates(encoder, painted)}
    cells = town_cells(encoder, list(PALETTES), seeds=config.seeds, views=config.views, size=config.size)
    row |= {"town": {"known": config.palette, **palette_match(cells, config.palette)}}
    return row | {"seconds": time.perf_counter() - start}


def main(argv: list[str]) -> int:
    torch.set_num_threads(1)
    config = parse(
        BenchmarkConfig(), argv, prog="python -m benchmarks semantic_matching", description=__doc__ or ""
    )
    row = measure(config)
    print(json.dumps({**row, "goals": GOALS}, indent=1))
    if config.output is not None:
        kept = json.loads(config.output.read_text())["rows"] if config.output.is_file() else []
        rows = [r for r in kept if r["encoder"] != row["encoder"]]
        report(config.output, {"goals": GOALS, "rows": [*rows, row]})
    return 0
