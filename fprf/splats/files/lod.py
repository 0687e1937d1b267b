"""Streamed SOG (PlayCanvas), read alone: a lod-meta.json, and folders of SOG that it names, at the finest
level.

`tree` has `children`, or at its leaves `lods`: by the number of a level, 0 the finest, the rows of one of
`filenames`. Files of coarser levels alone are not opened. `environment` is one more SOG, which is always
shown.
"""

import json
import posixpath
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from ...errors import DataError
from . import base
from .base import Bools, Capture, CaptureFormat, Data, Floats
from .sog import Sog
from .sog_archive import bundle


@dataclass(frozen=True, kw_only=True)
class StreamedSog(CaptureFormat):
    """PlayCanvas' lod-meta.json."""

    writes: ClassVar[bool] = False

    def recognises(self, head: bytes, size: int) -> bool:
        return head.lstrip()[:1] == b"{"

    def read(self, path: Path, data: Data) -> Capture:
        """The Gaussians of the finest level. Raises DataError where files are missing, damaged or differ."""
        try:
            wanted = _finest_rows(json.loads(bytes(data)))
        except base.UNSOUND as error:
            raise DataError(
                f"{path}: no sound lod-meta.json ({error!r}); not a streamed SOG, or it is damaged"
            ) from error
        # Files are read one by one; the cache knows the capture by the content of all.
        parts: list[tuple[Floats, ...]] = []
        archives = {path.name: bytes(data)}
        antialiased = True
        for name, rows in wanted.items():
            chunk = Sog().read(path.parent / name, base.beside(path, name))
            _check_rows(path, name, rows, len(chunk.gaussians))
            for each in rows:
                means, *others = base.arrays(chunk.gaussians.select(each))
                parts.append((means + np.array(chunk.shift), *others))
            archives[name] = bytes(chunk.data)
            antialiased = antialiased and chunk.antialiased
        if len({part[-1].shape[1] for part in parts}) > 1:
            raise DataError(f"{path}: files of different degrees of harmonics; export the capture again")
        if not parts:
            raise DataError(f"{path}: holds no Gaussian")
        sections = []
        for part in parts:
            sections.append((len(part[0]), partial(_some_rows, part)))
        gaussians, shift = base.decoded(parts[0][-1].shape[1], *sections)
        return Capture(path, gaussians, antialiased, bundle(archives), _not_recoloured, shift=shift)


def _finest_rows(index: dict[str, Any]) -> dict[str, list[slice]]:
    """Of each leaf the rows of its finest level, by the file that has them; all of the environment. Raises one
    of `base.UNSOUND` for no valid index.
    """
    if index.get("version", 1) != 1:
        raise ValueError(f"version {index['version']!r}; version 1 is read")
    wanted: dict[str, list[slice]] = {}
    waiting = [index["tree"]]
    while waiting:
        node = waiting.pop()
        waiting += reversed(node.get("children", []))
        if not node.get("lods"):
            continue
        level = node["lods"][min(node["lods"], key=int)]
        first = level["offset"]
        count = level["count"]
        numbers = (first, count, level["file"])
        if not all(isinstance(number, int) and number >= 0 for number in numbers):
            raise ValueError(f"a leaf of {count} Gaussians from {first} on")
        name = posixpath.normpath(index["filenames"][level["file"]])
        wanted.setdefault(name, []).append(slice(first, first + count))
    if index.get("environment"):
        wanted[posixpath.normpath(index["environment"])] = [slice(0, None)]
    return wanted


def _check_rows(path: Path, name: str, rows: list[slice], count: int) -> None:
    """Raise DataError where leaves have more Gaussians than their file: that would multiply a small file."""
    leaves = []
    for each in rows:
        if each.stop is not None:
            leaves.append(each)
    together = sum(each.stop - each.start for each in leaves)
    last = max((each.stop for each in leaves), default=0)
    most = max(together, last)
    if most > count:
        raise DataError(f"{path}: {name} has {count} Gaussians, its leaves {most}; export it again")


def _some_rows(part: tuple[Floats, ...], rows: slice) -> tuple[Floats, ...]:
    return tuple(each[rows] for each in part)


def _not_recoloured(harmonics: Floats, changed: Bools) -> tuple[bytes, ...]:
    """Nothing: files of this format are read alone."""
    return ()
