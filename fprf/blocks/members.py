"""What a scene of blocks is made of: one member a block, and one for the surroundings."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Annotated

from torch import Tensor, nn

from ..interfaces import ContentField, Sampler, SemanticField
from .charts import Chart

__all__ = ["Held", "Member", "Members"]


class Member(nn.Module):
    """Fields and sampler of one block, and where they apply. Points are those of the scene's space."""

    def __init__(self, chart: Chart, sampler: Sampler, field: ContentField, semantic: SemanticField | None) -> None:
        super().__init__()
        self.chart = chart
        self.sampler = sampler
        self.field = field
        self.semantic = semantic

    def proposal(self, level: int, points: Annotated[Tensor, "n 3"]) -> Annotated[Tensor, "n"]:
        """Density of a level of the sampler's own fields."""
        found: Tensor = self.sampler.fields[level](self.chart.locate(points))
        return found


class Members(ABC):
    """Members by number: in memory, or fetched when they are asked for."""

    @abstractmethod
    def member(self, number: int) -> Member:
        """One of them."""

    @property
    @abstractmethod
    def held(self) -> Sequence[Member]:
        """Those that live as long as the model, whose parameters are its own."""


class Held(Members):
    """All of them in memory."""

    def __init__(self, members: Sequence[Member]) -> None:
        self._members = tuple(members)

    def member(self, number: int) -> Member:
        """The member."""
        return self._members[number]

    @property
    def held(self) -> Sequence[Member]:
        """All."""
        return self._members
