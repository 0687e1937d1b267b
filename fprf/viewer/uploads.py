"""Photographs that clients upload: checked by their first bytes, then decoded by a process of its own.

The result is a PNG that we wrote ourselves, of bounded size, in a folder of ours under a name of ours. The decoder is started
once and kept, since starting it takes longer than decoding. Its memory is limited; one that takes too long is replaced.
"""

import json
import multiprocessing
import os
import signal
import tempfile
import threading
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path

from ..datamanagers.images import kind_of
from ..errors import DataError, FprfError

MAX_BYTES = 20 << 20
"""Bytes of a photograph."""
MAX_SIDE = 1024
"""Longest side of what is kept of one: scenes' views are hardly larger."""
_TIMEOUT = 30.0
"""Seconds for one photograph, the start of the decoder included."""
_MEMORY = 2 << 30
"""Bytes beyond what the decoder has at its start: 1e8 pixels take 0.3 GB, and some copies."""
_MAX_ANSWER = 4096
"""Bytes."""
_NAME = 48
"""Characters of a name that is shown."""


def check_photograph(data: bytes, name: str = "photograph") -> None:
    """Raise DataError for what is no photograph by its first bytes, or has too many. Its pixels are counted by the decoder."""
    if len(data) > MAX_BYTES:
        raise DataError(f"{name}: {len(data)} bytes; at most {MAX_BYTES} are taken: make it smaller")
    if not kind_of(data[:64]):
        raise DataError(f"{name}: no PNG, JPEG, WebP, BMP, TIFF, HEIC or AVIF; convert it to one of these")


def shown_name(text: str) -> str:
    """The last part of the file name that a browser gave, with plain characters alone, at most 48 of them."""
    last = text.replace("\\", "/").rsplit("/", 1)[-1]
    plain = "".join(c if c.isalnum() or c in " ._-()+" else "_" for c in last if c.isprintable()).strip(" .")
    if len(plain) > _NAME:
        plain = f"{plain[: _NAME - 12]}…{plain[-11:]}"
    return plain or "photograph"


class Uploads:
    """The folder of uploaded photographs and the decoder; both go with `close`."""

    def __init__(self, timeout: float = _TIMEOUT) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="fprf-view-")
        self.folder = Path(self._folder.name)
        self._timeout = timeout
        self._lock = threading.Lock()
        self._process: SpawnProcess | None = None
        self._pipe: Connection | None = None
        self._count = 0

    def start_decoder(self) -> None:
        """Start the decoder, so that the first photograph need not wait for it."""
        with self._lock:
            self._started()

    def store(self, data: bytes) -> Path:
        """Decode a photograph and write it as a PNG. Raises DataError for what cannot be decoded."""
        check_photograph(data)
        with self._lock:
            self._count += 1
            source, target = self.folder / f"{self._count:04d}.part", self.folder / f"{self._count:04d}.png"
            source.write_bytes(data)
            try:
                pipe = self._started()
                # Bytes and no pickles: whatever a photograph made of the decoder, its answer is text here.
                pipe.send_bytes(json.dumps([str(source), str(target)]).encode())
                if pipe.poll(self._timeout):
                    answer = pipe.recv_bytes(_MAX_ANSWER).decode(errors="replace")
                else:
                    answer = f"not decoded within {self._timeout:g} s; export it again"
                    self._end()
            except (OSError, EOFError):  # it died over this one
                answer = "cannot be decoded; export it again, or make it smaller"
                self._end()
            finally:
                source.unlink(missing_ok=True)
        if answer:
            raise DataError(f"photograph: {answer}")
        return target

    def close(self) -> None:
        """End the decoder and remove the folder."""
        with self._lock:
            self._end()
            self._folder.cleanup()

    def _started(self) -> Connection:
        """The pipe to the decoder, which is started where none runs."""
        if self._process is None or self._pipe is None or not self._process.is_alive():
            self._end()
            context = multiprocessing.get_context("spawn")  # a fork would carry this process's threads and models
            self._pipe, theirs = context.Pipe()
            self._process = context.Process(target=decode_photographs, args=(theirs,), daemon=True)
            self._process.start()
            theirs.close()
        return self._pipe

    def _end(self) -> None:
        if self._process is not None and self._pipe is not None:
            self._process.kill()
            self._process.join()
            self._process.close()
            self._pipe.close()
        self._process = self._pipe = None


def limit_memory(room: int) -> None:
    """Limit this process to `room` bytes of address space beyond what is mapped now, on systems that can."""
    try:
        import resource

        pages = int(Path("/proc/self/statm").read_text().split()[0])
        resource.setrlimit(resource.RLIMIT_AS, (pages * os.sysconf("SC_PAGE_SIZE") + room,) * 2)
    except (ImportError, OSError, ValueError):  # no such limit here: those on bytes and pixels remain
        return


def decode_photographs(pipe: Connection) -> None:
    """Answer each [source, target] by what is wrong with it, empty once the target is written, until the pipe is closed."""
    import cv2

    from ..datamanagers.images import load_image
    from ..io.images import shrink

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # an interrupt at the terminal is the viewer's, which ends this one
    limit_memory(_MEMORY)  # what is imported does not count
    while True:
        try:
            source, target = json.loads(pipe.recv_bytes())
        except EOFError:
            return
        try:
            small = shrink(load_image(Path(source), upright=True), MAX_SIDE)
            Path(target).write_bytes(cv2.imencode(".png", cv2.cvtColor(small, cv2.COLOR_RGB2BGR))[1].tobytes())
            said = ""
        except FprfError as fault:
            said = str(fault).removeprefix(f"{source}: ")  # the file's own name means nothing to the client
        except Exception as fault:  # whatever a decoder raises over a stranger's bytes
            said = f"cannot be decoded ({type(fault).__name__}); export it again, or make it smaller"
        pipe.send_bytes(said.encode(errors="replace")[:_MAX_ANSWER])
