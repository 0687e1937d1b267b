"""Paths as users write them: text or `os.PathLike`, `~` for the home folder, wildcards that no shell has expanded."""

import glob
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TypeAlias

from ..errors import UsageError

PathLike: TypeAlias = str | os.PathLike[str]


def as_path(written: PathLike) -> Path:
    """The path that a text or a path-like object names; `~` and `~user` at its start are home folders.

    Raises UsageError where the home folder is not known, TypeError for what is no path.
    """
    text = os.path.expanduser(os.fspath(written))
    if text == "~" or text.startswith(("~/", f"~{os.sep}")):
        raise UsageError(f"{text}: the home folder is not known (HOME is not set); write the whole path")
    return Path(text)


def as_paths(written: PathLike | Iterable[PathLike]) -> tuple[Path, ...]:
    """The paths of one text or path-like object, or of several."""
    if isinstance(written, str | os.PathLike):
        return (as_path(written),)
    return tuple(as_path(each) for each in written)


def has_wildcards(path: Path) -> bool:
    """True for a path with `*`, `?` or `[...]` that is not the name of something that is there."""
    return glob.has_magic(str(path)) and not os.path.lexists(path)


def expanded(paths: Sequence[Path]) -> tuple[Path, ...]:
    """The paths with what their wildcards match in the place of each; `**` stands for folders of any depth.

    Matches come in the order of their names, hidden files are none. Raises UsageError where nothing matches.
    """
    found: list[Path] = []
    for path in paths:
        if not has_wildcards(path):
            found.append(path)
            continue
        matches = sorted(glob.glob(str(path), recursive=True))
        if not matches:
            raise UsageError(f"{path}: no file matches; check the folder and the wildcards")
        found.extend(Path(match) for match in matches)
    return tuple(found)
