"""Files that are whole or absent: written beside their final name, flushed to disk, then renamed over it."""

import errno
import json
import os
import re
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ..errors import NumericsError, WriteError

_UNFINISHED = re.compile(r"\..{1,40}\.[0-9a-f]{8}(\.\w+)?|\.tmp\w{6}")
"""Hidden names of `atomic_path`, and of safetensors beside them."""


def unwritable(path: Path, error: OSError, needed: int | None = None) -> WriteError:
    """Error for a system that refuses to write at `path`; `needed` are the bytes of the file, where they are
    known.
    """
    if error.errno:
        reason = os.strerror(error.errno)
    else:
        reason = str(error)
    try:
        folder = next(p for p in (path.absolute(), *path.absolute().parents) if p.is_dir())
        free = f", {shutil.disk_usage(folder).free >> 10} KiB are free there"
    except (OSError, StopIteration):
        free = ""
    if needed is None:
        wants = ""
    else:
        wants = f", {-(-needed // 1024)} KiB are needed"
    return WriteError(
        f"{path}: cannot be written ({reason}{wants}{free}); make room, or choose a folder that can be written to"
    )


def remove_unfinished(folder: Path) -> None:
    """Delete what killed processes left directly in a folder. Only where nobody else writes.

    Raises WriteError where the system refuses.
    """
    try:
        for path in folder.iterdir() if folder.is_dir() else ():
            if _UNFINISHED.fullmatch(path.name) and path.is_file():
                path.unlink(missing_ok=True)
    except OSError as error:
        raise unwritable(folder, error) from error


def _flush(path: Path, mode: int) -> None:
    handle = os.open(path, mode)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


@contextmanager
def atomic_path(final: Path) -> Iterator[Path]:
    """A hidden name beside `final` to write to; it becomes `final` when the block ends, and is removed if it
    fails.

    Keeps the ending of the name, which encoders choose their format by. Creates the folder. Of a symbolic link
    the file that it leads to is written, and the link stays. A reader sees the old file or the new one,
    whenever the process dies. Raises WriteError where `final` is a folder, its folder
    is a file, or the system refuses: a full disk, a folder without permission, a name that is too long.
    Errors of the block about other files are passed on.
    """
    try:
        if final.is_symlink():
            final = Path(os.path.realpath(final))
        if final.is_symlink():
            raise OSError(errno.ELOOP, "links that lead to each other")
        if final.is_dir():
            raise WriteError(
                f"{final}: a folder is in the place of a file to be written; remove it or choose another name"
            )
        final.parent.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError) as error:
        raise WriteError(
            f"{final}: {error.filename} is a file, not a folder; choose another output"
        ) from error
    except OSError as error:
        raise unwritable(final, error) from error
    # The stem is cut so that a name of the longest length allowed (255 bytes) still has a temporary one.
    temporary = final.with_name(f".{final.stem[:40]}.{secrets.token_hex(4)}{final.suffix}")
    block_ended = False
    try:
        yield temporary
        block_ended = True
        _flush(temporary, os.O_RDWR)
        os.replace(temporary, final)
    except BaseException as error:
        with suppress(OSError):  # it would hide the error that led here
            temporary.unlink()
        if not isinstance(error, OSError):
            raise
        # Errors about another file, a pipe or a network are the block's own; an error of a file that is open
        # names none.
        if error.filename is None:
            refused = error.errno is not None and not isinstance(error, (ConnectionError, TimeoutError))
        else:
            refused = str(temporary) in (str(error.filename), str(error.filename2))
        if block_ended or refused:
            raise unwritable(final, error) from error
        raise
    # A folder cannot be opened elsewhere: the rename is then as durable as the system makes it.
    if os.name != "posix":
        return
    try:
        _flush(final.parent, os.O_RDONLY)
    except PermissionError:  # a folder that may be written to but not read: the same
        pass
    except OSError as error:
        raise unwritable(final, error) from error


def write_bytes(path: Path, data: bytes) -> None:
    """Write `data` to `path`, whole or not at all."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text with the line ends it has, whole or not at all.

    In a locale without UTF-8, names of files reach Python as escaped bytes: they are written as the bytes
    that they are.
    """
    write_bytes(path, text.encode(errors="surrogateescape"))


def write_json(path: Path, value: object) -> None:
    """Write strict JSON, keys in the order given, and a newline at the end.

    Raises NumericsError for NaN and infinities, which JSON does not have; TypeError for what is no JSON type.
    """
    try:
        text = json.dumps(value, indent=1, allow_nan=False, ensure_ascii=False)
    except ValueError as error:
        raise NumericsError(
            f"{path}: {error}; every figure must be finite, or null where there is none"
        ) from error
    write_text(path, text + "\n")
