"""`fprf train --view`: both ends of the pipes between training and the viewer, which is a process of its own.

`LiveViewer`, training's end, starts the process and only answers what it asks for. The process (`python -m fprf.viewer.live`)
says on its standard output, a JSON line each, whether somebody looks and when it wants the newest parameters. They are copied
between two steps and written to a file; a thread does the writing. While nobody looks nothing is copied and nothing sent.
Whatever becomes of the viewer, training goes on.

The viewer imports nothing heavy before somebody opens the page. New parameters are asked for when every client has its sharp
picture, or, where cameras never rest, after a while; so the picture on the page is always of one moment of training.
"""

import contextlib
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from queue import Empty, Full, Queue
from typing import TYPE_CHECKING, Any, NamedTuple, TextIO

from ..errors import FprfError, UsageError

if TYPE_CHECKING:
    from torch import Tensor

    from ..training.trainer import Report
    from ..training.unfinished import UnfinishedRun
    from .server import Access, ViewerServer
    from .session import Session
    from .state import TrainingProgress

_START_TIMEOUT = 60.0
"""Seconds within which the viewer must say where it listens."""
_LOG = "log"
_COPY_SHARE = 0.05
"""Share of the time that copying parameters may take."""
_MIN_PAUSE = 2.0
"""Seconds that a sharp picture stays at least."""
_MAX_PAUSE = 8.0
"""Seconds after which cameras that never rest get new parameters all the same."""
_LEAVING = 3.0
"""Seconds after which nobody who was not seen again is taken to look."""


class ViewAddress(NamedTuple):
    """Address to listen at."""

    host: str = "127.0.0.1"
    port: int = 8080
    strict: bool = False
    """True where another free port will not do."""


class LiveViewer:
    """The viewer's process; a context manager, which ends it. Called once every half a second of training at most.

    Raises UsageError where the viewer does not start.
    """

    def __init__(self, address: ViewAddress, command: tuple[str, ...] = (sys.executable, "-m", "fprf.viewer.live")) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="fprf-train-")
        self._lines: Queue[dict[str, Any] | None] = Queue(64)
        self._first: Queue[str] = Queue()
        self._looking = threading.Event()
        self._wanted = threading.Event()
        self._ended = threading.Event()
        self._parameters: Callable[[], Mapping[str, Tensor]] | None = None
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
        self._send(address._asdict())
        self._writer = threading.Thread(target=self._write, name="fprf-live-write", daemon=True)
        self._writer.start()
        threading.Thread(target=self._read, name="fprf-live-read", daemon=True).start()
        try:
            self.address = self._first_answer()
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> "LiveViewer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def looked_at(self) -> bool:
        """True while somebody looks."""
        return self._looking.is_set()

    @property
    def fault(self) -> str | None:
        """Why the viewer has ended before its time, in one line; None where it has not."""
        if not self._ended.is_set():
            return None
        lines = (Path(self._folder.name) / _LOG).read_text(errors="replace").split("\n")
        return next((line.strip()[:200] for line in reversed(lines) if line.strip()), "it said nothing")

    def begin(
        self,
        root: Path,
        parameters: "Callable[[], Mapping[str, Tensor]]",
        device: str,
        *,
        block: int | None = None,
        what: str = "",
    ) -> None:
        """Show this run, or a `block` of it, whose config.json and scene.json are written. The page calls it `what`.

        `parameters` gives those of the moment, for the config's `load_unfinished`.
        """
        self._parameters = parameters
        self._send({"run": str(root.resolve()), "device": device, "block": block, "what": what})

    def __call__(self, report: "Report") -> None:
        """Between two steps: send the progress, and copy the parameters where the viewer waits for them."""
        if self._ended.is_set() or not self._looking.is_set():
            return
        self._send({"report": [report.step, report.share, report.psnr, report.seconds]})
        now = time.perf_counter()
        if not self._wanted.is_set() or self._parameters is None or now < self._next:
            return
        self._wanted.clear()
        copy = {name: tensor.detach().to("cpu", copy=True) for name, tensor in self._parameters().items()}
        self._next = now + (time.perf_counter() - now) / _COPY_SHARE
        self._send({"snapshot": copy})

    def finish(self, *, stay: bool) -> bool:
        """Training has ended. With `stay`, return when nobody looks any more. Return whether somebody had looked."""
        looked = self.looked_at and not self._ended.is_set()
        self._parameters = None
        self._send({"done": True})
        while stay and looked and self.looked_at and not self._ended.wait(0.2):
            pass
        return looked

    def close(self) -> None:
        """End the viewer, by force if it does not react."""
        self._looking.clear()
        self._send(None)
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

    def _send(self, line: dict[str, Any] | None) -> None:
        """Queue a line without waiting: a viewer that does not read misses something."""
        try:
            self._lines.put_nowait(line)
        except Full:
            if line is None:
                self._process.kill()

    def _write(self) -> None:
        """Write the queued lines, on a thread: a viewer that does not read holds up nothing else."""
        assert self._process.stdin is not None
        try:
            while (line := self._lines.get()) is not None:
                if "snapshot" in line:
                    line = {"snapshot": str(self._store(line["snapshot"]))}
                self._process.stdin.write(json.dumps(line) + "\n")
                self._process.stdin.flush()
            self._process.stdin.close()
        except (OSError, ValueError):
            self._ended.set()

    def _store(self, tensors: dict[str, Any]) -> Path:
        from safetensors.torch import save_file

        path = Path(self._folder.name) / "newest.safetensors"
        save_file({name: tensor.contiguous() for name, tensor in tensors.items()}, path.with_suffix(".part"))
        os.replace(path.with_suffix(".part"), path)
        return path

    def _first_answer(self) -> str:
        """The viewer's address, as soon as it has said it. Raises UsageError with what it says instead."""
        try:
            said = json.loads(self._first.get(timeout=_START_TIMEOUT))
            if "address" in said:
                return str(said["address"])
            why = str(said["error"])
        except (Empty, ValueError, KeyError, TypeError):
            why = "the viewer did not start; try `fprf view` on a run, or train without --view"
        raise UsageError(f"--view: {why}")

    def _read(self) -> None:
        """Read what the viewer says, on a thread."""
        assert self._process.stdout is not None
        with contextlib.suppress(OSError, ValueError, AttributeError):
            self._first.put(self._process.stdout.readline())
            for line in self._process.stdout:
                said = json.loads(line)
                if said.get("looking") is not None:
                    (self._looking.set if said["looking"] else self._looking.clear)()
                if said.get("want"):
                    self._wanted.set()
        self._looking.clear()
        self._ended.set()


class _TrainingRun(NamedTuple):
    root: Path
    device: str
    block: int | None
    what: str


class TrainingFollower:
    """The viewer's end: keeps a session up to date with a training run. `tell` sends a line to training."""

    def __init__(self, server: "ViewerServer", tell: Callable[[dict[str, Any]], None]) -> None:
        self._server, self._tell = server, tell
        self._run: _TrainingRun | None = None
        self._shown: _TrainingRun | None = None
        self._session: Session | None = None
        self._unfinished: UnfinishedRun | None = None
        self._looking = self._wanted = self._ended = False
        self._last_seen = self._last_new = 0.0

    @property
    def over(self) -> bool:
        """True when training has ended and nobody looks."""
        return self._ended and not self._looking

    def receive(self, said: dict[str, Any]) -> None:
        """Handle a line from training."""
        from .state import TrainingProgress

        if "run" in said:
            self._run = _TrainingRun(Path(said["run"]), str(said["device"]), said.get("block"), str(said.get("what", "")))
            self._wanted = False  # what was asked for was of another model
        elif "snapshot" in said and self._run is not None:
            self._load(Path(said["snapshot"]))
        elif "report" in said and self._session is not None:
            step, share, psnr, seconds = said["report"]
            left = seconds * (1 - share) / max(share, 1e-3)
            what = "" if self._run is None else self._run.what
            self._set_progress(TrainingProgress(int(step), float(share), float(psnr), float(left), what))
        elif "done" in said:
            self._ended = True
            self._load_finished()

    def tick(self, now: float) -> None:
        """Every fraction of a second: tell training who looks, and ask for parameters where clients wait for them."""
        session = self._session
        if self._server.visited.is_set() or (session is not None and session.has_clients):
            self._server.visited.clear()
            self._last_seen = now
        looking = self._last_seen > 0 and now - self._last_seen < _LEAVING
        if looking != self._looking:
            self._looking = looking
            self._tell({"looking": looking})
            self._wanted = False
        if not looking or self._wanted or self._ended or self._run is None:
            return
        since = now - self._last_new
        if since < _MIN_PAUSE or (
            session is not None and (session.state.film.busy or (since < _MAX_PAUSE and not session.idle))
        ):
            return
        self._wanted = True
        self._tell({"want": True})

    def _load(self, path: Path) -> None:
        """Take new parameters; the first ones open the page."""
        from safetensors.torch import load_file

        from ..training.run import Run
        from .session import Viewed, view_of_run
        from .state import TrainingProgress

        tensors = load_file(path)
        self._wanted, self._last_new = False, time.monotonic()
        run, session = self._run, self._session
        assert run is not None
        if self._unfinished is None or run != self._shown:
            self._unfinished = Run(run.root).load_config()[0].load_unfinished(run.root, run.device, run.block)
        unfinished, self._shown = self._unfinished, run

        def load() -> Viewed:
            return view_of_run(unfinished.scene(tensors), unfinished.run, unfinished.known)

        if session is None:
            self._session = self._server.open(load, (), 640, unfinished.encoders)
            self._set_progress(TrainingProgress(what=run.what))
        else:
            session.reload(load, unfinished.encoders)

    def _load_finished(self) -> None:
        """Show the run as it was saved, with the style that training measured."""
        if self._session is None or self._run is None:
            return
        from ..training.loading import open_run
        from .session import view_of_run
        from .state import TrainingProgress

        last = open_run(self._run.root, self._run.device)
        self._session.reload(lambda: view_of_run(last.scene, last.run, last.known), lambda before: last.scene.encoders())
        self._set_progress(TrainingProgress(last.step, 1.0))

    def _set_progress(self, training: "TrainingProgress") -> None:
        if self._session is not None:
            self._session.update(lambda state: replace(state, training=training))


def main(questions: TextIO, answers: TextIO) -> None:
    """Run the viewer until training ends, or its end of the pipe does."""
    from .server import make_access

    def tell(line: dict[str, Any]) -> None:
        answers.write(json.dumps(line) + "\n")
        answers.flush()

    said = json.loads(questions.readline())
    try:
        server = _open_server(make_access(said["host"], None), int(said["port"]), bool(said["strict"]))
    except FprfError as error:
        tell({"error": str(error)})
        return
    lines: Queue[dict[str, Any] | None] = Queue()
    with server:
        tell({"address": server.address})
        threading.Thread(target=_read_lines, args=(questions, lines), daemon=True).start()
        follower = TrainingFollower(server, tell)
        while not follower.over:
            try:
                line = lines.get(timeout=0.1)
                if line is None:
                    return
                follower.receive(line)
            except Empty:
                pass
            except FprfError as error:  # the page says so; the next parameters may be better
                server.notify(str(error))
            follower.tick(time.monotonic())


def _open_server(access: "Access", port: int, strict: bool) -> "ViewerServer":
    from .server import ViewerServer

    try:
        return ViewerServer(access, port, preload=False)
    except FprfError:
        if strict:
            raise
        return ViewerServer(access, 0, preload=False)


def _read_lines(questions: TextIO, lines: "Queue[dict[str, Any] | None]") -> None:
    with contextlib.suppress(ValueError):
        for line in questions:
            lines.put(json.loads(line))
    lines.put(None)


if __name__ == "__main__":
    with contextlib.suppress(BrokenPipeError, KeyboardInterrupt):
        main(sys.stdin, sys.stdout)
