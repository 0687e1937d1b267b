"""The base of training terms that packages add. `build` imports the implementation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from ...checks import at_least
from ..config import PluginConfig

if TYPE_CHECKING:
    from ...interfaces import LossTerm


@dataclass(frozen=True, kw_only=True)
class LossTermConfig(PluginConfig):
    """A training term beside the built-in ones."""

    group: ClassVar[str] = "fprf.losses"

    weight: float = 1.0
    """Weight of the term; 0 = it is never computed."""

    def __post_init__(self) -> None:
        at_least("loss.extra.weight", self.weight, 0.0)

    def build(self) -> LossTerm:
        """The term."""
        raise NotImplementedError
