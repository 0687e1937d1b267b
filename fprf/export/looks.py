"""The looks that a scene is exported in: as it is, and each style with its name."""

import re
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from ..errors import UsageError
from ..style.config import StyleConfig
from ..style.files import StyleFile, check_photographs, read_style, with_folders
from .config import ExportConfig

if TYPE_CHECKING:
    from ..interfaces import Scene
    from ..rendering.renderer import Restyle

__all__ = ["Look", "Named", "make_looks", "named_styles", "style_name", "styles_of"]

_LONGEST = 60
"""Characters of a name, which file names carry."""


class Named(NamedTuple):
    """A style before it is made."""

    name: str
    file: StyleFile


class Look(NamedTuple):
    """The scene as it is (no name, no restyle), or in a style."""

    name: str
    restyle: "Restyle | None"


def style_name(references: Sequence[Path], style: Path | None) -> str:
    """A style file's own name or its folder's, else the stems of the references joined."""
    if style is not None:
        own = style.resolve().parent.name if style.name == "style.json" else style.stem
    else:
        own = "+".join(path.stem for path in references)
    return _tidy(own) or "style"


def named_styles(texts: Sequence[str], base: StyleFile, report: Callable[[str], None] = warnings.warn) -> list[Named]:
    """Styles from NAME=STYLE.json or NAME=PHOTO[,PHOTO ...]; photographs go with the other settings of `base`.

    Folders stand for the images in them, and `report` is told which of these cannot be read. Raises UsageError for another
    form or a name that comes twice, and what reading a style file raises.
    """
    found = []
    for text in texts:
        name, equals, what = text.partition("=")
        if not (equals and name and what) or name != _tidy(name):
            raise UsageError(
                f"--styles {text}: write NAME=PHOTO,PHOTO or NAME=STYLE.json, with a name of letters, digits, + - and _"
            )
        if what.lower().endswith(".json"):
            file = read_style(Path(what))
            check_photographs(Path(what), file)
        else:
            file = StyleFile(with_folders(_with(base.style, tuple(Path(part) for part in what.split(","))), report))
        found.append(Named(name, file))
    return found


def styles_of(config: ExportConfig, base: StyleFile, report: Callable[[str], None] = warnings.warn) -> list[Named]:
    """The styles that an export names: that of its photographs or style file first. Raises as `named_styles`."""
    styles = named_styles(config.styles, base, report)
    if config.references:
        styles.insert(0, Named(style_name(config.references, config.style), base))
    return styles


def make_looks(scene: "Scene", styles: Sequence[Named]) -> list[Look]:
    """The scene as it is, and each style. Raises UsageError for two of one name, and what `apply_style` raises."""
    from ..training.restyle import apply_style

    names = [style.name for style in styles]
    for name in names:
        if names.count(name) > 1:
            raise UsageError(f"--styles {name}: two styles of this name; give each its own")
    encoders = scene.encoders() if styles else None
    return [Look("", None), *(Look(s.name, apply_style(scene, s.file, encoders).restyle) for s in styles)]


def _with(style: StyleConfig, references: tuple[Path, ...]) -> StyleConfig:
    """Other photographs under the same settings; what names photographs one by one does not carry over."""
    from dataclasses import replace

    return replace(style, references=references, weights=(), masks=(), pin=(), forbid=())


def _tidy(name: str) -> str:
    return re.sub(r"[^\w+-]+", "_", name, flags=re.ASCII).strip("_")[:_LONGEST]
