"""Requirements that say in one sentence what was found where, as AssertionError, and the checks of the
program's own.

Contracts (`testing.styling` and its neighbours) are made of them. The first outputs of plug-ins are checked while a model or a
style is built: a breach is told with the plug-in's name, as PluginError, not met later as a strange image. A
handful of points cost milliseconds, and nothing afterwards.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TypeVar

import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode

from ..errors import FprfError, PluginError
from ..interfaces import ContentField, Sampler, SemanticField, Stylizer
from ..plugins import registry
from ..plugins.config import PluginConfig
from ..plugins.losses.config import LossTermConfig
from ..plugins.stylizers.config import StylizerConfig
from ..types import Rays, Want

if TYPE_CHECKING:
    from ..config import TrainConfig
    from ..interfaces import Parts
    from ..style.dictionary import StyleDictionary
    from ..style.scene_style import SceneStyle

Answer = TypeVar("Answer")
POINTS = 5
"""Points that a part of a package is tried on: no square, so that axes that are mixed up show."""
_SLACK = 1e-5
"""Beyond the range of an output that passes for rounding."""


def require(condition: bool, breach: str) -> None:
    """Raise AssertionError with the sentence unless the condition holds (also under `python -O`)."""
    if not condition:
        raise AssertionError(breach)


def tensor(
    value: Tensor,
    shape: tuple[int | None, ...],
    what: str,
    low: float = -math.inf,
    high: float = math.inf,
    slack: float = 0.0,
) -> None:
    """Require a finite float32 tensor on the CPU of that shape, of which None stands for any size, from low
    to high.
    """
    wanted = f"float32 [{' '.join('any' if size is None else str(size) for size in shape)}] on cpu"
    require(isinstance(value, Tensor), f"{what}: expected {wanted}, found {type(value).__name__}")
    found = kind_of(value)
    sizes = tuple(value.shape)
    fits = len(sizes) == len(shape) and all(
        want in (None, size) for want, size in zip(shape, sizes, strict=True)
    )
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
    if tolerance:
        scale = max(1.0, float(wanted.abs().max()))
    else:
        scale = 1.0
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
    """Require that the result of a call, and tensors that it makes, take device and dtype from its inputs,
    like `like`.

    Called with float64 on the CPU, while new tensors that name no device are put elsewhere: those cannot be
    computed with.
    """
    # Results first: then a tensor made without a device, which would land elsewhere on an accelerator.
    plain = call()
    kind_found = f"{plain.dtype} on {plain.device}"
    kind = f"{like.dtype} on {like.device}"
    require(kind_found == kind, f"{name}: expected {kind} for inputs of that kind, found {kind_found}")
    try:
        with torch.device("meta"):
            again = call()
    except (RuntimeError, TypeError, ValueError) as fault:
        line = " ".join(str(fault).split())
        raise AssertionError(
            f"{name}: makes a tensor that is not on the device of its inputs ({line})"
        ) from fault
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
    named = {}
    for key, value in module.named_parameters():
        if value.requires_grad:
            named[key] = value
    require(loss.requires_grad or not named, f"{name}: no gradient goes through its answer")
    if named:
        gradients = torch.autograd.grad(loss, list(named.values()), allow_unused=True)
    else:
        gradients = ()
    for key, gradient in zip(named, gradients, strict=True):
        require(gradient is not None, f"{name}: no gradient reaches {key}")
        require(bool(gradient.isfinite().all()), f"{name}: the gradient of {key} is not finite")


class Unread(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Raise AssertionError where the host would wait for the device: `.item()`, `bool`, `nonzero`, a boolean
    index.
    """

    def __init__(self, name: str) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.name = name

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        """Look at one operator."""
        aten = torch.ops.aten
        mask = func is aten.index.Tensor and any(
            i is not None and i.dtype in (torch.bool, torch.uint8) for i in args[1]
        )
        waits = func.overloadpacket in (
            aten._local_scalar_dense,
            aten.nonzero,
            aten.equal,
            aten.masked_select,
        )
        require(
            not (mask or waits),
            f"{self.name}: reads numbers of the device in a step ({func.overloadpacket.__name__})",
        )
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
    require(
        torch.equal(before, given),
        f"{what}: expected an input that is left alone, found an input that was written to",
    )
    return answer


@contextmanager
def naming_plugin(config: PluginConfig) -> Iterator[None]:
    """Raise PluginError with the plug-in's name and package for a requirement within that does not hold."""
    try:
        yield
    except AssertionError as breach:
        try:
            name = registry.name_of(config.group, type(config))
            who = f"{config.group}: {name!r} ({registry.entry(config.group, name).origin})"
        except PluginError:  # of a test, or of a script
            who = f"{type(config).__module__}:{type(config).__qualname__}"
        raise PluginError(
            f"{who}: {breach}; mend or uninstall that package, or choose another plug-in"
        ) from breach


@torch.no_grad()
def check_parts(config: "TrainConfig", parts: "Parts", channels: int, dim: int) -> None:
    """Fields, decoder and sampler of a model on the CPU, at some points of the unit cube. Raises
    PluginError.
    """
    points = 0.9 * torch.sin(torch.arange(3.0 * POINTS).view(POINTS, 3))
    view = torch.nn.functional.normalize(points + 2, dim=1)
    # Each part is fed what the one before it returned, as in a render, so the first breach names its maker.
    with naming_plugin(config.content.field):
        sample = asked("density", parts.field.density, points)
        tensor(sample.density, (POINTS,), "density", low=0.0, slack=_SLACK)
        tensor(sample.latent, (POINTS, None), "the latent")
        features = asked("content", lambda some: parts.field.content(sample.latent, some), view)
        tensor(features, (POINTS, channels), "content")
    with naming_plugin(config.content.decoder):
        tensor(
            asked("colours", parts.decoder, features), (POINTS, 3), "colours", low=0.0, high=1.0, slack=_SLACK
        )
    if parts.semantic is not None:
        with naming_plugin(config.semantic.field):
            tensor(asked("semantics", parts.semantic, points), (POINTS, dim), "semantics")
    # In NDC near is a depth in the world, and rays go from 0 to 1.
    if parts.space.kind == "ndc":
        near, far = (0.0, 1.0)
    else:
        near, far = (parts.space.near, parts.space.far)
    rays = Rays(torch.zeros(POINTS, 3), view, view, torch.full((POINTS,), near), torch.full((POINTS,), far))
    with naming_plugin(config.sampler):
        sampler = parts.sampler
        space = parts.space
        sampled = asked(
            "edges",
            lambda origin: sampler(rays._replace(origin=origin), space=space, step=None, generator=None),
            rays.origin,
        )
        if isinstance(sampled.t, Tensor) and sampled.t.ndim:
            count = sampled.t.shape[-1]
        else:
            count = 0
        for name, edges in (("edges s", sampled.s), ("edges t", sampled.t)):
            tensor(edges, (POINTS, count), name)
            rising = count >= 2 and bool((edges.diff(dim=1) >= 0).all())
            require(
                rising,
                f"{name}: expected at least two, not decreasing along a ray, found {count}, of which some decrease",
            )


@torch.no_grad()
def check_stylizer(
    config: StylizerConfig,
    stylizer: Stylizer,
    dictionary: "StyleDictionary",
    scene: "SceneStyle",
    *,
    affine: bool = False,
) -> None:
    """A stylizer on the CPU, at some points about the scene's mean. Raises PluginError.

    `affine` says that the scene's content is its colours, which are known by what becomes of black and of
    each channel.
    """

    def spread(middle: Tensor) -> Tensor:
        channels = middle.numel()
        return middle.float().cpu() + 0.1 * torch.cos(
            torch.arange(float(POINTS * channels)).view(POINTS, channels)
        )

    content = spread(scene.mean)
    semantic = spread(scene.semantic_mean)
    with naming_plugin(config):
        check_needs(stylizer, "needs")
        given = None
        if Want.SEMANTIC in stylizer.needs:
            given = semantic
        styled = asked("features", lambda some: stylizer(some, given), content)
        tensor(styled, tuple(content.shape), "features")
        shares(asked("matches", stylizer.match, semantic), (POINTS, len(dictionary.keys)), "matches", 1e-3)
        if affine:
            check_affine(stylizer, content, given, "features")


def check_needs(stylizer: Stylizer, what: str) -> None:
    """Require that a stylizer needs content, with semantics or without."""
    needs = stylizer.needs
    allowed = (Want.CONTENT, Want.CONTENT | Want.SEMANTIC)
    require(needs in allowed, f"{what}: expected Want.CONTENT, with Want.SEMANTIC or without, found {needs}")


def check_affine(stylizer: Stylizer, content: Tensor, semantic: Tensor | None, what: str) -> None:
    """Require that what lies between two contents is styled as what lies between their styles."""
    other = content.flip(0) + 0.1
    between = torch.lerp(stylizer(content, semantic), stylizer(other, semantic), 0.3)
    straight = close(stylizer(torch.lerp(content, other, 0.3), semantic), between, 1e-3)
    require(
        straight,
        f"{what}: expected an affine map of content, or `colours` above 0 in the config, found a bent one",
    )


def check_term(config: LossTermConfig, term: Tensor, like: Tensor) -> None:
    """Raise PluginError unless a training term is a scalar of the kind of another tensor. Reads no number of
    it.
    """
    expected = kind_of(like.new_empty(()))
    with naming_plugin(config):
        require(isinstance(term, Tensor), f"the term: expected {expected}, found {type(term).__name__}")
        require(kind_of(term) == expected, f"the term: expected {expected}, found {kind_of(term)}")
