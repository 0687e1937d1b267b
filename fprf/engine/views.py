"""Whole images from a trained model."""

from collections.abc import Callable
from dataclasses import replace
from typing import Annotated, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from ..config import RenderConfig
from ..interfaces import Stylizer
from ..memory import in_parts
from ..rendering.cameras import Cameras, pixel_grid, rays_through
from ..rendering.pixel_rays import grid_rays
from ..rendering.renderer import Restyle, composite, march, render_rays
from ..types import Rays, Rendered, Want
from .model import Facts, Model, background_of

__all__ = ["View", "match_view", "paint_pixels", "render_view", "view_rays"]


class View(NamedTuple):
    """One rendered view, on the CPU."""

    rgb: Annotated[Tensor, "H W 3"]
    depth: Annotated[Tensor, "H W"]
    """Distance along the unit ray in world units."""
    opacity: Annotated[Tensor, "H W"]
    kept: float
    """Share of the samples that met the content network."""


def view_rays(
    model: Model, cameras: Cameras, view: int, pixel: Annotated[Tensor, "R 2"] | None = None
) -> tuple[Rays, Annotated[Tensor, "R 3"], Annotated[Tensor, "R 3"]]:
    """Rays through some pixels of a view, or all, on the model's device; their origins and directions in the world."""
    if pixel is None:
        origin, direction = grid_rays(cameras, view)
    else:
        origin, direction = rays_through(cameras, torch.full((len(pixel),), view), pixel)
    device = next(model.parameters()).device
    return Rays(*(x.to(device) for x in model.space.rays(origin, direction))), origin, direction


@torch.inference_mode()
def render_view(
    model: Model,
    facts: Facts,
    cameras: Cameras,
    view: int,
    config: RenderConfig,
    restyle: Restyle | None = None,
    factor: Annotated[Tensor, "3"] | None = None,
) -> View:
    """Colour and depth of one view, in chunks of `config.chunk` rays; below `config.resolution` 1 from fewer of them.

    Colours are multiplied by `factor`, if one is given: how a camera took them (`tones`); else by the config's tone.
    """
    if factor is None and config.tone is not None:
        factor = torch.tensor(config.tone)
    if config.resolution < 1:
        small = cameras.select(torch.tensor([view])).scaled(1 / config.resolution)
        whole = replace(config, resolution=1.0)
        return _enlarged(render_view(model, facts, small, 0, whole, restyle, factor), cameras.size[view].tolist())
    rays, origin, direction = view_rays(model, cameras, view)
    background = background_of(facts, rays.origin.device)
    rgb, depth, opacity, kept, samples = [], [], [], 0, 0

    def render(here: slice) -> Rendered:
        part = Rays(*(x[here] for x in rays))
        return render_rays(part, model.parts, want=Want.COLOUR, budget=config.budget, background=background, restyle=restyle)

    for out in in_parts(len(rays.near), config.chunk, render):
        assert out.rgb is not None
        rgb.append(out.rgb.cpu())
        depth.append(out.depth.cpu())
        opacity.append(out.opacity.cpu())
        kept, samples = kept + out.counts["kept"], samples + out.counts["samples"]
    width, height = (int(v) for v in cameras.size[view])
    metric = model.space.metric(origin, direction, torch.cat(depth))
    return View(
        (torch.cat(rgb) * (1.0 if factor is None else factor.cpu())).view(height, width, 3).clamp(0, 1),
        metric.view(height, width),
        torch.cat(opacity).view(height, width),
        kept / max(1, samples),
    )


def _enlarged(small: View, size: list[int]) -> View:
    """The view at another width and height. Depths stay what they are: between near and far there is nothing."""
    target = size[::-1]
    rgb = F.interpolate(small.rgb.permute(2, 0, 1)[None], target, mode="bicubic")[0].permute(1, 2, 0)
    depth = F.interpolate(small.depth[None, None], target, mode="nearest-exact")[0, 0]
    opacity = F.interpolate(small.opacity[None, None], target, mode="bilinear")[0, 0]
    return View(rgb.clamp(0, 1).contiguous(), depth, opacity, small.kept)


@torch.inference_mode()
def match_view(
    model: Model, cameras: Cameras, view: int, config: RenderConfig, stylizer: Stylizer
) -> Annotated[Tensor, "H W T"]:
    """Which style code each pixel takes: the composited attention, scaled to sum to 1 (0 where nothing is)."""
    asks = Want.SEMANTIC in stylizer.needs
    attention, _ = paint_pixels(model, cameras, view, pixel_grid(cameras, view), config, stylizer.match, semantic=asks)
    width, height = (int(v) for v in cameras.size[view])
    return attention.view(height, width, -1)


@torch.inference_mode()
def paint_pixels(
    model: Model,
    cameras: Cameras,
    view: int,
    pixel: Annotated[Tensor, "R 2"],
    config: RenderConfig,
    values: Callable[[Annotated[Tensor, "M D"]], Annotated[Tensor, "M X"]],
    *,
    semantic: bool = True,
) -> tuple[Annotated[Tensor, "R X"], Annotated[Tensor, "R"]]:
    """Means over what each pixel sees of anything that follows from semantics, and the opacity; on the CPU.

    Pixels that see nothing get 0. `values` is given features without channels where the scene has no semantics or
    `semantic` is false. Neither content nor colour is computed.
    """
    rays, _, _ = view_rays(model, cameras, view, pixel)

    def paint(here: slice) -> tuple[Tensor, Tensor]:
        chunk = Rays(*(x[here] for x in rays))
        marched = march(chunk, model.parts, budget=config.budget)
        kept, field = marched.kept, model.semantic if semantic else None
        found = values(kept.point[:, :0] if field is None else field(kept.point))
        mass = composite(kept, torch.ones_like(kept.weight)[:, None], len(chunk.near))
        return (composite(kept, found, len(chunk.near)) / mass.clamp_min(1e-10)).cpu(), marched.opacity.cpu()

    painted, opacity = zip(*in_parts(len(rays.near), config.chunk, paint), strict=True)
    return torch.cat(painted), torch.cat(opacity)
