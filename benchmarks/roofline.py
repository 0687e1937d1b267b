"""How near the tri-plane lookup comes to the memory's speed.

What a lookup must move, whatever the kernel: its points, every row of the table that some point touches, once, and its
result; backward the incoming gradient, the points, those rows, and the gradient of the whole table, which is zeroed and then
added to. The memory's speed is that of a large copy, measured here. A kernel that runs at 100 % cannot be faster.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated

import torch
from torch import Tensor

from fprf.ops import triplane
from fprf.training.loading import Trained

from .common import bench_run, origin
from .report import Outcome, Row, Watch, document, rows_table, spread
from .speed import SpeedConfig, draw_points, largest_planes
from .subject import find, settings, watch_of

COPIED = 1 << 28
"""Bytes of the copy: more than caches hold."""
GOAL = 50.0
"""Percent, on a GPU."""


def roofline_rows(config: SpeedConfig, trained: Trained) -> list[Row]:
    """Percent of the memory's speed, forward and backward."""
    planes, device, watch = largest_planes(trained.model), trained.model.device, watch_of(config, trained)
    if planes is None:
        return []
    points, resolutions = draw_points(config.points, config.seed, device), planes.resolutions
    table = planes.table.detach().clone().requires_grad_()
    values = triplane.lookup(points, table, resolutions)
    moved = {
        "forward": forward_bytes(points, table, resolutions),
        "backward": backward_bytes(points, table, resolutions),
    }
    seconds = watch.in_turn(
        {
            "forward": lambda: triplane.lookup(points, table, resolutions),
            "backward": lambda: torch.autograd.grad(values, table, values.detach(), retain_graph=True),
        }
    )
    speed = bandwidth(watch)
    rows = []
    for name, count in moved.items():
        share = spread([100 * count / s / speed for s in seconds[name]])
        rows.append(
            Row(
                name=f"tri-plane {name}, of the memory's speed",
                figure=share.median,
                low=share.low,
                high=share.high,
                unit="%",
                goal=GOAL if device.type == "cuda" else None,
                more_is_better=True,
                note=f"{count / 2**20:.1f} MiB that must move; a copy runs at {speed / 2**30:.1f} GiB/s",
            )
        )
    return rows


def forward_bytes(points: Annotated[Tensor, "N 3"], table: Annotated[Tensor, "rows F"], resolutions: Sequence[int]) -> int:
    """Points, touched rows and result."""
    width = table.shape[1] * table.element_size()
    result = len(points) * len(resolutions) * width
    return _size(points) + touched(points, resolutions) * width + result


def backward_bytes(points: Annotated[Tensor, "N 3"], table: Annotated[Tensor, "rows F"], resolutions: Sequence[int]) -> int:
    """What forward reads and the incoming gradient; the gradient of the table written once, touched rows of it twice more."""
    width = table.shape[1] * table.element_size()
    return forward_bytes(points, table, resolutions) + _size(table) + 2 * touched(points, resolutions) * width


def touched(points: Annotated[Tensor, "N 3"], resolutions: Sequence[int]) -> int:
    """Rows of the table that some point reads."""
    total = 0
    for r in resolutions:
        low = ((points + 1) * (0.5 * (r - 1))).clamp(0, r - 1).long().clamp(max=r - 2)
        for a, b in triplane.AXES:
            corner = low[:, b] * r + low[:, a]
            total += len(torch.unique(torch.cat([corner, corner + 1, corner + r, corner + r + 1])))
    return total


def bandwidth(watch: Watch, size: int = COPIED) -> float:
    """Bytes a second that a copy reads and writes, at its fastest."""
    source = torch.zeros(size // 4, device=watch.device)
    target = torch.empty_like(source)
    return 2 * size / min(watch.in_turn({"copy": lambda: target.copy_(source)})["copy"])


def _size(tensor: Tensor) -> int:
    return tensor.numel() * tensor.element_size()


def main(argv: list[str]) -> int:
    """`python -m benchmarks roofline [RUN]`, with the flags of `python -m benchmarks speed`."""
    return bench_run("python -m benchmarks roofline", SpeedConfig(), argv, roofline)


def roofline(config: SpeedConfig, root: Path, folder: Path, progress: Callable[[int, int, str], None]) -> Outcome:
    """The rows of a run."""
    subject = find(root, config, folder)
    rows = roofline_rows(config, subject.trained)
    made = document("roofline", rows, device=subject.trained.model.device, settings=settings(config, subject.trained, ""))
    return Outcome(made | origin(config.device), [rows_table("tri-planes, beside the memory's speed", rows)])
