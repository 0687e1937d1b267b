"""The naive path that speed is compared with: plain torch for the planes, every sample through every network, every term at
every step, on the same model in the same run; and the tri-plane lookup alone.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import fields, replace
from typing import Annotated, Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..config import TrainConfig
from ..fields.planes import Planes
from ..ops import backend, triplane
from ..plugins import slots
from ..training.loading import Trained
from .config import SpeedConfig
from .report import Row, ratio, spread
from .subject import watch_of

__all__ = [
    "draw_points",
    "forward_backward",
    "grid_sample_lookup",
    "largest_planes",
    "plain_planes",
    "replaced",
    "triplane_rows",
    "without_skipping",
]


def grid_sample_lookup(
    points: Annotated[Tensor, "N 3"], table: Annotated[Tensor, "rows F"], resolutions: Sequence[int]
) -> Annotated[Tensor, "N scales*F"]:
    """`triplane.lookup` by twelve calls of torch's grid_sample, as K-Planes has it."""
    scales = []
    for planes in triplane.split(table, resolutions):
        product: Tensor | None = None
        for plane, (a, b) in zip(planes, triplane.AXES, strict=True):
            at = torch.stack([points[:, a], points[:, b]], -1)[None, None]
            value = F.grid_sample(plane.permute(2, 0, 1)[None], at, align_corners=True, padding_mode="border")[0, :, 0].T
            product = value if product is None else product * value
        assert product is not None
        scales.append(product)
    return torch.cat(scales, -1)


@contextmanager
def replaced(module: nn.Module, name: str, around: Callable[[Callable[..., Any]], Callable[..., Any]]) -> Iterator[None]:
    """A method of one module wrapped for a while; its class, and every other module, stay as they are."""
    setattr(module, name, around(getattr(module, name)))
    try:
        yield
    finally:
        delattr(module, name)


@contextmanager
def plain_planes(*models: nn.Module) -> Iterator[None]:
    """No compiled kernels at all: grid_sample for lookups, slices for total variation."""
    with backend.plain(), ExitStack() as stack:
        for model in models:
            for module in model.modules():
                if isinstance(module, Planes):
                    stack.enter_context(replaced(module, "forward", _looked_up(module)))
                    stack.enter_context(replaced(module, "variation", _varied(module)))
        yield


def without_skipping(config: TrainConfig) -> TrainConfig:
    """The same training with nothing left out: every sample, every ray's semantics, every term at every step."""
    if any(field.name == "semantic_share" for field in fields(config.datamanager)):
        config = slots.replace(config, "datamanager.semantic_share", 1.0)
    return replace(
        config,
        render=replace(config.render, budget=0.0, train_budget=0.0),
        semantic=replace(config.semantic, samples=10**6),
        loss=replace(config.loss, penalty_every=1),
    )


def _looked_up(planes: Planes) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    return lambda ours: lambda points: grid_sample_lookup(points, planes.table, planes.resolutions)


def _varied(planes: Planes) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    return lambda ours: lambda: triplane.variation_reference(planes.table, planes.resolutions)


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
