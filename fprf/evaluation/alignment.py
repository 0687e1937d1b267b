"""Held-out views whose poses are not known exactly: six numbers a view are fitted to its own image before it is judged.

Where training refines poses, the scene comes to lie where the training views together put it; a view that was held out stays
where the capture says, a little off. Fitting its pose (BARF, section 4) says what the scene is worth, not what the pose is: the
scene is not touched, and six numbers cannot draw a picture. A figure with fitted poses says so.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import torch
from torch import Tensor

from ..datamanagers.images import load_image, load_mask
from ..datamanagers.scene import Scene
from ..rendering.cameras import Cameras
from ..rendering.pixel_rays import PixelRays
from ..rendering.renderer import render_rays
from ..training.loading import Trained
from ..training.model import background_of
from ..training.poses import moved, moving, rotated
from ..training.prepare import reach_of
from ..types import Rays, Want

__all__ = ["AlignmentConfig", "align", "align_view", "described"]


@dataclass(frozen=True, kw_only=True)
class AlignmentConfig:
    """How a pose is fitted."""

    steps: int = 120
    """Steps of Adam."""
    rays: int = 512
    """Pixels of a step."""
    rate: float = 2e-3
    """Radians, and distances that views commonly see, of the first step; it falls along a cosine to nothing."""


def align(
    trained: Trained,
    scene: Scene,
    views: Sequence[int],
    progress: Callable[[int, int, str], None] = lambda done, total, what: None,
    config: AlignmentConfig | None = None,
) -> tuple[Trained, dict[int, Annotated[Tensor, "6"]]]:
    """The run with fitted poses of some views, and how far each was moved: turn (radians) and shift (world units)."""
    cameras, pose, moves = trained.known.cameras, trained.known.cameras.pose.clone(), {}
    facts = trained.known.facts
    reach = facts.reach if facts.centres else reach_of(scene, facts.space)
    for done, view in enumerate(views):
        progress(done, len(views), "fitting poses")
        width, height = (int(v) for v in cameras.size[view])
        truth = torch.from_numpy(load_image(scene.paths[view], (width, height), facts.background)).float() / 255
        mask = scene.masks[view] if scene.masks and trained.config.datamanager.masks else None
        where = None if mask is None else torch.from_numpy(load_mask(mask, (width, height)))
        moves[view] = align_view(trained, cameras, view, truth, reach, config or AlignmentConfig(), where)
        pose[view] = moved(pose[view][None], moves[view][None, :3], moves[view][None, 3:])[0]
    progress(len(views), len(views), "fitting poses")
    return replace(trained, known=replace(trained.known, cameras=replace(cameras, pose=pose))), moves


def described(move: Annotated[Tensor, "6"]) -> dict[str, float]:
    """For JSON: how far a view was moved."""
    return {"turn_degrees": math.degrees(float(move[:3].norm())), "shift": float(move[3:].norm())}


def align_view(
    trained: Trained,
    cameras: Cameras,
    view: int,
    truth: Annotated[Tensor, "H W 3"],
    reach: float,
    config: AlignmentConfig,
    where: Annotated[Tensor, "H W"] | None = None,
) -> Annotated[Tensor, "6"]:
    """Turn and shift (world units), float64, that bring the render of a view nearest to its image, `where` that counts."""
    model, facts = trained.model, trained.known.facts
    device = model.device
    through, background = PixelRays(cameras.select(torch.tensor([view]))), background_of(facts, device)
    tones = model.tones
    factor = torch.ones(3) if tones is None else tones(torch.tensor([view]))[0].detach().cpu()
    pixels, generator = truth.reshape(-1, 3), torch.Generator().manual_seed(view)
    used = None if where is None or not bool(where.any()) else where.reshape(-1).nonzero()[:, 0]
    move = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.Adam([move], lr=config.rate, betas=(0.9, 0.95))
    for step in range(config.steps):
        optimizer.param_groups[0]["lr"] = 0.5 * config.rate * (1 + math.cos(math.pi * step / config.steps))
        at = torch.randint(len(pixels) if used is None else len(used), (config.rays,), generator=generator)
        at = at if used is None else used[at]
        pixel = torch.stack([at % truth.shape[1], at // truth.shape[1]], -1) + 0.5
        origin, direction = through(torch.zeros_like(at), pixel)
        turned = rotated(direction, move[:3].expand_as(direction))
        rays = moving(model.space.rays(origin + reach * move[3:], turned))
        rays = Rays(*(x.to(device) for x in rays))
        rendered = render_rays(rays, model.parts, want=Want.COLOUR, budget=trained.config.render.budget, background=background)
        assert rendered.rgb is not None
        loss = (rendered.rgb.cpu() * factor - pixels[at]).square().mean()
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        if move.grad is not None and bool(move.grad.isfinite().all()):
            optimizer.step()
    return move.detach() * torch.tensor([1.0, 1, 1, reach, reach, reach], dtype=torch.float64)
