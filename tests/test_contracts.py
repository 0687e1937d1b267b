"""The contracts themselves: built-ins keep to them, and each breach is told."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest
import torch
from torch import Tensor

from fprf import testing
from fprf.fields.config import PlanesConfig, SemanticPlanesConfig
from fprf.fields.layouts import AdaptiveConfig, GridConfig, LayoutConfig, SingleConfig, StreetConfig
from fprf.interfaces import BlockLayout, Decoder, Encoder, Executor, Sampler, Stylizer
from fprf.plugins import registry
from fprf.plugins.decoders.config import DecoderConfig
from fprf.plugins.encoders.config import EncoderConfig, RandomConfig
from fprf.plugins.executors.config import ExecutorConfig, SerialConfig
from fprf.plugins.samplers.config import ProposalConfig, SamplerConfig, UniformConfig
from fprf.plugins.stylizers.config import StylizerConfig
from fprf.types import Boxes, Sampled, Site, Want

BUILT_IN: list[tuple[Callable[[Any], None], Any]] = [
    (testing.check_encoder, RandomConfig(channels=5, stride=3)),
    (testing.check_sampler, UniformConfig(samples=4)),
    (testing.check_sampler, ProposalConfig(samples=(8,), final=4, resolutions=(8,))),
    (testing.check_content_field, PlanesConfig(resolutions=(4, 8), channels=2, hidden=8)),
    (testing.check_semantic_field, SemanticPlanesConfig(resolutions=(4, 8), channels=2, hidden=8)),
    (testing.check_layout, SingleConfig()),
    (testing.check_layout, GridConfig()),
    (testing.check_layout, AdaptiveConfig()),
    (testing.check_layout, StreetConfig()),
    (testing.check_executor, SerialConfig()),
    *(
        (testing.check_stylizer, registry.load("fprf.stylizers", n, StylizerConfig)())
        for n in registry.installed("fprf.stylizers")
    ),
]


@pytest.mark.parametrize(("check", "config"), BUILT_IN, ids=lambda value: getattr(value, "__name__", type(value).__name__))
def test_built_ins_keep_to_the_contract(check: Callable[[Any], None], config: Any) -> None:
    check(config)


class Strange(Encoder):
    """Every other pixel, with one thing wrong."""

    def __init__(self, wrong: str) -> None:
        super().__init__()
        self.wrong = wrong
        self.train(wrong == "training")
        if wrong == "learning":
            self.weight = torch.nn.Parameter(torch.ones(()))

    @property
    def identity(self) -> str:
        return str(id(self)) if self.wrong == "named" else "strange"

    @property
    def channels(self) -> int:
        return 4 if self.wrong == "miscounted" else 3

    def forward(self, image: Tensor) -> Tensor:
        changed: dict[str, Callable[[], Tensor]] = {
            "unstable": lambda: image + torch.rand_like(image),
            "batch": lambda: image - image.mean(),
            "square": lambda: torch.nn.functional.interpolate(image, (64, 12)),
            "divides": lambda: image / image.amax((1, 2, 3), keepdim=True),
        }
        return changed.get(self.wrong, lambda: image[..., ::2, ::2])()


@dataclass(frozen=True, kw_only=True)
class StrangeConfig(EncoderConfig):
    wrong: str = ""

    def build(self) -> Encoder:
        return Strange(self.wrong) if self.wrong != "dict" else {}  # type: ignore[return-value]


def test_a_plain_encoder_passes() -> None:
    testing.check_encoder(StrangeConfig())


@pytest.mark.parametrize(
    ("wrong", "breach"),
    [
        ("unstable", "must be deterministic"),
        ("batch", "must not depend on its batch"),
        ("square", "do not keep the aspect"),
        ("miscounted", "expected shape"),
        ("divides", "not finite"),
        ("named", "identity must be the same"),
        ("training", "evaluation mode"),
        ("learning", "must not want gradients"),
        ("dict", "not an fprf.interfaces.Encoder"),
    ],
)
def test_a_breach_of_an_encoder_is_told(wrong: str, breach: str) -> None:
    with pytest.raises(AssertionError, match=breach):
        testing.check_encoder(StrangeConfig(wrong=wrong))


@dataclass(frozen=True)
class Positional(EncoderConfig):
    layer: int = 1


@dataclass(frozen=True, kw_only=True)
class Typed(EncoderConfig):
    type: int = 1


def test_breaches_of_a_config_are_told() -> None:
    with pytest.raises(AssertionError, match="keyword-only"):
        testing.check_config(Positional())
    with pytest.raises(AssertionError, match="must not be called 'type'"):
        testing.check_config(Typed())


class Backwards(Sampler):
    def forward(self, rays: Any, *, space: Any, step: Any, generator: Any) -> Sampled:
        s = torch.linspace(1, 0, 5).expand(len(rays.near), 5)
        return Sampled(s, space.distance(s, rays.near, rays.far))

    def penalties(self) -> dict[str, Tensor]:
        return {}


@dataclass(frozen=True, kw_only=True)
class BackwardsConfig(SamplerConfig):
    def build(self, *, seed: int) -> Sampler:
        return Backwards()


class Bright(Decoder):
    def forward(self, content: Tensor) -> Tensor:
        return content[:, :3]

    def restyled(self, content: Tensor, styled: Tensor, strength: float | Tensor) -> Tensor:
        return self(styled)

    def frozen_colour(self, content: Tensor) -> None:
        return None


@dataclass(frozen=True, kw_only=True)
class BrightConfig(DecoderConfig):
    def build(self, *, encoder: str, channels: int, seed: int = 0) -> Decoder:
        return Bright()


class Averaging(Stylizer):
    @property
    def needs(self) -> Want:
        return Want.CONTENT

    def forward(self, content: Tensor, semantic: Tensor | None) -> Tensor:
        return content - content.mean(0)

    def match(self, semantic: Tensor) -> Tensor:
        return torch.ones(len(semantic), 1)


@dataclass(frozen=True, kw_only=True)
class AveragingConfig(StylizerConfig):
    def build(self, *, dictionary: Any, scene: Any) -> Stylizer:
        return Averaging()


class Halves(BlockLayout):
    def cut(self, site: Site) -> Boxes:
        low = torch.tensor([[-1.0, -1.0, -1.0], [0.0, -1.0, -1.0]])
        return Boxes(low, low + 1, 2 * torch.eye(3).expand(2, 3, 3), 0.1)


@dataclass(frozen=True, kw_only=True)
class HalvesConfig(LayoutConfig):
    def build(self) -> BlockLayout:
        return Halves()


class Silent(Executor):
    def map(self, function: Any, tasks: Any) -> list[Any]:
        return [function(task) for task in tasks if task >= 0]


@dataclass(frozen=True, kw_only=True)
class SilentConfig(ExecutorConfig):
    def build(self) -> Executor:
        return Silent()


@pytest.mark.parametrize(
    ("check", "config", "breach"),
    [
        (testing.check_sampler, BackwardsConfig(), "must be sorted"),
        (testing.check_stylizer, AveragingConfig(), "must not depend on the others"),
        (testing.check_layout, HalvesConfig(), "orthonormal"),
        (lambda config: testing.check_decoder(config, encoder="any", channels=6), BrightConfig(), r"in \[0, 1\]"),
        (testing.check_executor, SilentConfig(), "must reach the caller"),
    ],
)
def test_breaches_of_other_kinds_are_told(check: Callable[[Any], None], config: Any, breach: str) -> None:
    with pytest.raises(AssertionError, match=breach):
        check(config)


def test_a_parser_is_checked_on_a_real_scene(shared: Any) -> None:
    from fprf.datamanagers.parsers.config import LlffConfig, TransformsConfig

    scenes = shared / "data" / "scenes"
    testing.check_parser(TransformsConfig(), scenes / "fox")
    with pytest.raises(Exception, match="poses_bounds"):
        testing.check_parser(LlffConfig(), scenes / "fox")
