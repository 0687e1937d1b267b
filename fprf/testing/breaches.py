"""Requirements that say in one sentence what was found where, as AssertionError; `told_of` makes a PluginError of it."""

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, TypeVar

import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode

from ..errors import FprfError, PluginError
from ..interfaces import ContentField, Sampler, SemanticField
from ..plugins import registry
from ..plugins.config import PluginConfig

Answer = TypeVar("Answer")


def require(condition: bool, breach: str) -> None:
    """Raise AssertionError with the sentence unless the condition holds (also under `python -O`)."""
    if not condition:
        raise AssertionError(breach)


def tensor(
    value: Tensor, shape: tuple[int | None, ...], what: str, low: float = -math.inf, high: float = math.inf, slack: float = 0.0
) -> None:
    """Require a finite float32 tensor on the CPU of that shape, of which None stands for any size, from low to high."""
    wanted = f"float32 [{' '.join('any' if size is None else str(size) for size in shape)}] on cpu"
    require(isinstance(value, Tensor), f"{what}: expected {wanted}, found {type(value).__name__}")
    found, sizes = kind_of(value), tuple(value.shape)
    fits = len(sizes) == len(shape) and all(want in (None, size) for want, size in zip(shape, sizes, strict=True))
    right = fits and value.dtype == torch.float32 and value.device.type == "cpu"
    require(right, f"{what}: expected {wanted}, found {found}")
    bad = int((~value.isfinite()).sum())
    require(not bad, f"{what}: expected finite numbers, found {bad} of {value.numel()} that are not finite")
    if value.numel():
        least, most = (float(each) for each in value.detach().aminmax())
        inside = low - slack <= least <= most <= high + slack
        require(inside, f"{what}: expected numbers in [{low:g}, {high:g}], found {least:g} to {most:g}")


def kind_of(value: Tensor) -> str:
    """Type, shape and device of a tensor, for example `float32 [5 3] on cpu`."""
    return f"{str(value.dtype).removeprefix('torch.')} [{' '.join(map(str, value.shape))}] on {value.device}"


def shares(value: Tensor, shape: tuple[int, int], what: str, tolerance: float = 1e-4) -> None:
    """Require rows of numbers from 0 on that sum to 1."""
    tensor(value, shape, what, low=0.0)
    for total in value.sum(1).tolist():
        require(abs(total - 1) <= tolerance, f"{what}: expected rows that sum to 1, found a sum of {total:g}")


def close(found: Tensor, wanted: Tensor, tolerance: float) -> bool:
    """Equal to within a tolerance relative to the largest value (1 at least)."""
    if not wanted.numel():
        return found.shape == wanted.shape
    scale = max(1.0, float(wanted.abs().max())) if tolerance else 1.0
    return bool(((found - wanted).abs() <= tolerance * scale).all())


def same(found: Tensor, wanted: Tensor, tolerance: float, breach: str) -> None:
    """Require `close`."""
    require(found.shape == wanted.shape and close(found.detach(), wanted.detach(), tolerance), breach)


def pointwise(function: Callable[[Tensor], Tensor], points: Tensor, name: str) -> None:
    """Require a function of each point alone: the same twice, in parts, and for no points at all."""
    whole = function(points)
    same(function(points), whole, 0.0, f"{name}: must be deterministic")
    same(function(points[2:5]), whole[2:5], 1e-4, f"{name}: a point must not depend on the others")
    tensor(function(points[:0]), (0, *whole.shape[1:]), f"{name} of no points")


def follows(call: Callable[[], Tensor], like: Tensor, name: str) -> None:
    """Require that the result of a call, and tensors that it makes, take device and dtype from its inputs, like `like`.

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
    """Require finite scalars by name, the same names at each call, of a part in float64."""
    penalties = part.penalties()
    require(part.penalties().keys() == penalties.keys(), f"{name}: must have the same penalties at each call")
    for key, value in penalties.items():
        require(isinstance(key, str) and value.ndim == 0, f"{name}: penalty {key!r} must be a scalar")
        require(bool(value.isfinite()), f"{name}: penalty {key!r} is not finite")
        follows(lambda key=key: part.penalties()[key], value, f"{name}: penalty {key!r}")  # type: ignore[misc]


def trainable(module: nn.Module, loss: Tensor, name: str) -> None:
    """Require a finite gradient for every parameter that wants one."""
    named = {key: value for key, value in module.named_parameters() if value.requires_grad}
    require(loss.requires_grad or not named, f"{name}: no gradient goes through its answer")
    gradients = torch.autograd.grad(loss, list(named.values()), allow_unused=True) if named else ()
    for key, gradient in zip(named, gradients, strict=True):
        require(gradient is not None, f"{name}: no gradient reaches {key}")
        require(bool(gradient.isfinite().all()), f"{name}: the gradient of {key} is not finite")


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


def asked(what: str, function: Callable[[Tensor], Answer], given: Tensor) -> Answer:
    """The answer to a tensor; require that there is one, and that the tensor was not written to."""
    before = given.clone()
    try:
        answer = function(given)
    except FprfError:
        raise
    except Exception as error:
        line = (str(error).splitlines() or [""])[0][:200]
        raise AssertionError(f"{what}: expected an answer, found {type(error).__name__}: {line}") from error
    require(torch.equal(before, given), f"{what}: expected an input that is left alone, found an input that was written to")
    return answer


@contextmanager
def told_of(config: PluginConfig) -> Iterator[None]:
    """Raise PluginError with the plug-in's name and package for a requirement within that does not hold."""
    try:
        yield
    except AssertionError as breach:
        try:
            name = registry.name_of(config.group, type(config))
            who = f"{config.group}: {name!r} ({registry.entry(config.group, name).origin})"
        except PluginError:  # of a test, or of a script
            who = f"{type(config).__module__}:{type(config).__qualname__}"
        raise PluginError(f"{who}: {breach}; mend or uninstall that package, or choose another plug-in") from breach
