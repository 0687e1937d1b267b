"""Stylizer configs. `build` imports the implementation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from ..config import PluginConfig

if TYPE_CHECKING:
    from ...interfaces import Stylizer
    from ...style.dictionary import StyleDictionary
    from ...style.scene import SceneStyle

__all__ = ["StylizerConfig"]


@dataclass(frozen=True, kw_only=True)
class StylizerConfig(PluginConfig):
    """Moves content features from the scene's style to the references'."""

    group: ClassVar[str] = "fprf.stylizers"

    def build(self, *, dictionary: StyleDictionary, scene: SceneStyle) -> Stylizer:
        """The stylizer of these references on this scene."""
        raise NotImplementedError
