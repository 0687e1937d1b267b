"""Photographs that clients upload: checked by their first bytes, then decoded by a process of its own.

The result is a PNG that we wrote ourselves, of bounded size, in a folder of ours under a name of ours. The decoder
(`python -m fprf.viewer.uploads`) is started once and kept, since starting it takes longer than decoding. Its memory is limited;
one that takes too long is ended and replaced.
"""

import contextlib
import json
import os
import subprocess
import sys
import tempfile
import threading
from pathlib import Path
from queue import Empty, Queue
from typing import TextIO

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
        self._timeout = timeout
        self._lock = threading.Lock()
        self._process: subprocess.Popen[str] | None = None
        self._answers: Queue[str] = Queue()
        self._count = 0

    @property
    def folder(self) -> Path:
        """Folder of the photographs as long as the viewer runs."""
        return Path(self._folder.name)

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
                answer = self._ask({"source": str(source), "target": str(target), "side": MAX_SIDE})
            finally:
                source.unlink(missing_ok=True)
        if answer != "ok":
            raise DataError(f"photograph: {answer}")
        return target

    def close(self) -> None:
        """End the decoder and remove the folder."""
        with self._lock:
            self._end()
            self._folder.cleanup()

    def _ask(self, question: dict[str, object]) -> str:
        process = self._started()
        assert process.stdin is not None
        try:
            process.stdin.write(json.dumps(question) + "\n")
            process.stdin.flush()
            answer: dict[str, str] = json.loads(self._answers.get(timeout=self._timeout))
            return str(answer["said"])
        except Empty:
            self._end()
            return f"not decoded within {self._timeout:g} s; export it again"
        except (OSError, ValueError, KeyError):  # it died over this one
            self._end()
            return "cannot be decoded; export it again, or make it smaller"

    def _started(self) -> "subprocess.Popen[str]":
        if self._process is None or self._process.poll() is not None:
            self._end()
            self._answers = Queue()
            self._process = subprocess.Popen(
                [sys.executable, "-m", "fprf.viewer.uploads"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                text=True,
            )
            threading.Thread(target=_read_answers, args=(self._process, self._answers), daemon=True).start()
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


def _read_answers(process: "subprocess.Popen[str]", answers: "Queue[str]") -> None:
    assert process.stdout is not None
    with contextlib.suppress(ValueError):  # closed while it was read
        for line in process.stdout:
            answers.put(line)
    answers.put("")


def limit_memory(room: int) -> None:
    """Limit this process to `room` bytes of address space beyond what is mapped now, on systems that can."""
    try:
        import resource

        pages = int(Path("/proc/self/statm").read_text().split()[0])
        resource.setrlimit(resource.RLIMIT_AS, (pages * os.sysconf("SC_PAGE_SIZE") + room,) * 2)
    except (ImportError, OSError, ValueError):  # no such limit here: those on bytes and pixels remain
        return


def serve_decoder(questions: TextIO, answers: TextIO) -> None:
    """Answer lines {"source", "target", "side"} by {"said": "ok" or what is wrong} until the input ends."""
    for line in questions:
        try:
            asked = json.loads(line)
            _decode(Path(asked["source"]), Path(asked["target"]), int(asked["side"]))
            said = "ok"
        except FprfError as fault:
            # The file's own name means nothing to the client.
            said = str(fault).removeprefix(f"{asked['source']}: ")
        except Exception as fault:  # whatever a decoder raises over a stranger's bytes
            said = f"cannot be decoded ({type(fault).__name__}); export it again, or make it smaller"
        answers.write(json.dumps({"said": said}) + "\n")
        answers.flush()


def _decode(source: Path, target: Path, side: int) -> None:
    """Write a photograph as a PNG with sides of at most `side` pixels."""
    import cv2

    from ..datamanagers.images import load_image
    from ..io.images import shrink

    small = shrink(load_image(source, upright=True), side)
    target.write_bytes(cv2.imencode(".png", cv2.cvtColor(small, cv2.COLOR_RGB2BGR))[1].tobytes())


if __name__ == "__main__":
    from ..datamanagers import images  # noqa: F401  what it maps does not count against the limit

    limit_memory(_MEMORY)
    serve_decoder(sys.stdin, sys.stdout)
