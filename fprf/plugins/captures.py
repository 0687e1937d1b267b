"""Formats of files of 3D Gaussians: what each reads and writes, and which one a file's name means. Imports no torch.

The name of a format's entry point in `fprf.captures` is the ending of its files: `sog` stands for *.sog. Where several fit,
the longest does (`compressed.ply` before `ply`).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from mmap import mmap
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, TypeAlias

from ..errors import DataError
from ..io.atomic import atomic_path
from . import registry
from .config import PluginConfig

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from ..splats.files import Capture
    from ..splats.gaussians import Gaussians
    from ..types import Origin


Data: TypeAlias = bytes | mmap
"""The content of a file: large ones are mapped. Both are sliced into bytes, and read by np.frombuffer."""


@dataclass(frozen=True, kw_only=True)
class CaptureFormat(PluginConfig):
    """A format of files of 3D Gaussians. It has no state: there is nothing to build."""

    group: ClassVar[str] = "fprf.captures"

    view_dependent: ClassVar[bool] = True
    """It holds harmonics, and whether opacities are compensated for antialiasing. Where it does not, it is given the mean
    colours and opacities that views show."""
    writes: ClassVar[bool] = True
    """False = files of it are read alone, and what was read from them is written as another format."""
    reads: ClassVar[bool] = True
    """False = files of it are written alone."""
    exact: ClassVar[bool] = False
    """It holds every number as it is, NaN too, and positions in float64. Where it does not, it is given Gaussians that can be
    drawn, about a local origin that stands in a file beside."""

    def recognises(self, head: bytes, size: int) -> bool:
        """False where a file of `size` bytes that begin with `head` is certainly damaged or of another format."""
        raise NotImplementedError

    def read(self, path: Path, data: Data) -> Capture:
        """The Gaussians of a file, and how to recolour it. Raises DataError for anything else than a sound file."""
        raise NotImplementedError

    def pack(self, gaussians: Gaussians, antialiased: bool, origin: Origin) -> Iterable[bytes]:
        """The file of these Gaussians, on the CPU, in pieces. `origin` is to be added to their positions; 0 unless `exact`."""
        raise DataError(f"{type(self).__name__}: files of this format are read, not written; name a .ply, .spz, .sog or .glb")

    def keeps(self, gaussians: Gaussians) -> NDArray[np.bool_] | None:
        """Gaussians [N] that a file holds: all but outliers that would cost the others their precision; None = all."""
        return None

    def notes(self, gaussians: Gaussians) -> list[str]:
        """What else a file cannot hold of them, each as a phrase."""
        return []

    def holds(self, capture: Capture, read_as: CaptureFormat) -> bool:
        """Whether a capture's own file, recoloured, is a file of this format."""
        return self.writes and self.reads and type(read_as) is type(self)

    def write(self, path: Path, pieces: Iterable[bytes]) -> None:
        """Write what `pack` or `Capture.recolour` gave, whole or not at all."""
        with atomic_path(path) as temporary, temporary.open("wb") as file:
            file.writelines(pieces)


def endings() -> tuple[str, ...]:
    """Endings of the files of installed formats, with their dot; an index of a folder (lod-meta.json) has none of its own."""
    return tuple(f".{name}" for name in registry.installed(CaptureFormat.group) if not name.endswith(".json"))


def format_name(path: Path) -> str | None:
    """The installed format that a file is of by its name; None where it is of none. A meta.json is that of a SOG folder."""
    name = path.name.lower()
    if name == "meta.json":
        return "sog"
    installed = registry.installed(CaptureFormat.group)
    fits = [each for each in installed if name.endswith(f".{each}") or (name == each and "." in each)]
    return max(fits, key=len, default=None)


def format_of(path: Path) -> CaptureFormat:
    """The format of a file by its name. Raises DataError where it is of none, PluginError where that cannot be loaded."""
    name = format_name(path)
    if name is None:
        raise DataError(
            f"{path}: no file of Gaussians by its name; known endings are {', '.join(endings())}, or meta.json of a SOG folder"
        )
    return registry.make(CaptureFormat.group, name, CaptureFormat)


def is_scene(path: Path) -> bool:
    """Whether a path is that of a capture or of a run, and so of no photograph."""
    if path.is_dir():
        return any((path / name).is_file() for name in ("meta.json", "lod-meta.json", "config.json"))
    return format_name(path) is not None
