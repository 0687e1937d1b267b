"""A renderer's parts that are small enough to be checked by hand."""

from typing import Any

import torch
from torch import Tensor, nn

from fprf.fields.config import PlanesConfig, SemanticPlanesConfig
from fprf.interfaces import ContentField, Decoder, SemanticField, Stylizer
from fprf.plugins.samplers.config import ProposalConfig, UniformConfig
from fprf.rendering.renderer import Parts
from fprf.rendering.space import Kind, Space
from fprf.types import FieldSample, Rays, Want

EYE = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
C, D = 5, 3


class Squash(Decoder):
    """The first three channels through a sigmoid."""

    def forward(self, content: Tensor) -> Tensor:
        return torch.sigmoid(content[:, :3])


class Uniform(ContentField):
    """One density everywhere, or one for each of the samples; one content everywhere."""

    def __init__(self, density: float | Tensor, content: float = 0.0) -> None:
        super().__init__()
        self.value = nn.Parameter(torch.as_tensor(density))
        self.feature = content

    def density(self, points: Tensor) -> FieldSample:
        return FieldSample(self.value.expand(len(points)), points)

    def content(self, latent: Tensor, view: Tensor) -> Tensor:
        return latent.new_full((len(latent), C), self.feature)

    def penalties(self) -> dict[str, Tensor]:
        return {}


class Ones(SemanticField):
    """Semantics of 1 everywhere: a render of them is the opacity."""

    def forward(self, points: Tensor) -> Tensor:
        return points.new_ones(len(points), D)

    def penalties(self) -> dict[str, Tensor]:
        return {}


class Shift(Stylizer):
    """Adds 1, and the semantics' sum where it reads them. Remembers what it was given."""

    def __init__(self, reads: bool = False) -> None:
        super().__init__()
        self.reads = reads
        self.points: list[int] = []

    @property
    def needs(self) -> Want:
        return Want.CONTENT | Want.SEMANTIC if self.reads else Want.CONTENT

    def forward(self, content: Tensor, semantic: Tensor | None) -> Tensor:
        assert (semantic is not None) == self.reads
        self.points.append(len(content))
        return content + 1 + (0 if semantic is None else semantic.sum(-1, keepdim=True))

    def match(self, semantic: Tensor) -> Tensor:
        return semantic.new_ones(len(semantic), 1)


class Never(nn.Module):
    """Stands where nothing may be computed."""

    def __getattr__(self, name: str) -> Any:
        if name in ("density", "content", "needs"):
            raise AssertionError(f"{name} must not be asked for")
        return super().__getattr__(name)

    def forward(self, *given: Tensor) -> Tensor:
        raise AssertionError("must not be called")


def space_of(kind: Kind) -> Space:
    return Space(kind, (0.0, 0.0, 0.0), EYE, 1.0, 0.05, 1e3, focal=(1.5, 1.5))


def parts_of(kind: Kind = "contraction", seed: int = 0, thickness: float = 3.0, proposal: bool = False) -> Parts:
    sampler = ProposalConfig(samples=(12,), final=9, resolutions=(6,)) if proposal else UniformConfig(samples=17)
    field = PlanesConfig(resolutions=(4, 9), channels=8, hidden=16).build(channels=C, seed=seed)
    with torch.no_grad():
        for name, weight in field.named_parameters():
            if "to_density" in name or "table" in name:
                weight.mul_(thickness)
    semantic = SemanticPlanesConfig(resolutions=(4,), channels=8, hidden=16).build(channels=D, seed=seed + 1)
    return Parts(space_of(kind), sampler.build(seed=seed), field, semantic, Squash())


def rays_of(kind: Kind, count: int, seed: int = 0) -> Rays:
    draw = torch.Generator().manual_seed(seed)
    origin = torch.randn(count, 3, dtype=torch.float64, generator=draw) * 0.3
    direction = torch.randn(count, 3, dtype=torch.float64, generator=draw)
    if kind == "ndc":
        direction = direction * 0.2 - torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    return space_of(kind).rays(origin, direction / direction.norm(dim=-1, keepdim=True))
