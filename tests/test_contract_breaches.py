"""Fields, losses and data managers: each breach of their contract is told. Parsers: tests/datamanagers."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from fprf import testing
from fprf.datamanagers.config import RayBatchesConfig
from fprf.fields.config import ContentFieldConfig, SemanticFieldConfig
from fprf.interfaces import ContentField, DataManager, LossTerm, SemanticField
from fprf.plugins.losses.config import LossTermConfig
from fprf.rendering.renderer import Parts
from fprf.types import Batch, FieldSample, Rendered, Want


class Linear(ContentField):
    """Density and content of one matrix, with one thing wrong."""

    def __init__(self, wrong: str, channels: int, seed: int) -> None:
        super().__init__()
        generator = None if wrong == "seed" else torch.Generator().manual_seed(seed)
        self.weight, self.wrong, self.calls = nn.Parameter(torch.rand(3, channels, generator=generator)), wrong, 0
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


class Semantic(SemanticField):
    def __init__(self, wrong: str, channels: int) -> None:
        super().__init__()
        self.weight, self.wrong = nn.Parameter(torch.ones(3, channels)), wrong

    def forward(self, points: Tensor) -> Tensor:
        found = points @ self.weight
        changed = {"channels": found[:, 1:], "batch": found - found.mean(0), "frozen": found.detach(), "dtype": found.float()}
        return changed.get(self.wrong, found)

    def penalties(self) -> dict[str, Tensor]:
        return {"own": self.weight.sum(0)} if self.wrong == "penalty" else {}


@dataclass(frozen=True, kw_only=True)
class SemanticConfig(SemanticFieldConfig):
    wrong: str = ""

    def build(self, *, channels: int, seed: int) -> SemanticField:
        return Semantic(self.wrong, channels)


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
        weights, opacity = rendered.weights, rendered.weights.sum(1)
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
        self.inner, self.wrong, self.calls = inner, wrong, 0
        self.content_store, self.semantic_store = inner.content_store, inner.semantic_store

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

    def build(self, *, seed: int, **named: Any) -> DataManager:
        return Pixels(super().build(seed=0 if self.wrong == "seed" else seed, **named), self.wrong)

    def batch_rays(self) -> int:
        return 3 if self.wrong == "count" else self.rays


def test_plain_plug_ins_and_the_built_in_data_manager_pass() -> None:
    testing.check_content_field(LinearConfig())
    testing.check_semantic_field(SemanticConfig())
    testing.check_loss_term(TermConfig())
    testing.check_data_manager(PixelsConfig())
    testing.check_data_manager(RayBatchesConfig(rays=64, semantic_share=0.5))


BREACHES: list[tuple[Callable[..., None], Any, dict[str, str]]] = [
    (
        testing.check_content_field,
        LinearConfig,
        {
            "seed": "drawn from the seed alone",
            "batch": "must not depend on the others",
            "rows": "points must not depend on others",
            "negative": "at least 0",
            "infinite": "not finite",
            "channels": "expected shape",
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
        testing.check_semantic_field,
        SemanticConfig,
        {
            "channels": "expected shape",
            "batch": "must not depend on the others",
            "frozen": "no gradient goes through its answer",
            "dtype": r"expected torch\.float64",
            "penalty": "must be a scalar",
        },
    ),
    (
        testing.check_loss_term,
        TermConfig,
        {
            "item": "reads numbers of the device",
            "bool": "reads numbers of the device",
            "mask": "reads numbers of the device",
            "log": "of rays that meet nothing: holds values that are not finite",
            "root": "gradient for rays that meet nothing is not finite",
            "detached": "no gradient goes through",
            "rays": "expected shape",
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
            "channels": "semantic: expected shape",
            "range": r"must lie in \[0, 1\]",
            "turned": "image: expected shape",
            "count": "the rays of a batch, 64",
        },
    ),
]


@pytest.mark.parametrize(
    ("check", "config", "breach"),
    [
        pytest.param(check, kind(wrong=wrong), breach, id=f"{kind.__name__}-{wrong}")
        for check, kind, wrongs in BREACHES
        for wrong, breach in wrongs.items()
    ],
)
def test_a_breach_is_told(check: Callable[[Any], None], config: Any, breach: str) -> None:
    with pytest.raises(AssertionError, match=breach):
        check(config)
