"""What can be turned when an image is rendered, one knob at a time, and the presets of `--quality`."""

import copy
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import replace
from typing import Annotated, Any, NamedTuple

import torch
from torch import Tensor, nn

from ..config import RenderConfig
from ..fields.planes import Planes
from ..interfaces import SemanticField
from ..plugins.stylizers.config import StylizerConfig
from ..rendering.cameras import Cameras
from ..style.look import Restyle
from ..training.loading import Trained
from ..training.model import Facts, Model
from ..training.quality import PRESETS, QualityConfig, at_quality
from ..training.restyle import Styled
from ..training.views import render_view
from .naive import plain_planes, replaced
from .views import plainly, view_rays

__all__ = ["BUDGETS", "SAMPLES", "Setting", "as_rendered", "half_planes", "plain_settings", "styled_settings"]

BUDGETS = {"0": 0.0, "1/4096": 1 / 4096, "1/1024": 1 / 1024, "1/512": 1 / 512, "1/256": 1 / 256, "1/64": 1 / 64, "1/16": 1 / 16}
SAMPLES = (0.25, 0.5, 0.75, 1.5, 2.0, 4.0)
CHUNKS = (1024, 4096, 32768)
SIZES = (0.25, 0.5, 0.75)
Draw = Callable[[Cameras, int], Annotated[Tensor, "H W 3"]]
"""Renders one view at its camera's size."""


class Setting(NamedTuple):
    """One value of one knob."""

    knob: str
    value: str
    draw: Draw

    @property
    def name(self) -> str:
        """Knob and value."""
        return f"{self.knob} {self.value}"


def plain_settings(trained: Trained, styled: Styled) -> Iterator[Setting]:
    """Everything but the style; and the style at strength 0, which must cost nothing and change nothing."""
    yield from _settings(trained, None)
    nothing = replace(styled.restyle, strength=0.0)
    yield Setting("style", "at strength 0", _drawer(trained.model, trained.known.facts, trained.config.render, nothing))


def styled_settings(trained: Trained, styled: Styled, stylizer: StylizerConfig) -> Iterator[Setting]:
    """The same in a style, and how many semantic channels it looks at."""
    yield from _settings(trained, styled.restyle)
    dim = styled.scene.keys.shape[1]
    for channels in sorted({max(1, dim // 8), max(1, dim // 4), max(1, dim // 2)} - {dim}):
        yield Setting("semantic channels", f"{channels} of {dim}", _fewer_channels(trained, styled, stylizer, channels))


def as_rendered(knob: str, value: str, trained: Trained) -> Setting:
    """A run as its own config renders it."""
    return Setting(knob, value, _drawer(trained.model, trained.known.facts, trained.config.render, None))


def _settings(trained: Trained, look: Restyle | None) -> Iterator[Setting]:
    render = trained.config.render
    model, facts = trained.model, trained.known.facts
    yield Setting("run", "as trained", _drawer(model, facts, render, look))
    for preset in PRESETS:
        chosen = at_quality(trained, QualityConfig(quality=preset))
        yield Setting("quality", preset, _drawer(chosen.model, facts, chosen.config.render, look))
    for name, budget in BUDGETS.items():
        yield Setting("budget", name, _drawer(model, facts, replace(render, budget=budget), look))
    for share in SAMPLES:
        chosen = at_quality(trained, QualityConfig(samples=share))
        yield Setting("samples", f"x {share:g}", _drawer(chosen.model, facts, chosen.config.render, look))
    for chunk in CHUNKS:
        yield Setting("chunk", str(chunk), _drawer(model, facts, replace(render, chunk=chunk), look))
    for size in SIZES:
        yield Setting("resolution", f"x {size:g}", _drawer(model, facts, replace(render, resolution=size), look))
    yield Setting("kernels", "none, plain torch", _plain_drawer(model, facts, render, look, nullcontext))
    yield Setting("kernels", "none, grid_sample", _plain_drawer(model, facts, render, look, lambda: plain_planes(model)))
    stored = half_planes(model)
    yield Setting("precision", "planes stored in float16", _drawer(stored, facts, render, look))
    yield Setting("precision", "plain, bfloat16", _plain_drawer(model, facts, render, look, lambda: half_networks(model)))


def _drawer(model: Model, facts: Facts, render: RenderConfig, look: Restyle | None) -> Draw:
    return lambda cameras, view: render_view(model, facts, cameras, view, render, look).rgb


def _plain_drawer(
    model: Model,
    facts: Facts,
    render: RenderConfig,
    look: Restyle | None,
    around: Callable[[], AbstractContextManager[None]],
) -> Draw:
    def draw(cameras: Cameras, view: int) -> Tensor:
        width, height = (int(v) for v in cameras.size[view])
        with around():
            return plainly(model, facts, view_rays(model, cameras, view), render, look).view(height, width, 3).cpu()

    return draw


@contextmanager
def half_networks(model: Model) -> Iterator[None]:
    """Content, semantics and decoder in bfloat16; planes, density and compositing stay in float32. For `plainly` alone: kernels
    have one precision.
    """
    device = model.device.type

    def around(method: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any) -> Any:
            with torch.autocast(device, dtype=torch.bfloat16):
                return method(*args).float()

        return call

    with ExitStack() as stack:
        stack.enter_context(replaced(model.field, "content", around))
        stack.enter_context(replaced(model.decoder, "forward", around))
        stack.enter_context(replaced(model.decoder, "restyled", around))
        if model.semantic is not None:
            stack.enter_context(replaced(model.semantic, "forward", around))
        yield


def half_planes(model: Model) -> Model:
    """A copy whose planes are stored in half precision; kernels for the CPU read float32, so there they are only rounded."""
    made = copy.deepcopy(model).requires_grad_(False)
    for module in made.modules():
        if isinstance(module, Planes):
            half = module.table.half()
            module.table = nn.Parameter(half if half.device.type == "cuda" else half.float(), requires_grad=False)
    return made


class _Leading(SemanticField):
    """The first channels of a semantic field: principal components, most variance first."""

    def __init__(self, field: SemanticField, channels: int) -> None:
        super().__init__()
        self.field, self.channels = field, channels

    def forward(self, points: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N D"]:
        """Fewer channels of the same features."""
        features: Tensor = self.field(points)
        return features[:, : self.channels]

    def penalties(self) -> dict[str, Tensor]:
        """None: it is not trained."""
        return {}


def _fewer_channels(trained: Trained, styled: Styled, stylizer: StylizerConfig, channels: int) -> Draw:
    parts = trained.model.parts
    assert parts.semantic is not None
    scene = styled.scene._replace(keys=styled.scene.keys[:, :channels], semantic_mean=styled.scene.semantic_mean[:channels])
    origin = None if styled.dictionary.origin is None else styled.dictionary.origin[:channels]
    dictionary = styled.dictionary._replace(keys=styled.dictionary.keys[:, :channels], origin=origin)
    device = trained.model.device
    built = stylizer.build(dictionary=dictionary, scene=scene).to(device)
    model = Model(parts._replace(semantic=_Leading(parts.semantic, channels))).eval()
    look = replace(styled.restyle, stylizer=built)
    return _drawer(model, trained.known.facts, trained.config.render, look)
