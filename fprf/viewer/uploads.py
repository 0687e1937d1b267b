"""Photographs from strangers: their header is checked before anything is decoded, and a process of its own decodes them.

What comes out is a plain PNG that we wrote ourselves, of bounded size, in a folder of ours under a name of ours. The decoding
process (`viewer.decode`) is started once and kept, since starting takes longer than decoding; it may use so much memory and
no more, and one that takes too long is ended and replaced.
"""

import contextlib
import json
import subprocess
import sys
import tempfile
import threading
from pathlib import Path
from queue import Empty, Queue

from ..datamanagers.images import MAX_PIXELS, header_of
from ..errors import DataError

__all__ = ["LARGEST", "Intake", "check_photograph", "shown_name"]

LARGEST = 20 << 20
"""Bytes of a photograph."""
SIDE = 1024
"""Longest side of what is kept of one: scenes' views are hardly larger."""
_SECONDS = 30.0
"""Time for one photograph, the start of the process included."""
_NAME = 48


def check_photograph(data: bytes) -> None:
    """Raise DataError for what is no photograph, or too large a one, by its first bytes."""
    if len(data) > LARGEST:
        raise DataError(f"photograph: {len(data)} bytes; at most {LARGEST} are taken: make it smaller")
    header = header_of(data)
    if header is None:
        raise DataError("photograph: no PNG, JPEG, WebP, BMP, TIFF, HEIC or AVIF; convert it to one of these")
    if header.width < 1 or header.height < 1 or header.width * header.height > MAX_PIXELS:
        raise DataError(f"photograph: {header.width}x{header.height} pixels; 1 to {MAX_PIXELS:.0e} are taken: make it smaller")


def shown_name(text: str) -> str:
    """A name as it is shown: the last part of what the browser called the file, without anything that is not plain."""
    last = text.replace("\\", "/").rsplit("/", 1)[-1]
    plain = "".join(c if c.isalnum() or c in " ._-()+" else "_" for c in last if c.isprintable()).strip(" .")
    if len(plain) > _NAME:
        plain = f"{plain[: _NAME - 12]}…{plain[-11:]}"
    return plain or "photograph"


class Intake:
    """Use as a context manager: the folder goes with it."""

    def __init__(self, seconds: float = _SECONDS) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="fprf-view-")
        self._seconds = seconds
        self._lock = threading.Lock()
        self._process: subprocess.Popen[str] | None = None
        self._answers: Queue[str] = Queue()
        self._count = 0

    def __enter__(self) -> "Intake":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def folder(self) -> Path:
        """Where photographs lie as long as the viewer runs."""
        return Path(self._folder.name)

    def warm(self) -> None:
        """Start the process that decodes, so that the first photograph need not wait for it."""
        with self._lock:
            self._started()

    def take(self, data: bytes) -> Path:
        """The photograph as a PNG of ours. Raises DataError for what cannot be used."""
        check_photograph(data)
        with self._lock:
            self._count += 1
            source, target = self.folder / f"{self._count:04d}.part", self.folder / f"{self._count:04d}.png"
            source.write_bytes(data)
            try:
                answer = self._ask({"source": str(source), "target": str(target), "side": SIDE})
            finally:
                source.unlink(missing_ok=True)
        if answer != "ok":
            raise DataError(f"photograph: {answer}")
        return target

    def close(self) -> None:
        """End the process, remove the folder."""
        with self._lock:
            self._end()
            self._folder.cleanup()

    def _ask(self, question: dict[str, object]) -> str:
        process = self._started()
        assert process.stdin is not None
        try:
            process.stdin.write(json.dumps(question) + "\n")
            process.stdin.flush()
            answer: dict[str, str] = json.loads(self._answers.get(timeout=self._seconds))
            return str(answer["said"])
        except Empty:
            self._end()
            return f"not decoded within {self._seconds:g} s; export it again"
        except (OSError, ValueError, KeyError):  # it died over this one
            self._end()
            return "cannot be decoded; export it again, or make it smaller"

    def _started(self) -> "subprocess.Popen[str]":
        if self._process is None or self._process.poll() is not None:
            self._end()
            self._answers = Queue()
            self._process = subprocess.Popen(
                [sys.executable, "-m", "fprf.viewer.decode"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                text=True,
            )
            threading.Thread(target=_read, args=(self._process, self._answers), daemon=True).start()
        return self._process

    def _end(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            for pipe in (self._process.stdin, self._process.stdout):
                assert pipe is not None
                with contextlib.suppress(OSError):  # what it never read
                    pipe.close()
            self._process = None


def _read(process: "subprocess.Popen[str]", answers: "Queue[str]") -> None:
    assert process.stdout is not None
    try:
        for line in process.stdout:
            answers.put(line)
    except ValueError:  # closed while it was read
        pass
    answers.put("")
