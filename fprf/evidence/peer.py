"""Frames of any system, scored by the code that scores ours."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..datamanagers.images import load_image
from ..errors import DataError
from ..evaluation.colour_difference import delta_e
from ..evaluation.matched_regions import matched_regions
from ..evaluation.metrics import image_metrics, mean_metrics
from ..evaluation.published import published
from ..evaluation.steadiness import steadiness
from ..evaluation.structure import structure
from ..evaluation.style_distance import style_distances
from ..plugins.encoders.config import BundledContentConfig, BundledSemanticConfig
from ..rendering.cameras import Cameras
from ..training.loading import load_run
from ..training.views import render_view
from .config import PeerConfig
from .frames import Frames, read_cameras, read_depths, read_pictures

__all__ = ["peer"]

REGIONS = 6
"""Regions in which frames and references are compared."""
_LARGEST = 512
"""References are reduced to this longest side."""
Progress = Callable[[int, int, str], None]


class _Known(NamedTuple):
    """What frames are judged by, as far as it is there."""

    plain: list[Tensor] | None
    depths: list[Tensor] | None


def peer(config: PeerConfig, progress: Progress) -> dict[str, Any]:
    """The document. What cannot be said for lack of input is None, and `missing` names the flag that would tell.

    Raises DataError for frames, cameras and depths that do not fit each other.
    """
    frames = read_pictures(config.frames)
    cameras = read_cameras(config.cameras, frames)
    known = _known(config, frames, cameras, progress)
    missing: dict[str, str] = {}
    document: dict[str, Any] = {
        "benchmark": "peer",
        "frames": len(frames.images),
        "size": [int(side) for side in cameras.size[0]],
        "steadiness": None,
        "published": None,
        "truth": None,
        "style": None,
    }
    if known.depths is None:
        missing |= dict.fromkeys(("steadiness", "published"), "--depth or --run")
    else:
        document["published"] = published(frames.images, known.depths, cameras)
        if known.plain is None:
            missing["steadiness"] = "--plain or --run"
        else:
            document["steadiness"] = steadiness(known.plain, frames.images, known.depths, cameras)._asdict()
    if config.truth is None:
        missing["truth"] = "--truth"
    else:
        document["truth"] = _nearness(frames, read_pictures(config.truth, frames.names).images)
    if known.plain is None or not config.references:
        missing["style"] = "--references, and --plain or --run"
    else:
        document["style"] = _style(config, frames.images, known.plain)
    return {**document, "missing": missing}


def _known(config: PeerConfig, frames: Frames, cameras: Cameras, progress: Progress) -> _Known:
    plain = None if config.plain is None else read_pictures(config.plain, frames.names).images
    depths = None if config.depth is None else read_depths(config.depth, frames.names, cameras, config.depth_along)
    if config.run is not None and (plain is None or depths is None):
        trained = load_run(config.run, config.device)
        rendered = []
        for view in range(len(cameras)):
            progress(view, len(cameras), "rendering unstylised frames")
            rendered.append(render_view(trained.model, trained.known.facts, cameras, view, trained.config.render))
        plain = [each.rgb for each in rendered] if plain is None else plain
        depths = [each.depth for each in rendered] if depths is None else depths
    for name, own, image in zip(frames.names, frames.images, plain or frames.images, strict=True):
        if image.shape != own.shape:
            raise DataError(f"--plain: {name} is {_size(image)}, the stylised frame {_size(own)}; both must agree")
    return _Known(plain, depths)


def _nearness(frames: Frames, truth: Sequence[Tensor]) -> dict[str, float]:
    row = mean_metrics([image_metrics(a, b) for a, b in zip(frames.images, truth, strict=True)])
    apart = torch.cat([delta_e(a, b).flatten() for a, b in zip(frames.images, truth, strict=True)])
    return {**row, "delta_e": float(apart.mean())}


def _style(config: PeerConfig, styled: Sequence[Tensor], plain: Sequence[Tensor]) -> dict[str, float | None]:
    """Distance to the references (1 = no change) and what is left of the frames' structure (1 = all of it)."""
    references = [torch.from_numpy(load_image(path, upright=True)).float() / 255 for path in config.references]
    references = [_reduced(image) for image in references]
    here, there = matched_regions(BundledSemanticConfig().build(), plain, references, regions=REGIONS, seed=0)
    judge = {"bundled-content": BundledContentConfig().build()}
    before, target = list(zip(plain, here, strict=True)), list(zip(references, there, strict=True))
    found = style_distances(judge, before, {"frames": list(zip(styled, here, strict=True))}, target)
    kept = [structure(a, b) for a, b in zip(plain, styled, strict=True)]
    return {"style_distance": found["frames"]["mean"], "structure": sum(kept) / len(kept)}


def _reduced(image: Tensor) -> Tensor:
    scale = _LARGEST / max(image.shape[:2])
    if scale >= 1:
        return image
    size = [max(1, round(side * scale)) for side in image.shape[:2]]
    return torch.nn.functional.interpolate(image.permute(2, 0, 1)[None], size, mode="area")[0].permute(1, 2, 0)


def _size(image: Tensor) -> str:
    return f"{image.shape[1]}x{image.shape[0]}"
