"""The contracts themselves: built-ins and plain plug-ins keep to them, and each breach is told. Parsers:
tests/datamanagers.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from fprf import testing
from fprf.blocks.config import AdaptiveConfig, BisectConfig, GridConfig, LayoutConfig, SingleConfig
from fprf.datamanagers.config import FeatureTargets, RayBatchesConfig, TrainingPixels
from fprf.fields.config import ContentFieldConfig, PlanesConfig, SemanticPlanesConfig
from fprf.interfaces import (
    BlockLayout,
    ContentField,
    DataManager,
    Decoder,
    Encoder,
    Executor,
    LossTerm,
    Parts,
    Sampler,
    Stylizer,
)
from fprf.plugins import registry
from fprf.plugins.decoders.config import DecoderConfig
from fprf.plugins.decoders.decoders import MlpDecoder
from fprf.plugins.encoders.config import EncoderConfig, RandomConfig
from fprf.plugins.executors.config import ExecutorConfig, SerialConfig
from fprf.plugins.losses.config import LossTermConfig
from fprf.plugins.samplers.config import ProposalConfig, SamplerConfig, UniformConfig
from fprf.plugins.stylizers.config import StylizerConfig
from fprf.types import Batch, Cell, FieldSample, Rendered, Sampled, Site, Want

BUILT_IN: list[tuple[Callable[[Any], None], Any]] = [
    (testing.check_encoder, RandomConfig(channels=5, stride=3)),
    (testing.check_sampler, UniformConfig(samples=1)),
    (testing.check_sampler, UniformConfig(samples=33)),
    (testing.check_sampler, ProposalConfig(samples=(5,), final=1, resolutions=(4,), channels=3)),
    (testing.check_sampler, ProposalConfig(samples=(20, 10, 6), final=4, resolutions=(4, 4, 9), padding=1.0)),
    (testing.check_content_field, PlanesConfig(resolutions=(4, 8), channels=2, hidden=8)),
    (testing.check_content_field, PlanesConfig(resolutions=(5,), channels=3, hidden=4, layers=0, degree=1)),
    (testing.check_semantic_field, SemanticPlanesConfig(resolutions=(4, 8), channels=2, hidden=8)),
    (testing.check_semantic_field, SemanticPlanesConfig(resolutions=(3,), channels=5, hidden=4, layers=0)),
    (testing.check_layout, SingleConfig()),
    (testing.check_layout, GridConfig()),
    (testing.check_layout, AdaptiveConfig()),
    (testing.check_layout, BisectConfig(count=5)),
    (testing.check_executor, SerialConfig()),
    (testing.check_data_manager, RayBatchesConfig(rays=64, semantic_share=0.5)),
    *(
        (testing.check_stylizer, registry.load("fprf.stylizers", n, StylizerConfig)())
        for n in registry.installed("fprf.stylizers")
    ),
]


@pytest.mark.parametrize(
    ("check", "config"), BUILT_IN, ids=lambda value: getattr(value, "__name__", type(value).__name__)
)
def test_built_ins_keep_to_the_contract(check: Callable[[Any], None], config: Any) -> None:
    check(config)


class Linear(ContentField):
    """Density and content of one matrix, with one thing wrong."""

    def __init__(self, wrong: str, channels: int, seed: int) -> None:
        super().__init__()
        generator = None if wrong == "seed" else torch.Generator().manual_seed(seed)
        self.weight = nn.Parameter(torch.rand(3, channels, generator=generator))
        self.wrong = wrong
        self.calls = 0
        if wrong == "idle":
            self.spare = nn.Parameter(torch.ones(()))

    def density(self, points: Tensor) -> FieldSample:
        base = points - points.mean(0) if self.wrong == "batch" else points
        density = (base @ self.weight[:, 0]).exp()
        if self.wrong == "device":
            density = density + torch.zeros(len(points), dtype=points.dtype)
        changed = {"negative": -density, "dtype": density.float(), "infinite": density / 0}
        return FieldSample(changed.get(self.wrong, density), points)

    def content(self, latent: Tensor, view: Tensor) -> Tensor:
        content = (latent + view) @ self.weight
        return {"channels": content[:, 1:], "rows": content - content.mean(0)}.get(self.wrong, content)

    def colour(self, latent: Tensor, view: Tensor, decoder: Decoder) -> Tensor:
        rgb = super().colour(latent, view, decoder)
        return rgb / 2 if self.wrong == "shown" else rgb

    def penalties(self) -> dict[str, Tensor]:
        self.calls += 1
        value = self.weight.square().mean()
        if self.wrong == "penalty device":
            value = value + torch.zeros(1, dtype=value.dtype).sum()
        found = {"penalty shape": value[None], "penalty": value * torch.nan}.get(self.wrong, value)
        return {f"own{self.calls if self.wrong == 'penalty names' else ''}": found}


@dataclass(frozen=True, kw_only=True)
class LinearConfig(ContentFieldConfig):
    wrong: str = ""

    def build(self, *, channels: int, seed: int) -> ContentField:
        return Linear(self.wrong, channels, seed)


class Term(LossTerm):
    """Mean square of the weights, with one thing wrong."""

    def __init__(self, wrong: str) -> None:
        self.wrong = wrong

    @property
    def needs(self) -> Want:
        return Want.COLOUR

    def __call__(
        self, rendered: Rendered, batch: Batch, parts: Parts, *, step: int, generator: torch.Generator | None
    ) -> Tensor:
        assert rendered.weights is not None
        weights = rendered.weights
        opacity = rendered.weights.sum(1)
        value = opacity.square().mean()
        wrongs: dict[str, Callable[[], Tensor]] = {
            "item": lambda: value * (1 if value.item() > 0 else 2),
            "bool": lambda: value if value > 0 else -value,
            "mask": lambda: weights[weights > -1].mean(),
            "log": lambda: torch.log(opacity).mean(),
            "root": lambda: opacity.sqrt().mean(),
            "detached": lambda: value.detach(),
            "rays": lambda: opacity,
            "random": lambda: value * torch.rand(()),
            "device": lambda: value * torch.linspace(0, 1, 3).mean(),
        }
        return wrongs[self.wrong]() if self.wrong else value


@dataclass(frozen=True, kw_only=True)
class TermConfig(LossTermConfig):
    wrong: str = ""

    def build(self) -> LossTerm:
        return Term(self.wrong)


class Pixels(DataManager):
    """The built-in one, with one thing wrong."""

    def __init__(self, inner: DataManager, wrong: str) -> None:
        self.inner = inner
        self.wrong = wrong
        self.calls = 0
        self.content_store = inner.content_store
        self.semantic_store = inner.semantic_store

    def batch(self, step: int) -> Batch:
        self.calls += 1
        batch = self.inner.batch(self.calls if self.wrong == "calls" else 0 if self.wrong == "step" else step)
        changed = {
            "held": {"view": torch.ones_like(batch.view)},
            "corner": {"pixel": batch.pixel - 0.5},
            "outside": {"pixel": batch.pixel + 30},
            "colour": {"rgb": 1 - batch.rgb},
            "none": {"content": None},
            "channels": {"semantic": None if batch.semantic is None else batch.semantic[:, 1:]},
        }
        return batch._replace(**changed.get(self.wrong, {}))

    def image(self, view: int) -> Tensor:
        image = self.inner.image(view)
        return {"range": 255 * image, "turned": image.mT}.get(self.wrong, image)


@dataclass(frozen=True, kw_only=True)
class PixelsConfig(RayBatchesConfig):
    rays: int = 64
    wrong: str = ""

    def build(
        self, pixels: TrainingPixels, targets: FeatureTargets, *, seed: int, **named: Any
    ) -> DataManager:
        drawn = 0 if self.wrong == "seed" else seed
        return Pixels(super().build(pixels, targets, seed=drawn, **named), self.wrong)

    def batch_rays(self) -> int:
        return 3 if self.wrong == "count" else self.rays


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


@dataclass(frozen=True)
class Positional(EncoderConfig):
    layer: int = 1


@dataclass(frozen=True, kw_only=True)
class Typed(EncoderConfig):
    type: int = 1


class Backwards(Sampler):
    def forward(self, rays: Any, *, space: Any, step: Any, generator: Any) -> Sampled:
        s = torch.linspace(1, 0, 5).expand(len(rays.near), 5)
        return Sampled(s, space.distance(s, rays.near, rays.far))

    def penalties(self) -> dict[str, Tensor]:
        return {}


class Bright(Decoder):
    def forward(self, content: Tensor) -> Tensor:
        return content[:, :3]


class Dimmed(MlpDecoder):
    """More than its layers."""

    def forward(self, content: Tensor) -> Tensor:
        return super().forward(content) / 2


class Averaging(Stylizer):
    @property
    def needs(self) -> Want:
        return Want.CONTENT

    def forward(self, content: Tensor, semantic: Tensor | None) -> Tensor:
        return content - content.mean(0)

    def match(self, semantic: Tensor) -> Tensor:
        return torch.ones(len(semantic), 1)


class Halves(BlockLayout):
    def cut(self, site: Site) -> list[Cell]:
        corners = torch.tensor([[0.0] * 3, [1.0] * 3], dtype=torch.float64)
        return [Cell(low=low, high=low + 1, border=0.1 * (low + 1)) for low in corners]


class Silent(Executor):
    def map(self, function: Any, tasks: Any) -> list[Any]:
        return [function(task) for task in tasks if task >= 0]


def giving(base: type, made: object) -> Any:
    """A config of a kind that builds this object."""
    kind = type("Given", (base,), {"build": lambda self, **_: made})
    return dataclass(frozen=True, kw_only=True)(kind)()


BREACHES: list[tuple[Callable[..., None], Any, dict[str, str]]] = [
    (
        testing.check_content_field,
        LinearConfig,
        {
            "shown": "colour must be the content, decoded",
            "seed": "drawn from the seed alone",
            "batch": "must not depend on the others",
            "rows": "content: a point must not depend on the others",
            "negative": r"expected numbers in \[0, inf\]",
            "infinite": "not finite",
            "channels": r"expected float32 \[",
            "idle": "no gradient reaches spare",
            "dtype": r"density: expected torch\.float64 on cpu .* found torch\.float32",
            "device": "density: makes a tensor that is not on the device",
            "penalty": "'own' is not finite",
            "penalty shape": "'own' must be a scalar",
            "penalty names": "the same penalties at each call",
            "penalty device": "'own': makes a tensor that is not on the device",
        },
    ),
    (
        testing.check_loss_term,
        TermConfig,
        {
            "item": "reads numbers of the device",
            "bool": "reads numbers of the device",
            "mask": "reads numbers of the device",
            "log": "of rays that meet nothing: expected finite numbers",
            "root": "gradient for rays that meet nothing is not finite",
            "detached": "no gradient goes through",
            "rays": r"expected float32 \[",
            "random": "a function of its inputs",
            "device": "not on the device of its inputs",
        },
    ),
    (
        testing.check_data_manager,
        PixelsConfig,
        {
            "calls": "a function of the seed and the step",
            "step": "another step",
            "seed": "another seed",
            "held": "training views alone",
            "corner": "must be centres",
            "outside": "must be centres",
            "colour": "the colour of the pixel",
            "none": "must bring what stores hold",
            "channels": r"semantic: expected float32 \[",
            "range": r"expected numbers in \[0, 1\]",
            "turned": r"image: expected float32 \[",
            "count": "the rays of a batch, 64",
        },
    ),
    (
        testing.check_encoder,
        StrangeConfig,
        {
            "unstable": "must be deterministic",
            "batch": "must not depend on its batch",
            "square": "do not keep the aspect",
            "miscounted": r"expected float32 \[",
            "divides": "not finite",
            "named": "identity must be the same",
            "training": "evaluation mode",
            "learning": "must not want gradients",
            "dict": r"not an fprf\.interfaces\.Encoder",
        },
    ),
]
OTHERS: list[tuple[Callable[[Any], None], Any, str]] = [
    (testing.check_config, Positional(), "keyword-only"),
    (testing.check_config, Typed(), "must not be called 'type'"),
    (testing.check_sampler, giving(SamplerConfig, Backwards()), "must be sorted"),
    (testing.check_stylizer, giving(StylizerConfig, Averaging()), "must not depend on the others"),
    (testing.check_layout, giving(LayoutConfig, Halves()), "same border"),
    (
        partial(testing.check_decoder, encoder="any", channels=6),
        giving(DecoderConfig, Bright()),
        r"in \[0, 1\]",
    ),
    (
        partial(testing.check_decoder, encoder="any", channels=6),
        giving(DecoderConfig, Dimmed(6, 4)),
        "layers must be what forward does",
    ),
    (testing.check_executor, giving(ExecutorConfig, Silent()), "must reach the caller"),
]


def test_plain_plug_ins_keep_to_the_contract() -> None:
    for check, kind, _ in BREACHES:
        check(kind())


@pytest.mark.parametrize(
    ("check", "config", "breach"),
    [
        *(
            pytest.param(check, kind(wrong=wrong), breach, id=f"{kind.__name__}-{wrong}")
            for check, kind, wrongs in BREACHES
            for wrong, breach in wrongs.items()
        ),
        *(pytest.param(*row, id=row[2]) for row in OTHERS),
    ],
)
def test_a_breach_is_told(check: Callable[[Any], None], config: Any, breach: str) -> None:
    with pytest.raises(AssertionError, match=breach):
        check(config)
