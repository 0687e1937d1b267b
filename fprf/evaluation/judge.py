"""Renders of a run against its photographs: quality, speed, memory, consistency."""

import time
from collections.abc import Callable, Sequence
from typing import Any

import torch

from ..datamanagers.images import load_image, load_mask
from ..datamanagers.scene import Scene
from ..memory import peak
from ..training.loading import Trained
from ..training.run import Known
from ..training.views import render_view
from ..types import View
from .consistency import consistency
from .metrics import image_metrics, mean_metrics

__all__ = ["judge", "judge_views", "peak_memory"]


def peak_memory() -> float:
    """Most resident memory that this process ever held, in MiB; 0 where the system does not tell."""
    return (peak() or 0) / 2**20


def judge(
    trained: Trained, scene: Scene, views: Sequence[int], progress: Callable[[int, int, str], None]
) -> tuple[dict[str, Any], list[View]]:
    """Metrics of the views of a run of fields, and the renders (see `judge_views`)."""
    facts, cameras, tones = trained.known.facts, trained.known.cameras, trained.model.tones

    def draw(view: int) -> View:
        # Of a view that was held out, what its exposure says.
        factor = None if tones is None else tones(torch.tensor([view]))[0].detach()
        return render_view(trained.model, facts, cameras, view, trained.config.render, factor=factor)

    masks = trained.config.datamanager.masks
    metrics, renders = judge_views(trained.known, scene, views, draw, progress, masks=masks)
    return metrics | {"train_seconds": trained.seconds, "train_steps": trained.step}, renders


def judge_views(
    known: Known,
    scene: Scene,
    views: Sequence[int],
    draw: Callable[[int], View],
    progress: Callable[[int, int, str], None],
    *,
    masks: bool,
) -> tuple[dict[str, Any], list[View]]:
    """Metrics of the views (means and each by name), and the renders, which `draw` makes.

    Pixels that the capture's masks leave out do not count. Seconds are those of rendering alone. Consistency warps each view
    into the next one of the list by the rendered depth.
    """
    cameras = known.cameras
    renders, rows, seconds = [], {}, 0.0
    for i, view in enumerate(views):
        progress(i, len(views), "rendering")
        start = time.perf_counter()
        render = draw(view)
        seconds += time.perf_counter() - start
        renders.append(render)
        width, height = (int(v) for v in cameras.size[view])
        truth = torch.from_numpy(load_image(scene.paths[view], (width, height), known.facts.background)).float() / 255
        mask = scene.masks[view] if scene.masks and masks else None
        where = None if mask is None else torch.from_numpy(load_mask(mask, (width, height)))
        rows[known.names[view]] = image_metrics(render.rgb, truth, where)
    progress(len(views), len(views), "rendering")
    pixels = sum(v.rgb.shape[0] * v.rgb.shape[1] for v in renders)
    chosen = cameras.select(torch.tensor(list(views), dtype=torch.int64))
    pairs = [(i, i + 1) for i in range(len(views) - 1)]
    warped = consistency([v.rgb for v in renders], [v.depth for v in renders], chosen, pairs)
    means = mean_metrics(rows.values())
    return {
        **means,
        "lpips": None,
        "views": len(views),
        "render_seconds": seconds,
        "seconds_per_view": seconds / max(1, len(views)),
        "rays_per_second": pixels / max(seconds, 1e-9),
        "kept_samples_share": sum(v.kept for v in renders) / max(1, len(renders)),
        "peak_rss_mib": peak_memory(),
        "consistency": warped,
        "per_view": rows,
    }, renders
