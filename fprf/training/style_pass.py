"""One exact pass over the trained scene: the statistics and regions that every style builds on.
A second one over pairs of neighbouring pixels tells which regions meet without an edge of colour between
them.

Features are those of the very samples that the renderer keeps, weighted by their rendering weights, on a
fixed lattice of pixels over all training views; moments are merged in float64, so neither order nor chunk
size matters.
"""

from typing import Annotated

import torch
import torch.nn.functional as F
from torch import Tensor

from ..config import TrainConfig
from ..memory import in_parts
from ..rendering.cameras import Cameras, rays_through
from ..rendering.renderer import composite_mean, march_features
from ..style.scene_style import SceneStyle, region_contacts, scene_style
from ..style.statistics import Moments, merge, moments
from .model import Model

POINTS = 2**18
"""Points that regions are measured on, at most: 128 + 64 channels of them take 200 MB."""

_RAYS_A_PAIR = 8
"""One pair for so many rays: a quarter more rays, at a twelfth of the pass's time (fox, 0.32 of 4 s)."""
_NEIGHBOUR_PARTS = 24
"""A neighbour lies so many-th of an image's shorter side away."""


def lattice(cameras: Cameras, views: Annotated[Tensor, "V"], rays: int) -> tuple[Tensor, Tensor]:
    """View [R] and pixel [R 2] of about so many pixels, at even steps through all the views' pixels."""
    area = cameras.size[views].prod(-1)
    ends = area.cumsum(0)
    count = min(rays, int(ends[-1]))
    # Even steps through the pixels of all views, laid end to end: no draw, so a pass can be repeated.
    at = (torch.arange(count, dtype=torch.float64) + 0.5) * (float(ends[-1]) / count)
    at = at.long()
    which = torch.searchsorted(ends, at, right=True)
    within = at - (ends[which] - area[which])
    view = views[which]
    width = cameras.size[view, 0]
    return view, torch.stack([within % width, within // width], -1) + 0.5


def neighbours(cameras: Cameras, views: Annotated[Tensor, "V"], pairs: int) -> tuple[Tensor, Tensor]:
    """View [P] and pixels [P 2 2] of about so many pairs on the lattice: one step to the right or down,
    inside of the image.
    """
    view, pixel = lattice(cameras, views, pairs)
    size = cameras.size[view]
    step = (size.amin(1) // _NEIGHBOUR_PARTS).clamp_min(1)[:, None] * F.one_hot(
        torch.arange(len(view)) % 2, 2
    )
    there = pixel + step
    # At the right or lower edge the neighbour is the one before.
    there = torch.where(there < size, there, (pixel - step).clamp_min(0.5))
    return view, torch.stack([pixel, there], 1)


@torch.inference_mode()
def measure_style(
    config: TrainConfig, model: Model, cameras: Cameras, views: Annotated[Tensor, "V"]
) -> SceneStyle:
    """Content statistics over the training views and the scene's semantic regions, on the CPU.

    `cameras` are the capture's; the model's own poses, if it has any, are taken into account here.
    """
    # Rays on a lattice over all training views, chunk by chunk; moments are merged, so that chunks do not
    # matter.
    cameras = model.refined(cameras)
    device = model.device
    view, pixel = lattice(cameras, views, config.statistics.rays)
    whole = None

    def part_of(part: slice) -> tuple[Moments, Tensor, Tensor, Tensor | None]:
        rays = model.space.rays(*rays_through(cameras, view[part], pixel[part]))
        rays = type(rays)(*(x.to(device) for x in rays))
        marched, content, _ = march_features(rays, model.parts, budget=config.render.budget, semantic=False)
        kept = marched.kept
        own = Moments(*(x.cpu() for x in moments(content, kept.weight)))
        # Regions are found and measured on an even share of the points; whole moments above see every one.
        every = max(1, -(-len(content) * config.statistics.rays // (len(rays.near) * POINTS)))
        semantic = None
        if model.semantic is not None:
            semantic = model.semantic(kept.point[::every]).cpu()
        return own, content[::every].cpu(), kept.weight[::every].cpu(), semantic

    contents = []
    weights = []
    semantics = []
    for own, content, weight, semantic in in_parts(len(view), config.render.chunk, part_of):
        whole = own if whole is None else merge(whole, own)
        contents.append(content)
        weights.append(weight)
        if semantic is not None:
            semantics.append(semantic)
    scene = scene_style(
        torch.cat(contents),
        torch.cat(semantics) if semantics else None,
        torch.cat(weights),
        whole,
        config.statistics.regions,
        config.seed,
    )
    # One region has no neighbours.
    if len(scene.share) == 1:
        return scene
    return scene._replace(contacts=_contacts(config, model, cameras, views, scene))


def _contacts(
    config: TrainConfig, model: Model, cameras: Cameras, views: Annotated[Tensor, "V"], scene: SceneStyle
) -> Annotated[Tensor, "K K"]:
    """Contact of regions without an edge of colour between them, from pairs of rendered pixels."""
    # Two pixels a pair, rendered one after the other: colour to look for an edge, semantics to know the
    # regions.
    view, pixel = neighbours(cameras, views, max(1, config.statistics.rays // _RAYS_A_PAIR))
    view = view.repeat_interleave(2)
    pixel = pixel.flatten(0, 1)

    def part_of(part: slice) -> Annotated[Tensor, "R 3+D"]:
        rays = model.space.rays(*rays_through(cameras, view[part], pixel[part]))
        rays = type(rays)(*(x.to(model.device) for x in rays))
        marched, content, semantic = march_features(rays, model.parts, budget=config.render.budget)
        assert semantic is not None  # else there is one region
        return composite_mean(
            marched.kept, torch.cat([model.decoder(content), semantic], 1), len(rays.near)
        ).cpu()

    shown = torch.cat(list(in_parts(len(view), config.render.chunk, part_of)))
    shown = shown.view(-1, 2, shown.shape[1])
    return region_contacts(scene, shown[..., 3:], shown[..., :3])
