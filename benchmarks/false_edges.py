"""How often styles cut through things: trained runs in photographs' styles, regions by themselves, by default, and gently.

    python -m benchmarks false_edges RUN ... --styles DIR [--references NAME ...] [--output JSON] [--sheets DIR]

false_edges: share of the pairs of pixels on one even surface that the style moves apart (`benchmarks/false_edges.py`).
structure: what the style keeps of the luminance's structure. palette: distance of the pictures' colours (means and deviations
of the channels) to the reference's, over the same of the plain render. change: mean difference to the plain render.
Runs must be of a version that measures contacts between regions. Sheets show other people's photographs.
"""

import statistics
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import torch
import torch.nn.functional as F
from torch import Tensor

from fprf.datamanagers.images import load_image
from fprf.errors import DataError
from fprf.evaluation.metrics import structure
from fprf.io.images import shrink, write_image
from fprf.plugins.stylizers.config import RegionToneConfig
from fprf.style.config import PRESETS, StyleConfig, with_preset
from fprf.style.files import StyleFile
from fprf.style.restyle import apply_style
from fprf.training.loading import load_run
from fprf.training.views import cache_view

from .common import RESULTS, arguments, report
from .pictures import sheet

_SIGMA = 1.0
"""Pixels that both pictures are blurred by: noise is no edge."""
_REACH = 12
"""Ends of a pair lie so many-th of the shorter side apart: further than a soft border between regions is wide."""
_EVEN, _CUT = 0.05, 0.1
"""Largest differences of a channel in [0, 1]: thirteen and twenty-six 8-bit steps."""


def false_edges(
    plain: Annotated[Tensor, "H W 3"], styled: Annotated[Tensor, "H W 3"], *, even: float = _EVEN, cut: float = _CUT
) -> float | None:
    """Share of the pairs on one surface, along rows and columns, that the style cuts, in [0, 1]; None where there are none.

    Raises DataError for pictures of different sizes, or smaller than 12 pixels.
    """
    if plain.shape != styled.shape or plain.ndim != 3 or min(plain.shape[:2]) < _REACH:
        raise DataError(
            f"false edges: pictures of shape {tuple(plain.shape)} and {tuple(styled.shape)}; both must be [H W 3] of one size, "
            f"with sides of at least {_REACH} pixels"
        )
    reach = max(2, round(min(plain.shape[:2]) / _REACH))
    before, after = _blurred(plain), _blurred(styled)
    pairs = cuts = 0
    for axis in (1, 2):
        a, b = before.movedim(axis, 0), after.movedim(axis, 0)
        starts = len(a) - reach
        way = torch.stack([(a[i : i + starts] - a[:starts]).abs().amax(1) for i in range(1, reach + 1)])
        surface = way.amax(0) < even
        pairs += int(surface.sum())
        cuts += int((surface & ((b[reach:] - b[:starts]).abs().amax(1) > cut)).sum())
    return cuts / pairs if pairs else None


def _blurred(picture: Tensor) -> Annotated[Tensor, "3 H W"]:
    at = torch.arange(-3, 4, dtype=torch.float32)
    kernel = torch.exp(-at.square() / (2 * _SIGMA**2))
    kernel = kernel / kernel.sum()
    padded = F.pad(picture.detach().cpu().float().permute(2, 0, 1)[:, None], (3, 3, 3, 3), mode="replicate")
    return F.conv2d(F.conv2d(padded, kernel.view(1, 1, 1, -1)), kernel.view(1, 1, -1, 1))[:, 0]


BASE = StyleConfig()
STYLES = {
    "regions by themselves": replace(BASE, stylizer=RegionToneConfig(smoothness=0.0)),
    "default": BASE,
    **{name: with_preset(BASE, name) for name in PRESETS},
}


def main(argv: list[str]) -> None:
    parser = arguments("false_edges", __doc__)
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--styles", type=Path, required=True, help="folder of photographs")
    parser.add_argument("--references", nargs="+", default=["night_town", "red_dusk_tree", "snow_avenue", "cherry_blossom"])
    parser.add_argument("--views", type=int, default=2, help="views of each run, evenly through the capture")
    parser.add_argument("--longest", type=int, default=170, help="longer side in pixels")
    parser.add_argument("--output", type=Path, default=RESULTS / "false_edges.json")
    parser.add_argument("--sheets", type=Path)
    asked = parser.parse_args(argv)
    scenes = []
    for root in asked.runs:
        trained = load_run(root, "cpu")
        known, encoders = trained.known, trained.encoders()
        cameras = known.cameras.scaled(max(1.0, float(known.cameras.size.amax()) / asked.longest))
        chosen = [(2 * i + 1) * len(cameras) // (2 * asked.views) for i in range(asked.views)]
        views = [cache_view(trained.model, known.facts, cameras, view, trained.config.render) for view in chosen]
        plain = [view.restyled().rgb for view in views]
        rows: dict[str, list[dict[str, float]]] = {name: [] for name in STYLES}
        shown: dict[str, dict[str, Tensor]] = {}
        for name in asked.references:
            path = asked.styles / f"{name}.jpg"
            reference = torch.from_numpy(shrink(load_image(path), asked.longest)).float() / 255
            shown[name] = {"reference": reference, "plain": plain[0]}
            for title, style in STYLES.items():
                look = apply_style(trained, StyleFile(replace(style, references=(path,))), encoders).restyle
                made = [view.restyled(look).rgb for view in views]
                shown[name][title] = made[0]
                rows[title] += [judged(a, b, reference) for a, b in zip(plain, made, strict=True)]
        means = {
            title: {key: round(statistics.fmean(row[key] for row in found), 4) for key in found[0]}
            for title, found in rows.items()
        }
        scenes.append(
            {"scene": known.name, "steps": trained.step, "views": chosen, "references": asked.references, "means": means}
        )
        print(known.name, means, flush=True)
        if asked.sheets is not None:
            asked.sheets.mkdir(parents=True, exist_ok=True)
            write_image(asked.sheets / f"{known.name}.jpg", sheet(list(shown.values())))
    total = {
        title: {
            key: round(statistics.fmean(scene["means"][title][key] for scene in scenes), 4) for key in scenes[0]["means"][title]
        }
        for title in STYLES
    }
    report(asked.output, {"benchmark": "false_edges", "longest": asked.longest, "means": total, "scenes": scenes})


def judged(plain: Tensor, styled: Tensor, reference: Tensor) -> dict[str, float]:
    """The figures of one view."""
    return {
        "false_edges": false_edges(plain, styled) or 0.0,
        "structure": structure(plain, styled),
        "palette": _palette(styled, reference) / max(_palette(plain, reference), 1e-6),
        "change": float((styled - plain).abs().mean()),
    }


def _palette(a: Tensor, b: Tensor) -> float:
    ends = [torch.cat([x.reshape(-1, 3).mean(0), x.reshape(-1, 3).std(0)]) for x in (a, b)]
    return float((ends[0] - ends[1]).norm())
