"""Training's side of `fprf train --view`: the viewer is a process of its own, and training only answers what it asks for.

The viewer says on its standard output, a JSON line each, whether somebody looks and when it wants the newest parameters. They
are copied between two steps and written to a file in a folder of ours; a thread does the writing. While nobody looks nothing
is copied and nothing sent. Whatever becomes of the viewer, training goes on.
"""

import contextlib
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from queue import Empty, Full, Queue
from typing import TYPE_CHECKING, Any, NamedTuple

from ..errors import UsageError

if TYPE_CHECKING:
    from ..training.model import Model
    from ..training.trainer import Report

__all__ = ["Aside", "Place"]

_STARTING = 60.0
"""Seconds within which the viewer must say where it listens."""
_LOG = "log"
_SHARE = 0.05
"""Share of the time that copying parameters may take."""


class Place(NamedTuple):
    """Where to listen."""

    host: str = "127.0.0.1"
    port: int = 8080
    strict: bool = False
    """Whether another free port will not do."""


class Aside:
    """Use as a context manager, which ends the viewer. Called once every half a second of training at most."""

    def __init__(self, place: Place, command: tuple[str, ...] = (sys.executable, "-m", "fprf.viewer.live")) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="fprf-train-")
        self._lines: Queue[dict[str, Any] | None] = Queue(64)
        self._looking = threading.Event()
        self._wanted = threading.Event()
        self._ended = threading.Event()
        self._model: Model | None = None
        self._next = 0.0
        with (Path(self._folder.name) / _LOG).open("w") as log:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
                start_new_session=True,  # an interrupt at the terminal is training's
            )
        self._put({"host": place.host, "port": place.port, "strict": place.strict})
        self._writer = threading.Thread(target=self._write, name="fprf-aside", daemon=True)
        self._writer.start()
        try:
            self.address = self._listening(place)
        except BaseException:
            self.close()
            raise
        threading.Thread(target=self._read, name="fprf-aside-ear", daemon=True).start()

    def __enter__(self) -> "Aside":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def looked_at(self) -> bool:
        """Whether somebody looks."""
        return self._looking.is_set()

    @property
    def fault(self) -> str | None:
        """Why the viewer has ended before its time, in one line; None where it has not."""
        if not self._ended.is_set():
            return None
        lines = (Path(self._folder.name) / _LOG).read_text(errors="replace").split("\n")
        return next((line.strip()[:200] for line in reversed(lines) if line.strip()), "it said nothing")

    def begin(self, root: Path, model: "Model", device: str, *, block: int | None = None, what: str = "") -> None:
        """This run is being trained, or a `block` of it; its config.json and scene.json are written, and this is the model.

        `what` is how the page calls it.
        """
        self._model = model
        self._put({"run": str(root.resolve()), "device": device, "block": block, "what": what})

    def __call__(self, report: "Report") -> None:
        """Between two steps: say how it goes, and copy the parameters where the viewer waits for them."""
        if self._ended.is_set() or not self._looking.is_set():
            return
        self._put({"report": [report.step, report.share, report.psnr, report.seconds]})
        now = time.perf_counter()
        if not self._wanted.is_set() or self._model is None or now < self._next:
            return
        self._wanted.clear()
        copy = {name: tensor.detach().to("cpu", copy=True) for name, tensor in self._model.state_dict().items()}
        self._next = now + (time.perf_counter() - now) / _SHARE
        self._put({"snapshot": copy})

    def finish(self, *, stay: bool) -> bool:
        """Training is over. With `stay`, return when nobody looks any more; whether somebody had looked."""
        looked = self.looked_at and not self._ended.is_set()
        self._model = None
        self._put({"done": True})
        while stay and looked and self.looked_at and not self._ended.wait(0.2):
            pass
        return looked

    def close(self) -> None:
        """End the viewer, at once if it does not heed."""
        self._looking.clear()
        self._put(None)
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(3)
        if self._process.poll() is None:
            self._process.kill()
            self._process.wait()
        self._ended.set()
        self._writer.join(5)
        for pipe in (self._process.stdin, self._process.stdout):
            with contextlib.suppress(OSError, ValueError):
                if pipe is not None:
                    pipe.close()
        self._folder.cleanup()

    def _put(self, line: dict[str, Any] | None) -> None:
        """Never waits: a viewer that does not listen misses something."""
        try:
            self._lines.put_nowait(line)
        except Full:
            if line is None:
                self._process.kill()

    def _write(self) -> None:
        """On a thread: lines for the viewer, in order. A viewer that does not read holds this thread up, and nothing else."""
        assert self._process.stdin is not None
        try:
            while (line := self._lines.get()) is not None:
                if "snapshot" in line:
                    line = {"snapshot": str(self._stored(line["snapshot"]))}
                self._process.stdin.write(json.dumps(line) + "\n")
                self._process.stdin.flush()
            self._process.stdin.close()
        except (OSError, ValueError):
            self._ended.set()

    def _stored(self, tensors: dict[str, Any]) -> Path:
        from safetensors.torch import save_file

        path = Path(self._folder.name) / "newest.safetensors"
        save_file({name: tensor.contiguous() for name, tensor in tensors.items()}, path.with_suffix(".part"))
        os.replace(path.with_suffix(".part"), path)
        return path

    def _listening(self, place: Place) -> str:
        """The address, as soon as the viewer has said it. Raises UsageError with what it says instead."""
        first: Queue[str] = Queue()
        stdout = self._process.stdout
        assert stdout is not None
        threading.Thread(target=lambda: first.put(stdout.readline()), daemon=True).start()
        try:
            said = json.loads(first.get(timeout=_STARTING))
            if "address" in said:
                return str(said["address"])
            why = str(said["error"])
        except (Empty, ValueError, KeyError, TypeError):
            why = "the viewer did not start; try `fprf view` on a run, or train without --view"
        raise UsageError(f"--view: {why}")

    def _read(self) -> None:
        """On a thread: what the viewer says."""
        assert self._process.stdout is not None
        try:
            for line in self._process.stdout:
                said = json.loads(line)
                if said.get("looking") is not None:
                    (self._looking.set if said["looking"] else self._looking.clear)()
                if said.get("want"):
                    self._wanted.set()
        except (OSError, ValueError, AttributeError):
            pass
        self._looking.clear()
        self._ended.set()
