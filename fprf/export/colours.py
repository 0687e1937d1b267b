"""Colours of points, plain or restyled: what the views that see a point best see there.

A ray is followed only close to the point, so that nothing before or behind it, as at the edge of a nearer thing, mixes in.
Views are averaged: one alone would give neighbours the moods of different pictures.
"""

import math
from collections.abc import Callable, Sequence
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ..config import RenderConfig
from ..memory import chunk_size
from ..plugins.samplers.config import UniformConfig
from ..plugins.samplers.samplers import UniformSampler
from ..rendering.cameras import Cameras
from ..rendering.renderer import March, Parts, composite, march_features, shade
from ..style.look import Restyle
from ..training.model import Facts, Model, background_of
from ..training.views import on_host
from ..types import Rays, Want
from .depth_maps import DepthMaps, at_nearest, depth_gaps

_DECAY = math.log(9)
"""Extinctions of a uniform medium over the distance in which a ray meets the middle 80 % of its light."""
_GRAZING = 1e-3
"""Smallest cosine: a view that sees a surface from its edge still says more than none."""


class BestViews(NamedTuple):
    """Of N points the K views that see each best."""

    view: Annotated[Tensor, "N K"]
    """int64 index among the maps, the best first."""
    weight: Annotated[Tensor, "N K"]
    """1 for the best, less for the others, 0 for views that do not see the point; float64."""


def single_view(view: Annotated[Tensor, "N"]) -> BestViews:
    """One view a point."""
    return BestViews(view[:, None], torch.ones(len(view), 1, dtype=torch.float64))


def best_views(
    maps: DepthMaps,
    point: Annotated[Tensor, "N 3"],
    normal: Annotated[Tensor, "N 3"],
    near: Annotated[Tensor, "N"] | float,
    count: int = 1,
) -> BestViews:
    """The finest and straightest of the views that see each point; where none does, the one that misses it least.

    A view sees what lies within 2 `near` of its surface, in world units. A view counts as many times as it has pixels on
    the surface: cosine / distance^2.
    """
    count = min(count, len(maps.depth))
    best = torch.full((len(point), count), -torch.inf, dtype=torch.float64)
    chosen = torch.zeros(len(point), count, dtype=torch.int64)
    for view in range(len(maps.depth)):
        gap, distance = depth_gaps(maps, view, point)
        way = (maps.cameras.pose[view, :, 3] - point) / distance[:, None]
        facing = (way * normal.double()).sum(-1).clamp_min(_GRAZING)
        # Both kinds of score in one: positive where it is seen, negative where not.
        missed = torch.nan_to_num(gap.abs(), nan=1e18, posinf=1e17)
        score = torch.where(missed <= 2 * near, facing / distance.square(), -missed)
        scores = torch.cat([best, score[:, None]], 1)
        views = torch.cat([chosen, torch.full((len(point), 1), view)], 1)
        best, order = scores.topk(count, 1)
        chosen = views.gather(1, order)
    weight = (best / best[:, :1].clamp_min(1e-300)).clamp_min(0)
    weight[:, 0] = 1
    return BestViews(chosen, weight)


def expected_presence(
    maps: DepthMaps, point: Annotated[Tensor, "N 3"], seen: BestViews, tolerance: float
) -> Annotated[Tensor, "N"]:
    """Share of light from within `tolerance` of a point's distance where it lies in a surface as thick as its views see.

    1 for sharp surfaces. A surface that training has left thick, as far ones in forward-facing captures are, has only a part of
    its light there; between two surfaces, where nothing is, less light comes than from either. In (0, 1], float32.
    """
    total, weight = torch.zeros(len(point)), torch.zeros(len(point))
    if not maps.thickness:
        return torch.ones(len(point))
    for view, thickness in enumerate(maps.thickness):
        row, rank = ((seen.view == view) & (seen.weight > 0)).nonzero().unbind(1)
        thick = at_nearest(maps, view, thickness, point[row])
        light = -torch.expm1(-_DECAY * 2 * tolerance / thick.clamp_min(1e-6))
        share = seen.weight[row, rank].float()
        total.index_add_(0, row, light * share)
        weight.index_add_(0, row, share)
    return torch.where(weight > 0, total / weight.clamp_min(1e-10), 1.0)


_CLOSE = UniformSampler(UniformConfig(samples=8))
"""Steps along the piece of a ray that is close to a point."""
_LOST = 1e-3
"""Least light from a point: below, the colour of the whole ray is taken."""


class Coloured(NamedTuple):
    """N points in one or more looks."""

    colours: list[Annotated[Tensor, "N 3"]]
    """sRGB in [0, 1], one set a look."""
    presence: Annotated[Tensor, "N"]
    """Share of light from close to a point, in [0, 1]: low where it floats before or behind the field's own surface,
    and where that is thick (see `expected_presence`)."""


def colours_in_styles(
    rays: Rays, parts: Parts, budget: float, styles: Sequence[Restyle | None], *, semantic: bool = False
) -> tuple[March, list[Annotated[Tensor, "R 3"]], Annotated[Tensor, "M D"] | None]:
    """March R rays once and composite their colours in several styles (None = plain), without any background.

    Semantics of the kept samples are computed where a style needs them or `semantic` asks for them.
    """
    needed = any(style is not None and not style.idle and Want.SEMANTIC in style.needs for style in styles)
    marched, content, semantics = march_features(rays, parts, budget=budget, semantic=semantic or needed)
    colours = [composite(marched.kept, shade(parts.decoder, content, semantics, s), len(rays.near)) for s in styles]
    return marched, colours, semantics


@torch.inference_mode()
def point_colours(
    model: Model,
    facts: Facts,
    cameras: Cameras,
    points: Annotated[Tensor, "N 3"],
    seen: BestViews,
    config: RenderConfig,
    styles: Sequence[Restyle | None],
    *,
    tolerance: float | None,
    report: Callable[[int, int], None] = lambda done, total: None,
) -> Coloured:
    """Colours of world points, one set a style (None = plain), from the rays of the views that see each.

    What lies farther from the point than `tolerance` of its distance is left out; None = the whole ray, with the background.
    The geometry is the same for all styles.
    """
    sums = torch.zeros(len(points), 3 * len(styles))
    light, share = torch.zeros(len(points)), torch.zeros(len(points))
    total = int((seen.weight > 0).sum())
    done = 0
    size = chunk_size(config.chunk, model.device)
    for rank in range(seen.view.shape[1]):
        for part in torch.split((seen.weight[:, rank] > 0).nonzero()[:, 0], size):
            report(done, total)
            done += len(part)
            colours, opacity = _looked(model, facts, cameras, points[part], seen.view[part, rank], config, styles, tolerance)
            weight = seen.weight[part, rank].float()
            sums[part] += colours * weight[:, None]
            light[part] += opacity * weight
            share[part] += weight
    report(total, total)
    presence = light / share.clamp_min(1e-10)
    colour = (sums / (share if tolerance is None else light).clamp_min(1e-10)[:, None]).clamp(0, 1)
    lost = (presence < _LOST).nonzero()[:, 0]
    if tolerance is not None and len(lost):
        first = single_view(seen.view[lost, 0])
        whole = point_colours(model, facts, cameras, points[lost], first, config, styles, tolerance=None)
        colour[lost] = torch.cat(whole.colours, 1)
    return Coloured(list(torch.split(colour, 3, 1)), presence)


def _looked(
    model: Model,
    facts: Facts,
    cameras: Cameras,
    points: Annotated[Tensor, "R 3"],
    view: Annotated[Tensor, "R"],
    config: RenderConfig,
    styles: Sequence[Restyle | None],
    tolerance: float | None,
) -> tuple[Annotated[Tensor, "R X"], Annotated[Tensor, "R"]]:
    """Composited colours of all styles side by side, and opacities, of rays from views to points."""
    device = model.device
    origin = cameras.pose[view, :, 3]
    distance = torch.linalg.vector_norm(points - origin, dim=-1)
    direction = (points - origin) / distance[:, None]
    rays = model.space.rays(origin, direction)
    if tolerance is not None:
        ends = (model.space.parameter(origin, direction, distance * (1 + side)).float() for side in (-tolerance, tolerance))
        near, far = (torch.maximum(torch.minimum(end, rays.far), rays.near) for end in ends)
        rays = rays._replace(near=near, far=far)
    # Close to the point there is nothing to be found first: even steps are as good as proposals, and cost a third.
    parts = model.parts if tolerance is None else model.parts._replace(sampler=_CLOSE)
    marched, colours, _ = colours_in_styles(Rays(*(x.to(device) for x in rays)), parts, config.budget, styles)
    background = background_of(facts, device) if tolerance is None else None
    behind = 0.0 if background is None else marched.transmittance[:, None] * background
    composited, opacity = on_host(torch.cat([colour + behind for colour in colours], 1), marched.opacity)
    return composited, opacity
