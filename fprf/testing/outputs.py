"""First outputs of plug-ins, checked while a model or a style is built: a breach is told with the plug-in's name, not met
later as a strange image. A handful of points cost milliseconds, and nothing afterwards.
"""

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ..interfaces import Stylizer
from ..plugins.losses.config import LossTermConfig
from ..plugins.stylizers.config import StylizerConfig
from ..types import Rays, Want
from .breaches import asked, close, kind_of, require, shares, tensor, told_of

if TYPE_CHECKING:
    from ..config import TrainConfig
    from ..rendering.renderer import Parts
    from ..style.dictionary import StyleDictionary
    from ..style.scene_style import SceneStyle

POINTS = 5
_SLACK = 1e-5
"""Beyond the range of an output that passes for rounding."""


@torch.no_grad()
def check_parts(config: "TrainConfig", parts: "Parts", channels: int, dim: int) -> None:
    """Fields, decoder and sampler of a model on the CPU, at some points of the unit cube. Raises PluginError."""
    points = 0.9 * torch.sin(torch.arange(3.0 * POINTS).view(POINTS, 3))
    view = torch.nn.functional.normalize(points + 2, dim=1)
    with told_of(config.content.field):
        sample = asked("density", parts.field.density, points)
        tensor(sample.density, (POINTS,), "density", low=0.0, slack=_SLACK)
        tensor(sample.latent, (POINTS, None), "the latent")
        features = asked("content", lambda some: parts.field.content(sample.latent, some), view)
        tensor(features, (POINTS, channels), "content")
    with told_of(config.content.decoder):
        tensor(asked("colours", parts.decoder, features), (POINTS, 3), "colours", low=0.0, high=1.0, slack=_SLACK)
    if parts.semantic is not None:
        with told_of(config.semantic.field):
            tensor(asked("semantics", parts.semantic, points), (POINTS, dim), "semantics")
    # In NDC near is a depth in the world, and rays go from 0 to 1.
    near, far = (0.0, 1.0) if parts.space.kind == "ndc" else (parts.space.near, parts.space.far)
    rays = Rays(torch.zeros(POINTS, 3), view, view, torch.full((POINTS,), near), torch.full((POINTS,), far))
    with told_of(config.sampler):
        sampler, space = parts.sampler, parts.space
        sampled = asked(
            "edges", lambda origin: sampler(rays._replace(origin=origin), space=space, step=None, generator=None), rays.origin
        )
        count = sampled.t.shape[-1] if isinstance(sampled.t, Tensor) and sampled.t.ndim else 0
        for name, edges in (("edges s", sampled.s), ("edges t", sampled.t)):
            tensor(edges, (POINTS, count), name)
            rising = count >= 2 and bool((edges.diff(dim=1) >= 0).all())
            require(rising, f"{name}: expected at least two, not decreasing along a ray, found {count}, of which some decrease")


@torch.no_grad()
def check_stylizer(
    config: StylizerConfig, stylizer: Stylizer, dictionary: "StyleDictionary", scene: "SceneStyle", *, affine: bool = False
) -> None:
    """A stylizer on the CPU, at some points about the scene's mean. Raises PluginError.

    `affine` says that the scene's content is its colours, which are known by what becomes of black and of each channel.
    """

    def spread(middle: Tensor) -> Tensor:
        channels = middle.numel()
        return middle.float().cpu() + 0.1 * torch.cos(torch.arange(float(POINTS * channels)).view(POINTS, channels))

    content, semantic = spread(scene.mean), spread(scene.semantic_mean)
    with told_of(config):
        check_needs(stylizer, "needs")
        given = semantic if Want.SEMANTIC in stylizer.needs else None
        styled = asked("features", lambda some: stylizer(some, given), content)
        tensor(styled, tuple(content.shape), "features")
        shares(asked("matches", stylizer.match, semantic), (POINTS, len(dictionary.keys)), "matches", 1e-3)
        if affine:
            check_affine(stylizer, content, given, "features")


def check_needs(stylizer: Stylizer, what: str) -> None:
    """Require that a stylizer needs content, with semantics or without."""
    needs, allowed = stylizer.needs, (Want.CONTENT, Want.CONTENT | Want.SEMANTIC)
    require(needs in allowed, f"{what}: expected Want.CONTENT, with Want.SEMANTIC or without, found {needs}")


def check_affine(stylizer: Stylizer, content: Tensor, semantic: Tensor | None, what: str) -> None:
    """Require that what lies between two contents is styled as what lies between their styles."""
    other = content.flip(0) + 0.1
    between = torch.lerp(stylizer(content, semantic), stylizer(other, semantic), 0.3)
    straight = close(stylizer(torch.lerp(content, other, 0.3), semantic), between, 1e-3)
    require(straight, f"{what}: expected an affine map of content, or `colours` above 0 in the config, found a bent one")


def check_term(config: LossTermConfig, term: Tensor, like: Tensor) -> None:
    """Raise PluginError unless a training term is a scalar of the kind of another tensor. Reads no number of it."""
    expected = kind_of(like.new_empty(()))
    with told_of(config):
        require(isinstance(term, Tensor), f"the term: expected {expected}, found {type(term).__name__}")
        require(kind_of(term) == expected, f"the term: expected {expected}, found {kind_of(term)}")
