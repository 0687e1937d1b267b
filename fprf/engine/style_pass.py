"""One exact pass over the trained scene: the statistics and regions that every style builds on (design: statistics in kind).

Features are those of the very samples that the renderer keeps, weighted by their rendering weights, on a fixed lattice of
pixels over all training views; moments are merged in float64, so neither order nor chunk size matters.
"""

from typing import Annotated

import torch
from torch import Tensor

from ..config import TrainConfig
from ..memory import in_parts
from ..rendering.cameras import Cameras, rays_through
from ..rendering.renderer import march
from ..style.scene import SceneStyle, scene_style
from ..style.statistics import Moments, merge, moments
from .model import Model
from .poses import refined

__all__ = ["POINTS", "lattice", "measure_style"]

POINTS = 2**18
"""Points that regions are measured on, at most: 128 + 64 channels of them take 200 MB."""


def lattice(cameras: Cameras, views: Annotated[Tensor, "V"], rays: int) -> tuple[Tensor, Tensor]:
    """View [R] and pixel [R 2] of about so many pixels, at even steps through all the views' pixels."""
    area = cameras.size[views].prod(-1)
    ends = area.cumsum(0)
    count = min(rays, int(ends[-1]))
    at = (torch.arange(count, dtype=torch.float64) + 0.5) * (float(ends[-1]) / count)
    at = at.long()
    which = torch.searchsorted(ends, at, right=True)
    within = at - (ends[which] - area[which])
    view = views[which]
    width = cameras.size[view, 0]
    return view, torch.stack([within % width, within // width], -1) + 0.5


@torch.inference_mode()
def measure_style(config: TrainConfig, model: Model, cameras: Cameras, views: Annotated[Tensor, "V"]) -> SceneStyle:
    """Content statistics over the training views and the scene's semantic regions, on the CPU.

    `cameras` are the capture's; the model's own poses, if it has any, are taken into account here.
    """
    cameras = refined(model.poses, cameras)
    device = model.device
    view, pixel = lattice(cameras, views, config.statistics.rays)
    whole = None

    def part_of(part: slice) -> tuple[Moments, Tensor, Tensor, Tensor | None]:
        rays = model.space.rays(*rays_through(cameras, view[part], pixel[part]))
        rays = type(rays)(*(x.to(device) for x in rays))
        kept = march(rays, model.parts, budget=config.render.budget).kept
        content = model.field.content(kept.latent, kept.view)
        own = Moments(*(x.cpu() for x in moments(content, kept.weight)))
        # Regions are found and measured on an even share of the points; whole moments above see every one.
        every = max(1, -(-len(content) * config.statistics.rays // (len(rays.near) * POINTS)))
        semantic = model.semantic(kept.point[::every]).cpu() if model.semantic is not None else None
        return own, content[::every].cpu(), kept.weight[::every].cpu(), semantic

    contents, weights, semantics = [], [], []
    for own, content, weight, semantic in in_parts(len(view), config.render.chunk, part_of):
        whole = own if whole is None else merge(whole, own)
        contents.append(content)
        weights.append(weight)
        if semantic is not None:
            semantics.append(semantic)
    return scene_style(
        torch.cat(contents),
        torch.cat(semantics) if semantics else None,
        torch.cat(weights),
        whole,
        config.statistics.regions,
        config.seed,
    )
