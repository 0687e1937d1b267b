"""Requirements that say in one sentence what was found where."""

from collections.abc import Callable

import torch
from torch import Tensor, nn

__all__ = ["close", "penalties", "pointwise", "require", "same", "same_parameters", "tensor", "trainable"]


def require(condition: bool, breach: str) -> None:
    """Raise AssertionError with the sentence unless the condition holds (also under `python -O`)."""
    if not condition:
        raise AssertionError(breach)


def tensor(value: Tensor, shape: tuple[int | None, ...], what: str) -> None:
    """A finite float32 tensor of that shape; None stands for any size."""
    require(isinstance(value, Tensor), f"{what}: expected a tensor, found {type(value).__name__}")
    found = tuple(value.shape)
    fits = len(found) == len(shape) and all(want in (None, size) for size, want in zip(found, shape, strict=True))
    require(fits, f"{what}: expected shape {shape}, found {found}")
    require(value.dtype == torch.float32, f"{what}: expected float32 for float32 inputs, found {value.dtype}")
    require(bool(value.isfinite().all()), f"{what}: holds values that are not finite")


def close(found: Tensor, wanted: Tensor, tolerance: float) -> bool:
    """Equal to within a tolerance relative to the largest value (1 at least)."""
    if not wanted.numel():
        return found.shape == wanted.shape
    scale = max(1.0, float(wanted.abs().max())) if tolerance else 1.0
    return bool(((found - wanted).abs() <= tolerance * scale).all())


def same(found: Tensor, wanted: Tensor, tolerance: float, breach: str) -> None:
    """Require `close`."""
    require(found.shape == wanted.shape and close(found.detach(), wanted.detach(), tolerance), breach)


def same_parameters(one: nn.Module, other: nn.Module, name: str) -> None:
    """Two modules of one seed hold the same numbers."""
    mine, theirs = one.state_dict(), other.state_dict()
    equal = mine.keys() == theirs.keys() and all(torch.equal(mine[key], theirs[key]) for key in mine)
    require(equal, f"{name}: its parameters must be drawn from the seed alone")


def pointwise(function: Callable[[Tensor], Tensor], points: Tensor, name: str) -> None:
    """A function of each point alone: the same twice, in parts, and for no points at all."""
    whole = function(points)
    same(function(points), whole, 0.0, f"{name}: must be deterministic")
    same(function(points[2:5]), whole[2:5], 1e-4, f"{name}: a point must not depend on the others")
    tensor(function(points[:0]), (0, *whole.shape[1:]), f"{name} of no points")


def penalties(found: dict[str, Tensor], name: str) -> None:
    """Scalars by loss name."""
    for key, value in found.items():
        require(isinstance(key, str) and value.ndim == 0, f"{name}: penalty {key!r} must be a scalar")
        require(bool(value.isfinite()), f"{name}: penalty {key!r} is not finite")


def trainable(module: nn.Module, loss: Tensor, name: str) -> None:
    """Every parameter gets a finite gradient."""
    names, parameters = zip(*module.named_parameters(), strict=True)
    for key, gradient in zip(names, torch.autograd.grad(loss, parameters, allow_unused=True), strict=True):
        require(gradient is not None, f"{name}: no gradient reaches {key}")
        require(bool(gradient.isfinite().all()), f"{name}: the gradient of {key} is not finite")
