"""Renders of a run against its photographs: quality, speed, memory, consistency."""

import math
import time
from collections.abc import Callable, Sequence
from typing import Annotated, Any

import torch
from torch import Tensor

from ..datamanagers.images import Image
from ..datamanagers.scene import Scene as ParsedScene
from ..interfaces import Scene
from ..io.images import to_uint8
from ..memory import peak
from ..training.run import Known
from ..types import View
from .consistency import WarpError
from .metrics import image_metrics, mean_metrics


def peak_memory() -> float:
    """Most resident memory that this process ever held, in MiB; 0 where the system does not tell."""
    return (peak() or 0) / 2**20


def judge(
    scene: Scene,
    known: Known,
    captured: ParsedScene,
    views: Sequence[int],
    progress: Callable[[int, int, str], None],
    *,
    masks: bool = True,
) -> tuple[dict[str, Any], list[Image]]:
    """Metrics of views of a scene (means and each by name), and their images, each in the light that it was taken in.

    `captured` has the photographs; pixels that its `masks` leave out do not count. Seconds are those of rendering alone.
    Consistency warps each view into the next one of the list by the rendered depth.
    """
    cameras = known.cameras
    images: list[Image] = []
    before: View | None = None
    rows, seconds, kept, pixels = {}, 0.0, 0.0, 0
    warped = WarpError(cameras.select(torch.tensor(list(views), dtype=torch.int64)))
    for i, view in enumerate(views):
        progress(i, len(views), "rendering")
        taken, start = scene.as_taken(view), time.perf_counter()
        render = taken.render(cameras, view)
        seconds += time.perf_counter() - start
        images.append(to_uint8(render.rgb))
        kept += render.kept
        if before is not None:
            warped.add(i - 1, i, before.rgb, render.rgb, before.depth, render.depth)
        before = render
        truth, where = known.photograph(captured, view, masks=masks)
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


def described(move: Annotated[Tensor, "6"]) -> dict[str, float]:
    """For JSON: how far a view was moved."""
    return {"turn_degrees": math.degrees(float(move[:3].norm())), "shift": float(move[3:].norm())}
