"""Folders that one process at a time writes to: the kernel holds the lock, and releases it when the process ends."""

import errno
import os
import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from ..errors import DataError
from .atomic import unwritable

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

LOCK = ".lock"
"""File by which a folder is held."""
_MAX_NOTE_BYTES = 200
"""Bytes of the holder's note that are repeated to others: a number and a host's name of at most 64."""


@contextmanager
def lock_folder(folder: Path, doing: str = "is training here") -> Iterator[None]:
    """Hold a folder for the length of the block; it is made if need be, and removed again if it stays empty.
    `doing` tells others what its holder does.

    Raises DataError where another process holds it, naming that, and where nothing can be written: before any
    work is done.
    """
    # The holder before may remove the file between opening and locking it: then a new one is opened.
    while (handle := _locked(folder, doing)) is None:
        pass
    try:
        yield
    finally:
        with suppress(OSError):  # while it is held: who opened it before finds out in `_locked`
            (folder / LOCK).unlink()
        os.close(handle)
        with suppress(OSError):
            folder.rmdir()


def _locked(folder: Path, doing: str) -> int | None:
    """Take the lock of a folder; None where its holder removed the file in between."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with ExitStack() as opened:
            handle = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT, 0o666)
            opened.callback(os.close, handle)
            # The kernel releases the lock of a process that dies; file systems without locks hold nothing.
            if fcntl is not None:
                try:
                    fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except OSError as error:
                    if error.errno in (errno.EAGAIN, errno.EACCES):
                        note = os.pread(handle, _MAX_NOTE_BYTES, 0).decode(errors="replace").strip()
                        if note.isprintable() and note:
                            who = note
                        else:
                            who = "another process"
                        line = f"{folder}: {who} {doing}; wait for it, end it, or choose another --output"
                        raise DataError(line) from error
                else:
                    os.ftruncate(handle, 0)
                    os.pwrite(handle, f"process {os.getpid()} on {socket.gethostname()}\n".encode(), 0)
            # Somebody may hold a file of this name that is not this one any more.
            with suppress(FileNotFoundError):
                if os.fstat(handle).st_ino == os.stat(folder / LOCK).st_ino:
                    opened.pop_all()  # it stays open
                    return handle
    except FileExistsError as error:
        raise DataError(f"{folder}: is a file, not a folder; choose another --output") from error
    except OSError as error:
        raise unwritable(folder, error) from error
    return None


def is_locked(folder: Path) -> bool:
    """True while a process holds a folder."""
    if fcntl is None or not (folder / LOCK).is_file():
        return False
    try:
        with (folder / LOCK).open() as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError as error:
        return error.errno in (errno.EAGAIN, errno.EACCES)
    return False
