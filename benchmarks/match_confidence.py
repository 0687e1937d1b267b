"""What a score of `style.light` says: how often it belongs to a right match, on painted pairs of photographs.

    python -m benchmarks match_confidence [--encoder NAME [--encoder.FIELD VALUE ...]] [--triplets DIR] [--output JSON]

Each painted region that both photographs show is asked for twice: with the style photograph as it is, and without the region.
A pixel of the region has a right match the first time and none the second; both times weigh alike. The rate of a bin
of scores (in spreads of the scene's regions) is the share of the pixels with a right match in it. One encoder a call.
"""

import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import torch
from torch import Tensor

from fprf.cli.parsing import parse
from fprf.datamanagers.basis import Basis, fit_basis
from fprf.datamanagers.config import GuidedConfig
from fprf.errors import FprfError
from fprf.interfaces import Encoder
from fprf.plugins.encoders.config import SEMANTICS, EncoderConfig
from fprf.plugins.stylizers.config import RegionToneConfig
from fprf.style.dictionary import Reference, StyleDictionary, build_dictionary
from fprf.style.light import SURE, UNSURE, certainty, light_of
from fprf.style.references import semantic_samples
from fprf.style.scene import scene_style

from .common import RESULTS, SHARED, add_entry
from .semantic_matching import Triplet, read_triplets, shared_regions, triplet_names

_CHANNELS, _REGIONS, _STEP, _WIDTH = 31, 16, 5, 0.2
"""Principal components and regions, as of a capture; pixels between samples; of a bin, in spreads."""
_FEWEST = 50
"""Samples that a style must have left."""


@dataclass(frozen=True, kw_only=True)
class BenchmarkConfig:
    """What to measure, and on what."""

    encoder: EncoderConfig = SEMANTICS
    """The semantic encoder."""
    triplets: Path = SHARED / "data/pst"
    """Folder with content, style and segmentation."""
    output: Path = RESULTS / "match_confidence.json"
    """Where the curves are kept, one for each encoder."""


@torch.inference_mode()
def measured_scores(encoder: Encoder, triplet: Triplet) -> tuple[list[Tensor], list[Tensor]]:
    """Scores, in spreads, of pixels with a right match and of those without, one tensor for each region."""
    cells = encoder(triplet.content.permute(2, 0, 1)[None])[0].float()
    basis = fit_basis(cells.flatten(1).T, _CHANNELS)
    here, _, _, kinds = _sampled(triplet.content, triplet.content_regions, encoder, basis)
    there, beyond, colour, shown = _sampled(triplet.style, triplet.style_regions, encoder, basis)
    scene = scene_style(here[:, :3], here, torch.ones(len(here)), None, _REGIONS, 0)

    def match(dictionary: StyleDictionary) -> Tensor:
        return RegionToneConfig().build(dictionary=dictionary, scene=scene).region_match(scene.keys)

    regions, right, wrong = shared_regions(triplet), [], []
    for gone in (None, *regions):
        left = shown != gone if gone is not None else torch.ones_like(shown, dtype=torch.bool)
        if int(left.sum()) < _FEWEST:
            continue
        dictionary = build_dictionary(
            [Reference("style", there[left, :3], there[left], colour=colour[left], beyond=beyond[left])]
        )
        light = light_of(scene, dictionary, match, (scene.region_mean, scene.region_covariance), bold=0.5)
        assert light is not None  # a photograph has several regions
        score = light.score(here)[:, 0]
        if gone is None:
            right = [score[kinds == region] for region in regions]
        else:
            wrong.append(score[kinds == gone])
    return right, wrong


def rates(right: list[Tensor], wrong: list[Tensor]) -> dict[str, object]:
    """Share of right matches by bins of the score, all regions alike; and that a right one scores higher than a wrong one."""
    edges = torch.arange(-0.4, 2.4001, _WIDTH)
    counts = []
    for side in (right, wrong):
        shares = [torch.histogram(part.clamp(-0.39, 2.39).cpu(), edges)[0] / len(part) for part in side if len(part)]
        counts.append(torch.stack(shares).double().mean(0))
    rate = counts[0] / (counts[0] + counts[1]).clamp_min(1e-9)
    middle = (edges[:-1] + edges[1:]) / 2
    above = counts[1].cumsum(0) - counts[1] / 2
    return {
        "score": [round(float(x), 2) for x in middle],
        "rate": [round(float(x), 3) for x in rate],
        "right": [round(float(x), 4) for x in counts[0]],
        "wrong": [round(float(x), 4) for x in counts[1]],
        "confidence": [round(float(x), 3) for x in certainty(middle)],
        "auc": round(float(counts[0] @ above), 4),
        "rms": round(math.sqrt(float(((certainty(middle) - rate).square() * (counts[0] + counts[1]) / 2).sum())), 4),
        "unsure": UNSURE,
        "sure": SURE,
    }


def _sampled(
    image: Annotated[Tensor, "H W 3"], painted: Annotated[Tensor, "h w"], encoder: Encoder, basis: Basis
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Semantics, what lies beyond the basis, colours and painted regions at every n-th pixel."""
    height, width = image.shape[:2]
    y, x = torch.meshgrid(torch.arange(_STEP // 2, height, _STEP), torch.arange(_STEP // 2, width, _STEP), indexing="ij")
    x, y = x.flatten(), y.flatten()
    semantic, beyond = semantic_samples(image, torch.stack([x, y], 1), encoder, basis, GuidedConfig())
    kinds = painted[y * painted.shape[0] // height, x * painted.shape[1] // width]
    return semantic, beyond, image[y, x], kinds


def main(argv: list[str]) -> int:
    torch.set_num_threads(1)
    try:
        config = parse(BenchmarkConfig(), argv, prog="python -m benchmarks match_confidence", description=__doc__ or "")
        encoder, right, wrong = config.encoder.build(), [], []
        for name in triplet_names(config.triplets):
            triplet = read_triplets(config.triplets, names=[name])[0]
            if len(shared_regions(triplet)) > 1:
                found = measured_scores(encoder, triplet)
                right += found[0]
                wrong += found[1]
    except FprfError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    figures = rates(right, wrong)
    add_entry(config.output, encoder.identity, figures)
    print(figures)
    return 0
