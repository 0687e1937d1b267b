"""Colours of points, plain or restyled: what the view that sees a point best sees on the ray through it."""

from collections.abc import Callable, Sequence
from typing import Annotated

import torch
from torch import Tensor

from ..config import RenderConfig
from ..engine.model import Facts, Model, background_of
from ..rendering.cameras import Cameras
from ..rendering.renderer import Kept, Parts, Restyle, composite, march
from ..types import Rays, Want

__all__ = ["paint", "seen_colours"]


def paint(kept: Kept, parts: Parts, styles: Sequence[Restyle | None]) -> list[Annotated[Tensor, "M 3"]]:
    """Colours of samples in several styles (None = plain): features and semantics are computed once for all."""
    features = parts.field.content(kept.latent, kept.view)
    shown = [None if style is None or style.idle else style for style in styles]
    semantic = None
    if parts.semantic is not None and any(style is not None and Want.SEMANTIC in style.needs for style in shown):
        semantic = parts.semantic(kept.point)
    return [parts.decoder(features) if s is None else s.colour(parts.decoder, features, semantic) for s in shown]


@torch.inference_mode()
def seen_colours(
    model: Model,
    facts: Facts,
    cameras: Cameras,
    points: Annotated[Tensor, "N 3"],
    view: Annotated[Tensor, "N"],
    config: RenderConfig,
    styles: Sequence[Restyle | None],
    report: Callable[[int, int], None] = lambda done, total: None,
) -> list[Annotated[Tensor, "N 3"]]:
    """sRGB in [0, 1] of world points, one set a style (None = plain), on the rays from their views' centres.

    The geometry is the same for all, and only as many rays as points are marched, however many views there are.
    """
    device = next(model.parameters()).device
    origin = cameras.pose[view, :, 3]
    rays = model.space.rays(origin, torch.nn.functional.normalize(points - origin, dim=-1))
    background = background_of(facts, device)
    found: list[list[Tensor]] = [[torch.zeros(0, 3)] for _ in styles]
    for start in range(0, len(points), config.chunk):
        report(start, len(points))
        part = Rays(*(x[start : start + config.chunk].to(device) for x in rays))
        marched = march(part, model.parts, budget=config.budget)
        behind = 0.0 if background is None else marched.through[:, None] * background
        for colours, colour in zip(found, paint(marched.kept, model.parts, styles), strict=True):
            colours.append((composite(marched.kept, colour, len(part.near)) + behind).clamp(0, 1).cpu())
    report(len(points), len(points))
    return [torch.cat(colours) for colours in found]
