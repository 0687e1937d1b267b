"""One view in many looks: geometry, features and semantics are computed once, each style is applied to the same samples."""

from collections.abc import Mapping
from typing import Annotated

import torch
from torch import Tensor

from ..config import RenderConfig
from ..memory import chunk_size, in_parts
from ..rendering.cameras import Cameras, pixel_grid, rays_through
from ..rendering.renderer import composite, march
from ..style.look import Restyle
from ..training.model import Facts, Model, background_of
from ..training.views import on_host
from ..types import Rays, Want

__all__ = ["render_looks"]


@torch.inference_mode()
def render_looks(
    model: Model, facts: Facts, cameras: Cameras, view: int, config: RenderConfig, looks: Mapping[str, Restyle | None]
) -> tuple[dict[str, Annotated[Tensor, "H W 3"]], Annotated[Tensor, "H W"]]:
    """A picture for each look (None: unstylised), in [0, 1], and the depth in world units: what `render_view` gives."""
    pixel = pixel_grid(cameras, view)
    origin, direction = rays_through(cameras, torch.full((len(pixel),), view), pixel)
    device = model.device
    rays = Rays(*(x.to(device) for x in model.space.rays(origin, direction)))
    background = background_of(facts, device)
    asks = any(look is not None and Want.SEMANTIC in look.needs for look in looks.values())

    def shown(here: slice) -> tuple[dict[str, Tensor], Tensor]:
        part = Rays(*(x[here] for x in rays))
        marched = march(part, model.parts, budget=config.budget)
        content = model.field.content(marched.kept.latent, marched.kept.view)
        semantic = model.semantic(marched.kept.point) if asks and model.semantic is not None else None
        pictures = {}
        for name, look in looks.items():
            colour = model.decoder(content) if look is None else look.colour(model.decoder, content, semantic)
            rgb = composite(marched.kept, colour, len(part.near))
            pictures[name] = rgb if background is None else rgb + marched.through[:, None] * background
        return pictures, marched.depth

    found = list(in_parts(len(pixel), chunk_size(config.chunk, device), shown))
    width, height = (int(side) for side in cameras.size[view])
    *colours, depth = on_host(
        *(torch.cat([part[name] for part, _ in found]) for name in looks), torch.cat([d for _, d in found])
    )
    return (
        {name: colour.view(height, width, 3).clamp(0, 1) for name, colour in zip(looks, colours, strict=True)},
        model.space.metric(origin, direction, depth).view(height, width),
    )
