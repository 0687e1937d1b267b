"""Depth maps of a trained scene's views: the distance at which half of each ray's light has been met."""

import math
from collections.abc import Callable, Sequence
from typing import Annotated

import torch
from torch import Tensor

from ..config import RenderConfig
from ..memory import chunk_size, in_parts
from ..rendering.cameras import Cameras, pixel_grid, rays_through
from ..rendering.renderer import march
from ..rendering.space import Space
from ..training.model import Model
from ..training.views import on_host
from ..types import Rays
from .sights import Sights

__all__ = ["chosen", "half_way", "reach_of", "render_sights"]

_SOLID = 0.5
"""Rays of a smaller opacity meet nothing."""


_THICKEST = 2.0
"""Surfaces are taken for no thicker than so many times their distance."""

_REACH = 20.0
"""What is farther than so many inner radii of a contraction is sky, unless the user says otherwise."""
_REACH_AHEAD = 50.0
"""The same for captures that look one way, in distances of the nearest thing."""


def reach_of(space: Space) -> float:
    """How far surfaces are looked for, in world units: a bounded box is looked at as a whole."""
    return math.inf if space.kind == "box" else _REACH_AHEAD * space.near if space.kind == "ndc" else _REACH / space.scale


def chosen(views: Sequence[int], most: int) -> list[int]:
    """At most so many of the views, spread evenly over their order."""
    if len(views) <= most:
        return list(views)
    return [views[round(k * (len(views) - 1) / max(1, most - 1))] for k in range(most)]


@torch.inference_mode()
def render_sights(
    model: Model,
    cameras: Cameras,
    views: Sequence[int],
    config: RenderConfig,
    *,
    side: int,
    reach: float,
    report: Callable[[int, int], None] = lambda done, total: None,
) -> Sights:
    """Depth maps of some views, reduced to `side` pixels on the longest; what is farther than `reach` world units is sky."""
    some = cameras.select(torch.tensor(list(views)))
    size = some.size.double()
    factor = (size.amax(1, keepdim=True) / side).clamp_min(1)
    some = some.resized((size / factor).round().clamp_min(1).to(some.size))
    maps = []
    for view in range(len(some)):
        report(view, len(some))
        maps.append(_depth(model, some, view, config, reach))
    report(len(some), len(some))
    depths, thicknesses = zip(*maps, strict=True)
    return Sights(some, depths, thicknesses)


def half_way(
    weights: Annotated[Tensor, "R S"], t: Annotated[Tensor, "R E"], share: Annotated[Tensor, "R"]
) -> Annotated[Tensor, "R"]:
    """Ray parameter before which each ray has met `share` of weight, weight being spread evenly over its step.

    Unlike the mean it lies on a surface where a ray meets two of them.
    """
    met = weights.cumsum(-1)
    step = (met < share[:, None]).sum(-1, keepdim=True).clamp(max=weights.shape[1] - 1)
    here = weights.gather(1, step)
    part = ((share[:, None] - (met.gather(1, step) - here)) / here.clamp_min(1e-10)).clamp(0, 1)
    low, high = t.gather(1, step), t.gather(1, step + 1)
    return (low + part * (high - low))[:, 0]


def _depth(model: Model, cameras: Cameras, view: int, config: RenderConfig, reach: float) -> tuple[Tensor, Tensor]:
    """Depth and thickness [H W] of a view's surfaces."""
    device = model.device
    pixel = pixel_grid(cameras, view)
    origin, direction = rays_through(cameras, torch.full((len(pixel),), view), pixel)
    rays = model.space.rays(origin, direction)

    def met(here: slice) -> tuple[Tensor, Tensor]:
        marched = march(Rays(*(x[here].to(device) for x in rays)), model.parts, budget=config.budget)
        parts = [half_way(marched.weights, marched.sampled.t, share * marched.opacity) for share in (0.1, 0.5, 0.9)]
        return torch.stack(parts, 1), marched.opacity

    parts = zip(*in_parts(len(pixel), chunk_size(config.chunk, device), met), strict=True)
    t, opacity = on_host(*(torch.cat(part) for part in parts))
    first, depth, last = (model.space.metric(origin, direction, part).float() for part in t.unbind(1))
    seen = (opacity > _SOLID) & (depth < reach) & (depth > 0)
    width, height = (int(v) for v in cameras.size[view])
    thickness = ((last.clamp(max=reach) - first) / depth).clamp(0, _THICKEST)
    return torch.where(seen, depth, torch.inf).view(height, width), torch.where(seen, thickness, 0.0).view(height, width)
