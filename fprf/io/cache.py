"""The cache: files that can be made again, between one command and the next.

It lies in $XDG_CACHE_HOME, or in ~/.cache. Where that cannot be written to (a container whose user has no
home, a read-only folder, a full disk) work goes on without it, and one line says so. Only here is decided
where the cache is.
"""

import atexit
import functools
import os
import shutil
import sys
import tempfile
from contextlib import suppress
from pathlib import Path

_BLOCK_OF_ZEROS = bytes(4096)
"""A block of a disk: where it is full a file can still be made, but not filled."""
_NOWHERE = Path(os.devnull, "fprf")
"""A folder that cannot be: what is to be written to it stays in memory."""


def cache_home() -> Path | None:
    """The user's cache, $XDG_CACHE_HOME or ~/.cache; None for a user without a home."""
    named = os.environ.get("XDG_CACHE_HOME")
    if named:
        return Path(named)
    home = Path(os.path.expanduser("~"))
    # Neither HOME is set nor does the system know this user id: the name stays as it is.
    return home / ".cache" if home.is_absolute() else None


def user_folder(name: str) -> Path:
    """Folder NAME of fprf in the user's cache, whether or not it can be used; one that cannot be where the
    user has none.
    """
    home = cache_home()
    if home is None:
        return _NOWHERE / name
    return home / "fprf" / name


def cache_folder(name: str) -> Path:
    """Folder NAME of fprf in the user's cache. Where that cannot be written to, a temporary one that ends
    with this process, which one line says.

    A folder that can only be read stays where something lies in it; what is new then goes elsewhere
    (`io.tensorfiles.keep`).
    """
    folder = user_folder(name)
    reason = refusal(folder)
    if not reason or files_in(folder, "*"):
        return folder
    say_uncached(folder, reason)
    return temporary_folder(name) or folder


def refusal(folder: Path) -> str:
    """Why nothing can be written into a folder, which is made where it is absent; empty where it can."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(_BLOCK_OF_ZEROS)
    except OSError as error:
        return reason_of(error)
    return ""


def reason_of(error: Exception) -> str:
    """Words of the system, without the name of a file; of a WriteError, that of its cause."""
    number = getattr(error.__cause__ or error, "errno", None)
    return os.strerror(number) if number else str(error)


def files_in(folder: Path, pattern: str) -> list[Path]:
    """The files of that pattern directly in a folder of the cache; none where it is absent or closed to us."""
    try:
        return list(folder.glob(pattern))
    except OSError:
        return []


def forget_oldest(folder: Path, count: int) -> None:
    """Remove the tensor files of a folder but for so many, which were asked for last."""
    with suppress(OSError):  # another process removes files, too: what is left the next one finds
        files = [each for each in folder.glob("*.safetensors") if each.is_file()]
        files.sort(key=lambda each: each.stat().st_mtime)
        for old in files[:-count]:
            old.unlink(missing_ok=True)


def temporary_folder(name: str) -> Path | None:
    """Folder NAME of those that end with this process; None where the system has no place for it."""
    root = _temporary_root()
    if root is None:
        return None
    folder = root / name
    return None if refusal(folder) else folder


@functools.cache
def _temporary_root() -> Path | None:
    try:
        root = Path(tempfile.mkdtemp(prefix="fprf-cache-"))
    except OSError:
        return None
    atexit.register(shutil.rmtree, root, ignore_errors=True)
    return root


def say_uncached(folder: Path, reason: str) -> None:
    """Tell once, on standard error, that what would be kept in `folder` is made again by each command."""
    home = cache_home()
    if home is not None and folder.is_relative_to(home):
        folder = home
    _say_once("this user has no home" if folder.is_relative_to(_NOWHERE) else f"{folder}: {reason}")


@functools.cache
def _say_once(fault: str) -> None:
    print(
        f"note: nothing is kept for the next command, which makes it slower ({fault}); set XDG_CACHE_HOME, for "
        "compiled kernels alone NUMBA_CACHE_DIR, to a folder that can be written to",
        file=sys.stderr,
    )
