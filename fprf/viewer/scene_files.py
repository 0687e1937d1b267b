"""What a file or folder holds that a scene can be made of, and the files of a scene as a browser sends them, in pieces.

A piece is one request: the server's limits on bodies hold, and a file may be of any size. A file is checked by its first bytes
before any of it is written, and has its name only when it is whole.
"""

import os
import shutil
import threading
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Literal, NamedTuple, TypeAlias

from ..datamanagers.images import IMAGE_SUFFIXES
from ..datamanagers.parsers.config import recognise
from ..errors import DataError, UsageError
from ..plugins.captures import endings, format_name, format_of
from ..reconstruction.images import VIDEO_SUFFIXES
from .uploads import check_photograph

SourceKind: TypeAlias = Literal["run", "capture", "scene", "photographs", "video"]
_FEWEST = 3
"""Photographs that poses can be found for."""
_MODEL = frozenset({"cameras", "images", "points3D", "rigs", "frames"})
"""Files of a COLMAP model, without their endings .bin and .txt."""
_ATOMS = (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip")
"""Kinds of the first part of an MP4 or QuickTime file."""
_MAX_FILES = 4000
_MAX_BYTES = 16 << 30
"""Of all files of a scene."""
_ROOM = 1 << 30
"""Bytes of the disk that are left free."""
_MAX_DEPTH, _MAX_NAME = 6, 120


class Source(NamedTuple):
    """Kind of source that a scene is made of."""

    kind: SourceKind
    """`scene` = photographs with their poses."""
    path: Path


def capture_suffixes() -> frozenset[str]:
    """Last endings of files of 3D Gaussians, in lower case: .ply of .compressed.ply too."""
    return frozenset(f".{ending.rpartition('.')[2]}" for ending in endings())


def _kinds() -> str:
    return f"photographs, a video, or a capture of 3D Gaussians ({' '.join(sorted(capture_suffixes()))})"


def is_capture(path: Path) -> bool:
    """True for a path that is named like a capture of 3D Gaussians."""
    return format_name(path) is not None or (path / "meta.json").is_file()


def newest_step(run: Path) -> int:
    """Step of the newest whole checkpoint; -1 where there is none."""
    steps = (path.parent.name.removeprefix("step-") for path in run.glob("checkpoints/step-*/manifest.json"))
    return max((int(step) for step in steps if step.isdigit()), default=-1)


def find_source(path: Path) -> Source:
    """Return the kind of a file or folder, by names alone. Raises DataError where no scene can be made of it."""
    if (path / "config.json").is_file():
        return Source("run", path)
    if is_capture(path):
        return Source("capture", path)
    if path.suffix.lower() in VIDEO_SUFFIXES and path.is_file():
        return Source("video", path)
    if not path.exists():
        raise DataError(f"{path}: no such file or folder")
    if not path.is_dir():
        raise DataError(f"{path}: no scene can be made of it; give {_kinds()}")
    files = [each for each in path.rglob("*") if each.is_file() and not each.name.startswith(".")]
    try:
        recognise(path)
        return Source("scene", path)
    except DataError:
        pass  # its photographs have no poses
    photographs = [each for each in files if each.suffix.lower() in IMAGE_SUFFIXES]
    if len(photographs) >= _FEWEST:
        return Source("photographs", path)
    singles: tuple[tuple[SourceKind, frozenset[str]], ...] = (("capture", capture_suffixes()), ("video", VIDEO_SUFFIXES))
    for kind, suffixes in singles:
        single = [each for each in files if each.suffix.lower() in suffixes]
        if len(single) == 1 and not photographs:
            return Source(kind, single[0])
        if len(single) > 1:
            some = ", or ".join(path.name for path in single[:3])
            raise DataError(f"{len(single)} {kind}s; a scene is made of one: give {some}")
    if photographs:
        few = "1 photograph is" if len(photographs) == 1 else f"{len(photographs)} photographs are"
        raise DataError(f"{few} no scene: take at least {_FEWEST}, better 20 to 60, from places around it")
    raise DataError(f"{path.name}: nothing that a scene can be made of; give {_kinds()}")


def check_file(name: str, head: bytes, size: int) -> None:
    """Raise DataError for a file that no scene is made of, by its name, its first bytes and its size."""
    suffix, stem = Path(name).suffix.lower(), Path(name).stem
    if suffix in IMAGE_SUFFIXES:
        check_photograph(head, name)
        return
    whole = {
        **({suffix: format_of(Path(name)).recognises(head, size)} if suffix in capture_suffixes() else {}),
        ".npz": head.startswith(b"PK"),
        ".npy": head.startswith(b"\x93NUMPY"),
        ".json": head.lstrip()[:1] in (b"{", b"["),
        **dict.fromkeys(VIDEO_SUFFIXES, head[4:8] in _ATOMS or head[8:11] == b"AVI" or head.startswith(b"\x1aE\xdf\xa3")),
        **dict.fromkeys((".bin", ".txt") if stem in _MODEL else (), True),
    }
    if suffix not in whole:
        raise DataError(f"{name}: cannot become a scene; give {_kinds()}")
    if not whole[suffix]:
        raise DataError(f"{name}: damaged, or no {suffix} file; export it again")


class SceneFiles:
    """Receives the files of one scene into `folder`, which is made with the first of them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._files = self._bytes = 0
        self._lock = threading.Lock()

    def add(self, name: str, at: int, size: int, data: bytes) -> None:
        """Take the piece of a file of `size` bytes that begins at byte `at`; pieces come in their order.

        Raises UsageError for a name that leads elsewhere and for a piece out of order, DataError for what is not taken.
        """
        path = self.folder.joinpath(*_parts(name))
        part = path.with_name(f"{path.name}.part")
        with self._lock:
            if at == 0:
                check_file(path.name, data, size)
                self._begin(path, size)
                part.unlink(missing_ok=True)
            written = part.stat().st_size if part.is_file() else 0
            if written != at or at + len(data) > size or (at > 0 and not data):
                raise UsageError(f"{path.name}: a piece at byte {at} of {size}, where {written} are there; send it again")
            with part.open("ab") as file:
                file.write(data)
            if at + len(data) == size:
                os.replace(part, path)

    def _begin(self, path: Path, size: int) -> None:
        if self._files >= _MAX_FILES or self._bytes + size > _MAX_BYTES:
            raise DataError(f"{path.name}: a scene takes at most {_MAX_FILES} files of {_MAX_BYTES >> 30} GiB in all")
        path.parent.mkdir(parents=True, exist_ok=True)
        if shutil.disk_usage(path.parent).free < size + _ROOM:
            raise DataError(f"{path.name}: the disk of {self.folder} is full; make room there")
        self._files, self._bytes = self._files + 1, self._bytes + size


def _parts(name: str) -> Sequence[str]:
    """The parts of a file's name below its folder. Raises UsageError for one that leads out of it, or is no plain name."""
    parts = PurePosixPath(name).parts
    plain = all(
        part.isprintable() and not part.startswith(".") and not {*part} & {*'\\:*?"<>|'} and len(part) <= _MAX_NAME
        for part in parts
    )
    if not parts or not plain or name.startswith("/") or len(parts) > _MAX_DEPTH:
        raise UsageError(f"{name[:80]!r}: no name of a file in a folder; rename it")
    return parts
