"""Block layouts: how a scene is cut. One block over the whole scene is the default."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from ..plugins.config import PluginConfig

if TYPE_CHECKING:
    from ..interfaces import BlockLayout

__all__ = ["LayoutConfig", "SingleConfig"]


@dataclass(frozen=True, kw_only=True)
class LayoutConfig(PluginConfig):
    """Cuts a scene into blocks."""

    group: ClassVar[str] = "fprf.layouts"

    def build(self) -> BlockLayout:
        """The layout in unit-cube coordinates."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class SingleConfig(LayoutConfig):
    """One block over the whole scene."""

    def build(self) -> BlockLayout:
        """The layout."""
        from .blocks import SingleLayout

        return SingleLayout()
