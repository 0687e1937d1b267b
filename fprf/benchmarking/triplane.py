"""The tri-plane lookup alone, forward and backward: ours, torch's grid_sample, and the plain reference, against float64."""

from collections.abc import Callable, Sequence
from typing import Annotated

import torch
from torch import Tensor

from ..fields.planes import Planes
from ..ops import triplane
from ..training.loading import Trained
from .config import SpeedConfig
from .naive import grid_sample_lookup
from .report import Row
from .subject import watch_of
from .timing import ratio, spread

__all__ = ["Lookup", "draw_points", "forward_backward", "largest_planes", "triplane_rows"]

Lookup = Callable[[Tensor, Tensor, Sequence[int]], Tensor]
FORMS: dict[str, Lookup] = {
    "ours": triplane.lookup,
    "grid_sample": grid_sample_lookup,
    "reference": triplane.lookup_reference,
}
GOAL = 8.0
"""Times faster than grid_sample, on a CPU."""


def triplane_rows(config: SpeedConfig, trained: Trained) -> list[Row]:
    """Milliseconds of forward and backward together, on the largest planes of the model."""
    planes, device = largest_planes(trained.model), trained.model.device
    if planes is None:
        return []
    points = draw_points(config.points, config.seed, device)
    table = planes.table.detach().clone()
    calls = {name: _caller(form, points, table, planes.resolutions) for name, form in FORMS.items()}
    seconds = watch_of(config, trained).in_turn(calls)
    truth = forward_backward(triplane.lookup_reference, points.double(), table.double(), planes.resolutions)
    rows = []
    for peer in ("grid_sample", "reference"):
        ours = spread(seconds["ours"]).map(lambda s: 1e3 * s)
        rows.append(
            Row(
                name=f"tri-plane forward + backward, against {peer}",
                figure=ours.median,
                low=ours.low,
                high=ours.high,
                unit="ms",
                peer=1e3 * spread(seconds[peer]).median,
                ratio=ratio(seconds[peer], seconds["ours"]),
                ratio_goal=GOAL if peer == "grid_sample" and device.type == "cpu" else None,
                error=_error(calls["ours"](), truth),
                error_kind="largest error of value or gradient against float64, relative to the largest of each",
                peer_error=_error(calls[peer](), truth),
                note=f"{config.points} points, planes of {', '.join(map(str, planes.resolutions))}, {table.shape[1]} channels",
            )
        )
    return rows


def forward_backward(
    lookup: Lookup, points: Annotated[Tensor, "N 3"], table: Annotated[Tensor, "rows F"], resolutions: Sequence[int]
) -> tuple[Tensor, Tensor]:
    """Values, and the table's gradient of half the sum of their squares."""
    leaf = table.detach().requires_grad_()
    values = lookup(points, leaf, resolutions)
    (gradient,) = torch.autograd.grad(values, leaf, values.detach())
    return values.detach(), gradient


def largest_planes(model: torch.nn.Module) -> Planes | None:
    """The tri-planes with the most numbers, if the model has any."""
    found = [module for module in model.modules() if isinstance(module, Planes)]
    return max(found, key=lambda planes: planes.table.numel(), default=None)


def draw_points(count: int, seed: int, device: torch.device) -> Annotated[Tensor, "count 3"]:
    """Points of the unit cube, evenly spread."""
    generator = torch.Generator().manual_seed(seed)
    return (torch.rand(count, 3, generator=generator) * 2 - 1).to(device)


def _caller(form: Lookup, points: Tensor, table: Tensor, resolutions: Sequence[int]) -> Callable[[], tuple[Tensor, Tensor]]:
    return lambda: forward_backward(form, points, table, resolutions)


def _error(found: tuple[Tensor, Tensor], truth: tuple[Tensor, Tensor]) -> float:
    return max(float((a.double() - b).abs().max() / b.abs().max().clamp_min(1e-30)) for a, b in zip(found, truth, strict=True))
