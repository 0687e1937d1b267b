"""Whole images from a trained model."""

from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ..config import RenderConfig
from ..interfaces import Stylizer
from ..rendering.cameras import Cameras, pixel_grid, rays_through
from ..rendering.renderer import Restyle, composite, march, render_rays
from ..types import Rays, Want
from .model import Facts, Model, background_of

__all__ = ["View", "match_view", "render_view"]


class View(NamedTuple):
    """One rendered view, on the CPU."""

    rgb: Annotated[Tensor, "H W 3"]
    depth: Annotated[Tensor, "H W"]
    """Distance along the unit ray in world units."""
    opacity: Annotated[Tensor, "H W"]
    kept: float
    """Share of the samples that met the content network."""


def _view_rays(model: Model, cameras: Cameras, view: int) -> tuple[Rays, Tensor, Tensor]:
    device = next(model.parameters()).device
    pixel = pixel_grid(cameras, view)
    origin, direction = rays_through(cameras, torch.full((len(pixel),), view), pixel)
    rays = model.space.rays(origin, direction)
    return Rays(*(x.to(device) for x in rays)), origin, direction


@torch.inference_mode()
def render_view(
    model: Model, facts: Facts, cameras: Cameras, view: int, config: RenderConfig, restyle: Restyle | None = None
) -> View:
    """Colour and depth of one view, in chunks of `config.chunk` rays."""
    rays, origin, direction = _view_rays(model, cameras, view)
    background = background_of(facts, rays.origin.device)
    rgb, depth, opacity, kept, samples = [], [], [], 0, 0
    for start in range(0, len(rays.near), config.chunk):
        part = Rays(*(x[start : start + config.chunk] for x in rays))
        out = render_rays(part, model.parts, want=Want.COLOUR, budget=config.budget, background=background, restyle=restyle)
        assert out.rgb is not None
        rgb.append(out.rgb.cpu())
        depth.append(out.depth.cpu())
        opacity.append(out.opacity.cpu())
        kept, samples = kept + out.counts["kept"], samples + out.counts["samples"]
    width, height = (int(v) for v in cameras.size[view])
    metric = model.space.metric(origin, direction, torch.cat(depth))
    return View(
        torch.cat(rgb).view(height, width, 3).clamp(0, 1),
        metric.view(height, width),
        torch.cat(opacity).view(height, width),
        kept / max(1, samples),
    )


@torch.inference_mode()
def match_view(
    model: Model, cameras: Cameras, view: int, config: RenderConfig, stylizer: Stylizer
) -> Annotated[Tensor, "H W T"]:
    """Which style code each pixel takes: the composited attention, scaled to sum to 1 (0 where nothing is)."""
    rays, _, _ = _view_rays(model, cameras, view)
    parts = []
    for start in range(0, len(rays.near), config.chunk):
        chunk = Rays(*(x[start : start + config.chunk] for x in rays))
        kept = march(chunk, model.parts, budget=config.budget).kept
        semantic = (
            model.semantic(kept.point)
            if model.semantic is not None and Want.SEMANTIC in stylizer.needs
            else kept.point.new_zeros(len(kept.point), 0)
        )
        attention = composite(kept, stylizer.match(semantic), len(chunk.near))
        parts.append((attention / attention.sum(-1, keepdim=True).clamp_min(1e-10)).cpu())
    width, height = (int(v) for v in cameras.size[view])
    return torch.cat(parts).view(height, width, -1)
