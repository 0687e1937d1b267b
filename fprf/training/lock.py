"""One trainer a run folder: a lock that the system drops when its holder ends, however it ends.

Only holding the file means something: one that a killed process left is taken over. Where the file system has no locks (some
network shares), there is none.
"""

import errno
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ..errors import DataError
from ..io.atomic import unwritable

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

__all__ = ["NAME", "held"]

NAME = ".lock"
_BUSY = (errno.EAGAIN, errno.EACCES)
_NOTE = 200
"""Bytes of the holder's note that are repeated to others."""


@contextmanager
def held(folder: Path) -> Iterator[None]:
    """Hold a folder for the length of the block; it is made if need be, and removed again if it stays empty.

    Raises DataError where another process holds it, naming that, and where nothing can be written: before any work is done.
    """
    handle = _open(folder)
    try:
        yield
    finally:
        with suppress(OSError):  # while it is held: who opened it before finds out in `_open`
            (folder / NAME).unlink()
        os.close(handle)
        with suppress(OSError):
            folder.rmdir()


def _open(folder: Path) -> int:
    while True:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            handle = os.open(folder / NAME, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        except FileExistsError as error:
            raise DataError(f"{folder}: is a file, not a folder; choose another --output") from error
        except OSError as error:
            raise unwritable(folder, error) from error
        try:
            _take(folder, handle)
            if os.fstat(handle).st_ino == os.stat(folder / NAME).st_ino:
                return handle
        except FileNotFoundError:  # removed by its holder, who ended in between
            pass
        except BaseException:
            os.close(handle)
            raise
        os.close(handle)


def _take(folder: Path, handle: int) -> None:
    if fcntl is None:
        return
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno not in _BUSY:
            return
        note = os.pread(handle, _NOTE, 0).decode(errors="replace").strip()
        who = note if note.isprintable() and note else "another process"
        raise DataError(f"{folder}: {who} is training here; wait for it, end it, or choose another --output") from error
    try:
        os.ftruncate(handle, 0)
        os.pwrite(handle, f"process {os.getpid()} on {socket.gethostname()}\n".encode(), 0)
    except OSError as error:
        raise unwritable(folder, error) from error
