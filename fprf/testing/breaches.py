"""Requirements that say in one sentence what was found where."""

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode

from ..interfaces import ContentField, Sampler, SemanticField


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


def follows(call: Callable[[], Tensor], like: Tensor, name: str) -> None:
    """The result of a call, and tensors that it makes, take device and dtype from its inputs, which are of the kind of `like`.

    Called with float64 on the CPU, while new tensors that name no device are put elsewhere: those cannot be computed with.
    """
    plain = call()
    kind_found, kind = f"{plain.dtype} on {plain.device}", f"{like.dtype} on {like.device}"
    require(kind_found == kind, f"{name}: expected {kind} for inputs of that kind, found {kind_found}")
    try:
        with torch.device("meta"):
            again = call()
    except (RuntimeError, TypeError, ValueError) as fault:
        line = " ".join(str(fault).split())
        raise AssertionError(f"{name}: makes a tensor that is not on the device of its inputs ({line})") from fault
    whole = again.device == plain.device and torch.equal(again, plain)
    require(whole, f"{name}: makes a tensor that is not on the device of its inputs")


def penalties(part: ContentField | SemanticField | Sampler, name: str) -> None:
    """Finite scalars by name, the same names at each call, of a part in float64."""
    penalties = part.penalties()
    require(part.penalties().keys() == penalties.keys(), f"{name}: must have the same penalties at each call")
    for key, value in penalties.items():
        require(isinstance(key, str) and value.ndim == 0, f"{name}: penalty {key!r} must be a scalar")
        require(bool(value.isfinite()), f"{name}: penalty {key!r} is not finite")
        follows(lambda key=key: part.penalties()[key], value, f"{name}: penalty {key!r}")  # type: ignore[misc]


class Unread(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Raise AssertionError where the host would wait for the device: `.item()`, `bool`, `nonzero`, a boolean index."""

    def __init__(self, name: str) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.name = name

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        """Look at one operator."""
        aten = torch.ops.aten
        mask = func is aten.index.Tensor and any(i is not None and i.dtype in (torch.bool, torch.uint8) for i in args[1])
        waits = func.overloadpacket in (aten._local_scalar_dense, aten.nonzero, aten.equal, aten.masked_select)
        require(not (mask or waits), f"{self.name}: reads numbers of the device in a step ({func.overloadpacket.__name__})")
        return func(*args, **(kwargs or {}))


def trainable(module: nn.Module, loss: Tensor, name: str) -> None:
    """Every parameter gets a finite gradient."""
    named = dict(module.named_parameters())
    require(loss.requires_grad or not named, f"{name}: no gradient goes through its answer")
    gradients = torch.autograd.grad(loss, list(named.values()), allow_unused=True) if named else ()
    for key, gradient in zip(named, gradients, strict=True):
        require(gradient is not None, f"{name}: no gradient reaches {key}")
        require(bool(gradient.isfinite().all()), f"{name}: the gradient of {key} is not finite")
