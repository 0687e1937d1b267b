"""Parser configs. `build` imports the implementation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from ...plugins.config import PluginConfig

if TYPE_CHECKING:
    from ...interfaces import DataParser

__all__ = ["DataParserConfig"]


@dataclass(frozen=True, kw_only=True)
class DataParserConfig(PluginConfig):
    """Reads one capture format."""

    group: ClassVar[str] = "fprf.dataparsers"

    def build(self) -> DataParser:
        """The parser."""
        raise NotImplementedError
