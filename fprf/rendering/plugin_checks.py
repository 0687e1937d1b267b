"""Checks of a plug-in's first outputs: a breach is told with its name, not met later as a strange image.

A handful of points cost milliseconds, and nothing afterwards. `fprf.testing` has whole contracts, for a plug-in's own tests.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, TypeVar

import torch
from torch import Tensor

from ..config import TrainConfig
from ..errors import FprfError, PluginError
from ..interfaces import Stylizer
from ..plugins import registry
from ..plugins.config import PluginConfig
from ..plugins.losses.config import LossTermConfig
from ..plugins.stylizers.config import StylizerConfig
from ..types import Rays, Want
from .renderer import Parts

if TYPE_CHECKING:
    from ..style.dictionary import StyleDictionary
    from ..style.scene import SceneStyle

T = TypeVar("T")
POINTS = 5


@torch.no_grad()
def check_parts(config: TrainConfig, parts: Parts, channels: int, dim: int) -> None:
    """Fields, decoder and sampler of a model on the CPU, at some points. Raises PluginError."""
    content, semantic = config.content, config.semantic.field
    points, view = _points(), torch.nn.functional.normalize(_points() + 2, dim=1)
    sample = _asked(content.field, "density", parts.field.density, points)
    _look(content.field, "density", sample.density, (POINTS,), low=0.0)
    _look(content.field, "the latent", sample.latent, (POINTS, None))
    features = _asked(content.field, "content", lambda some: parts.field.content(sample.latent, some), view)
    _look(content.field, "content", features, (POINTS, channels))
    colour = _asked(content.decoder, "colours", parts.decoder, features)
    _look(content.decoder, "colours", colour, (POINTS, 3), low=0.0, high=1.0)
    if parts.semantic is not None:
        _look(semantic, "semantics", _asked(semantic, "semantics", parts.semantic, points), (POINTS, dim))
    # In NDC near is a depth in the world, and rays go from 0 to 1.
    ends = (0.0, 1.0) if parts.space.kind == "ndc" else (parts.space.near, parts.space.far)
    near, far = (torch.full((POINTS,), edge) for edge in ends)
    rays = Rays(torch.zeros(POINTS, 3), view, view, near, far)
    sampled = _asked(
        config.sampler,
        "edges",
        lambda origin: parts.sampler(rays._replace(origin=origin), space=parts.space, step=None, generator=None),
        rays.origin,
    )
    count = sampled.t.shape[-1] if isinstance(sampled.t, Tensor) and sampled.t.ndim else 0
    for name, edges in (("edges s", sampled.s), ("edges t", sampled.t)):
        _look(config.sampler, name, edges, (POINTS, count))
        if count < 2 or bool((edges.diff(dim=1) < 0).any()):
            raise _breach(config.sampler, name, "at least two, not decreasing along a ray", f"{count}, of which some decrease")


@torch.no_grad()
def check_stylizer(config: StylizerConfig, stylizer: Stylizer, dictionary: "StyleDictionary", scene: "SceneStyle") -> None:
    """A stylizer on the CPU, at some points about the scene's mean. Raises PluginError."""
    needs = stylizer.needs
    if Want.CONTENT not in needs or needs | Want.CONTENT | Want.SEMANTIC != Want.CONTENT | Want.SEMANTIC:
        raise _breach(config, "needs", "Want.CONTENT, with Want.SEMANTIC or without", str(needs))
    content = scene.mean.float().cpu() + _spread(scene.mean.numel())
    semantic = scene.semantic_mean.float().cpu() + _spread(scene.semantic_mean.numel())
    given = semantic if Want.SEMANTIC in needs else None
    styled = _asked(config, "features", lambda some: stylizer(some, given), content)
    _look(config, "features", styled, tuple(content.shape))
    shares = _asked(config, "matches", stylizer.match, semantic)
    _look(config, "matches", shares, (POINTS, len(dictionary.keys)), low=0.0)
    if float((shares.sum(1) - 1).abs().max()) > 1e-3:
        raise _breach(config, "matches", "rows that sum to 1", f"a sum of {float(shares[0].sum()):g}")


def check_term(config: LossTermConfig, term: Tensor, like: Tensor) -> None:
    """Raise PluginError unless a training term is a scalar of the kind of another tensor. Reads no number of it."""
    expected = f"{_kind(like)} [] on {like.device}"
    if not isinstance(term, Tensor):
        raise _breach(config, "the term", expected, type(term).__name__)
    if term.ndim or term.dtype != like.dtype or term.device != like.device:
        raise _breach(config, "the term", expected, f"{_kind(term)} [{' '.join(map(str, term.shape))}] on {term.device}")


def _points() -> Annotated[Tensor, "N 3"]:
    return 0.9 * torch.sin(torch.arange(3.0 * POINTS).view(POINTS, 3))


def _spread(channels: int) -> Annotated[Tensor, "N C"]:
    return 0.1 * torch.cos(torch.arange(float(POINTS * channels)).view(POINTS, channels))


def _asked(config: PluginConfig, what: str, function: Callable[[Tensor], T], given: Tensor) -> T:
    """The answer; raises PluginError where there is none, or where the question was written to."""
    before = given.clone()
    try:
        answer = function(given)
    except FprfError:
        raise
    except Exception as error:
        line = (str(error).splitlines() or [""])[0][:200]
        raise _breach(config, what, "an answer", f"{type(error).__name__}: {line}") from error
    if not torch.equal(before, given):
        raise _breach(config, what, "an input that is left alone", "an input that was written to")
    return answer


def _look(
    config: PluginConfig,
    what: str,
    found: Tensor,
    shape: tuple[int | None, ...],
    *,
    low: float = -float("inf"),
    high: float = float("inf"),
) -> None:
    """Raise PluginError unless it is a finite float32 tensor of that shape on the CPU, between low and high."""
    expected = f"float32 [{' '.join('any' if size is None else str(size) for size in shape)}] on cpu"
    if not isinstance(found, Tensor):
        raise _breach(config, what, expected, type(found).__name__)
    own = tuple(found.shape)
    fits = len(own) == len(shape) and all(want in (None, size) for want, size in zip(shape, own, strict=True))
    if not fits or found.dtype != torch.float32 or found.device.type != "cpu":
        raise _breach(config, what, expected, f"{_kind(found)} [{' '.join(map(str, own))}] on {found.device}")
    if not bool(found.isfinite().all()):
        raise _breach(config, what, "finite numbers", f"{int((~found.isfinite()).sum())} of {found.numel()} that are not")
    if found.numel() and not low - 1e-5 <= float(found.min()) <= float(found.max()) <= high + 1e-5:
        raise _breach(config, what, f"numbers in [{low:g}, {high:g}]", f"{float(found.min()):g} to {float(found.max()):g}")


def _breach(config: PluginConfig, what: str, expected: str, actual: str) -> PluginError:
    try:
        name = registry.name_of(config.group, type(config))
        who = f"{config.group}: {name!r} ({registry.entry(config.group, name).origin})"
    except PluginError:  # of a test, or of a script
        who = f"{type(config).__module__}:{type(config).__qualname__}"
    return PluginError(
        f"{who}: {what}: expected {expected}, found {actual}; mend or uninstall that package, or choose another plug-in"
    )


def _kind(tensor: Tensor) -> str:
    return str(tensor.dtype).removeprefix("torch.")
