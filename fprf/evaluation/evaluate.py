"""Renders of a run against its photographs: quality, speed, memory, consistency; and the fitting of held-out poses.

Where training refines poses, the scene moves with the training views, and a held-out view stays where the capture says. `align`
fits the pose of such a view to its own image (BARF, section 4), six numbers a view; the scene is not changed.
"""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import torch
from torch import Tensor

from ..datamanagers.images import Image, load_image, load_mask
from ..datamanagers.scene import Scene
from ..io.images import to_uint8
from ..memory import peak
from ..rendering.cameras import Cameras, PixelRays
from ..rendering.renderer import render_rays
from ..training.camera_optimizers import moved, moving, rotated
from ..training.loading import Trained
from ..training.model import background_of
from ..training.prepare import reach_of
from ..training.run import Known
from ..training.views import render_view
from ..types import Rays, View, Want
from .consistency import WarpError
from .metrics import image_metrics, mean_metrics


def peak_memory() -> float:
    """Most resident memory that this process ever held, in MiB; 0 where the system does not tell."""
    return (peak() or 0) / 2**20


def judge(
    trained: Trained, scene: Scene, views: Sequence[int], progress: Callable[[int, int, str], None]
) -> tuple[dict[str, Any], list[Image]]:
    """Metrics of the views of a run of fields, and their images (see `judge_views`)."""
    facts, cameras, tones = trained.known.facts, trained.known.cameras, trained.model.tones

    def draw(view: int) -> View:
        # Of a view that was held out, what its exposure says.
        factor = None if tones is None else tones(torch.tensor([view]))[0].detach()
        return render_view(trained.model, facts, cameras, view, trained.config.render, factor=factor)

    masks = trained.config.datamanager.masks
    metrics, images = judge_views(trained.known, scene, views, draw, progress, masks=masks)
    return metrics | {"train_seconds": trained.seconds, "train_steps": trained.step}, images


def judge_views(
    known: Known,
    scene: Scene,
    views: Sequence[int],
    draw: Callable[[int], View],
    progress: Callable[[int, int, str], None],
    *,
    masks: bool,
) -> tuple[dict[str, Any], list[Image]]:
    """Metrics of the views (means and each by name), and their images; `draw` renders them, one after the other.

    Pixels that the capture's masks leave out do not count. Seconds are those of rendering alone. Consistency warps each view
    into the next one of the list by the rendered depth.
    """
    cameras = known.cameras
    images: list[Image] = []
    before: View | None = None
    rows, seconds, kept, pixels = {}, 0.0, 0.0, 0
    warped = WarpError(cameras.select(torch.tensor(list(views), dtype=torch.int64)))
    for i, view in enumerate(views):
        progress(i, len(views), "rendering")
        start = time.perf_counter()
        render = draw(view)
        seconds += time.perf_counter() - start
        images.append(to_uint8(render.rgb))
        kept += render.kept
        if before is not None:
            warped.add(i - 1, i, before.rgb, render.rgb, before.depth, render.depth)
        before = render
        truth, where = _photograph(known, scene, view, masks)
        pixels += truth.shape[0] * truth.shape[1]
        rows[known.names[view]] = image_metrics(render.rgb, truth, where)
    progress(len(views), len(views), "rendering")
    means = mean_metrics(rows.values())
    return {
        **means,
        "views": len(views),
        "render_seconds": seconds,
        "seconds_per_view": seconds / max(1, len(views)),
        "rays_per_second": pixels / max(seconds, 1e-9),
        "kept_samples_share": kept / max(1, len(views)),
        "peak_rss_mib": peak_memory(),
        "consistency": warped.summary(),
        "per_view": rows,
    }, images


def _photograph(
    known: Known, scene: Scene, view: int, masks: bool
) -> tuple[Annotated[Tensor, "H W 3"], Annotated[Tensor, "H W"] | None]:
    """The image of a view at the size of its camera, in [0, 1], and where it counts; None = everywhere."""
    width, height = known.cameras.size[view].tolist()
    image = torch.from_numpy(load_image(scene.paths[view], (width, height), known.facts.background)).float() / 255
    mask = scene.masks[view] if scene.masks and masks else None
    return image, None if mask is None else torch.from_numpy(load_mask(mask, (width, height)))


@dataclass(frozen=True, kw_only=True)
class AlignmentConfig:
    """Settings of the pose fit."""

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
        truth, where = _photograph(trained.known, scene, view, trained.config.datamanager.masks)
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
