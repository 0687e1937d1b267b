"""Depth maps of a trained scene's views, the surfaces in them, and the gap between points of the world and those surfaces.

The gap of a point in a view is the depth that the view has at the point's pixel less the point's distance: about 0 where
the view sees the point, positive where it looks past it (the point floats), negative where something hides it. Depths are
world distances along the unit ray through a pixel's centre, at which half of the ray's light has been met, infinite where
nothing is within reach.
"""

import math
from collections.abc import Callable, Sequence
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ..config import RenderConfig
from ..memory import chunk_size, in_parts
from ..rendering.cameras import Cameras, pixel_grid, project, rays_through
from ..rendering.renderer import march
from ..rendering.space import Space
from ..training.model import Model
from ..training.views import on_host
from ..types import Rays

_TORN = 1.25
"""Neighbouring pixels whose depths differ by more than this factor lie on different surfaces: far ground falls away fast."""
_BENT = 3.0
"""Factor between the steps to a pixel's two neighbours beyond which an edge runs on the longer one's side."""


class DepthMaps(NamedTuple):
    """V depth maps with their cameras."""

    cameras: Cameras
    depth: tuple[Annotated[Tensor, "H W"], ...]
    """float32."""
    thickness: tuple[Annotated[Tensor, "H W"], ...] = ()
    """Thickness of the surface that each pixel sees, as a share of its depth, float32: its ray meets 80 % of its light
    over that distance. Empty where surfaces are sharp."""


class Surface(NamedTuple):
    """The N pixels of a view in which a surface with a direction is seen."""

    point: Annotated[Tensor, "N 3"]
    """float64, local."""
    normal: Annotated[Tensor, "N 3"]
    """float32, unit, towards the camera."""
    facing: Annotated[Tensor, "N"]
    """Cosine between the normal and the way to the camera, 0 to 1."""
    footprint: Annotated[Tensor, "N"]
    """World size of the pixel at its depth, seen head-on."""


def surface_points(maps: DepthMaps, view: int) -> Surface:
    """Points and normals of a view's depth map; pixels at the border are left out."""
    point, normal, towards = _directed(maps, view)
    depth = maps.depth[view].double()
    inner = torch.zeros_like(depth, dtype=torch.bool)
    inner[1:-1, 1:-1] = True
    whole = inner & depth.isfinite() & (towards > 0)
    size = depth[whole] / maps.cameras.focal[view].mean()
    return Surface(point[whole], normal[whole].float(), towards[whole].float(), size.float())


def cosine_map(maps: DepthMaps, view: int) -> Annotated[Tensor, "H W"]:
    """Cosine between each pixel's normal and the way to the camera, float64; 0 where there is no surface."""
    _, _, towards = _directed(maps, view)
    return torch.where(maps.depth[view].isfinite(), towards, 0.0).clamp_min(0)


def _directed(maps: DepthMaps, view: int) -> tuple[Tensor, Tensor, Tensor]:
    """Points [H W 3], normals [H W 3] and their cosines [H W] of all pixels.

    Normals come from the steps to neighbouring pixels on the same surface, on one side alone at an edge; what is a pixel
    thin faces the camera.
    """
    cameras, depth = maps.cameras, maps.depth[view].double()
    height, width = depth.shape
    origin, direction = _rays(cameras, view)
    here = depth.isfinite()
    point = (origin + direction * torch.where(here, depth, 1.0).view(-1, 1)).view(height, width, 3)
    size = torch.where(here, depth, 0.0) / cameras.focal[view].mean()
    right, up = cameras.pose[view, :, 0], cameras.pose[view, :, 1]
    across = _step(point, depth, 1, size[..., None] * right)
    down = _step(point, depth, 0, size[..., None] * -up)
    # Image rows run downwards: down x across points back to the camera.
    normal = torch.nn.functional.normalize(torch.linalg.cross(down, across), dim=-1)
    return point, normal, -(normal * direction.view(height, width, 3)).sum(-1)


def _rays(cameras: Cameras, view: int) -> tuple[Annotated[Tensor, "N 3"], Annotated[Tensor, "N 3"]]:
    """Through all pixels. Not `grid_rays`: its rounding would change the files of earlier exports."""
    pixel = pixel_grid(cameras, view)
    return rays_through(cameras, torch.full((len(pixel),), view), pixel)


def _step(
    point: Annotated[Tensor, "H W 3"], depth: Annotated[Tensor, "H W"], axis: int, flat: Annotated[Tensor, "H W 3"]
) -> Annotated[Tensor, "H W 3"]:
    """Displacement of the surface from one pixel to the next along an axis; `flat` where neither neighbour belongs to it."""
    before, after = point - point.roll(1, axis), point.roll(-1, axis) - point
    joined = []
    for shift in (1, -1):
        other = depth.roll(shift, axis)
        joined.append((other < _TORN * depth) & (depth < _TORN * other))
    long, short = torch.linalg.vector_norm(before, dim=-1), torch.linalg.vector_norm(after, dim=-1)
    from_before = joined[0] & (~joined[1] | (long < _BENT * short))
    from_after = joined[1] & (~joined[0] | (short < _BENT * long))
    count = from_before.double() + from_after.double()
    step = (before * from_before[..., None] + after * from_after[..., None]) / count.clamp_min(1)[..., None]
    return torch.where(count[..., None] > 0, step, flat)


def depth_gaps(
    maps: DepthMaps, view: int, points: Annotated[Tensor, "N 3"]
) -> tuple[Annotated[Tensor, "N"], Annotated[Tensor, "N"]]:
    """Gap of each world point, infinite where the view sees nothing and NaN outside of it, and its distance; float64."""
    cameras = maps.cameras
    pixel, _ = project(cameras, torch.full((len(points),), view, dtype=torch.int64), points)
    distance = torch.linalg.vector_norm(points - cameras.pose[view, :, 3], dim=-1)
    size = cameras.size[view].to(pixel)
    inside = ((pixel >= 0) & (pixel <= size)).all(-1).nonzero()[:, 0]
    gap = torch.full_like(distance, torch.nan)
    gap[inside] = _lookup(maps.depth[view], pixel[inside]) - distance[inside]
    return gap, distance


def at_nearest(
    maps: DepthMaps, view: int, values: Annotated[Tensor, "H W"], points: Annotated[Tensor, "N 3"]
) -> Annotated[Tensor, "N"]:
    """Values at the pixels of a view that world points fall on; beside the image, those at its border."""
    pixel, _ = project(maps.cameras, torch.full((len(points),), view, dtype=torch.int64), points)
    height, width = values.shape
    x, y = torch.nan_to_num(pixel).long().unbind(-1)
    return values[y.clamp(0, height - 1), x.clamp(0, width - 1)]


def _lookup(depth: Annotated[Tensor, "H W"], pixel: Annotated[Tensor, "N 2"]) -> Annotated[Tensor, "N"]:
    """Depths between pixel centres: linear in 1/depth, as a plane is, or the nearest pixel's where a surface is torn."""
    height, width = depth.shape
    at = (pixel - 0.5).clamp_min(0)
    x = at[:, 0].clamp(max=width - 1)
    y = at[:, 1].clamp(max=height - 1)
    left, top = x.long().clamp(max=max(width - 2, 0)), y.long().clamp(max=max(height - 2, 0))
    right, low = (left + 1).clamp(max=width - 1), (top + 1).clamp(max=height - 1)
    fx, fy = x - left, y - top
    flat = depth.double().view(-1)
    corner = torch.stack(
        [flat[top * width + left], flat[top * width + right], flat[low * width + left], flat[low * width + right]]
    )
    part = torch.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy])
    whole = corner.amax(0) < _TORN * corner.amin(0)  # never where one is infinite
    smooth = 1 / (part / torch.where(whole, corner, 1.0)).sum(0)
    nearest = flat[torch.where(fy > 0.5, low, top) * width + torch.where(fx > 0.5, right, left)]
    return torch.where(whole, smooth, nearest)


_SOLID = 0.5
"""Rays of a smaller opacity meet nothing."""
_THICKEST = 2.0
"""Surfaces are taken for no thicker than so many times their distance."""
_REACH = 20.0
"""Distance of the sky in inner radii of a contraction, unless the user says otherwise."""
_REACH_AHEAD = 50.0
"""The same for captures that look one way, in distances of the nearest thing."""


def default_reach(space: Space) -> float:
    """Distance up to which surfaces are looked for, in world units: a bounded box is looked at as a whole."""
    return math.inf if space.kind == "box" else _REACH_AHEAD * space.near if space.kind == "ndc" else _REACH / space.scale


def spread_views(views: Sequence[int], most: int) -> list[int]:
    """At most so many of the views, spread evenly over their order."""
    if len(views) <= most:
        return list(views)
    return [views[round(k * (len(views) - 1) / max(1, most - 1))] for k in range(most)]


@torch.inference_mode()
def render_depth_maps(
    model: Model,
    cameras: Cameras,
    views: Sequence[int],
    config: RenderConfig,
    *,
    side: int,
    reach: float,
    report: Callable[[int, int], None] = lambda done, total: None,
) -> DepthMaps:
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
    return DepthMaps(some, depths, thicknesses)


def ray_quantile(
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
    origin, direction = _rays(cameras, view)
    rays = model.space.rays(origin, direction)

    def met(here: slice) -> tuple[Tensor, Tensor]:
        marched = march(Rays(*(x[here].to(device) for x in rays)), model.parts, budget=config.budget)
        parts = [ray_quantile(marched.weights, marched.sampled.t, share * marched.opacity) for share in (0.1, 0.5, 0.9)]
        return torch.stack(parts, 1), marched.opacity

    parts = zip(*in_parts(len(origin), chunk_size(config.chunk, device), met), strict=True)
    t, opacity = on_host(*(torch.cat(part) for part in parts))
    first, depth, last = (model.space.metric(origin, direction, part).float() for part in t.unbind(1))
    seen = (opacity > _SOLID) & (depth < reach) & (depth > 0)
    width, height = (int(v) for v in cameras.size[view])
    thickness = ((last.clamp(max=reach) - first) / depth).clamp(0, _THICKEST)
    return torch.where(seen, depth, torch.inf).view(height, width), torch.where(seen, thickness, 0.0).view(height, width)
