"""The viewer's side of `fprf train --view`, as a process: `Aside` starts it, tells it of the run, and hands over parameters.

Nothing heavy is imported before somebody opens the page. New parameters are asked for when every client has its sharp picture,
or, where cameras never rest, after a while; so the picture on the page is always of one moment of training.
"""

import json
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from queue import Empty, Queue
from typing import TYPE_CHECKING, Any, NamedTuple, TextIO

from ..errors import FprfError
from .access import make_access
from .host import Host
from .training import Training

if TYPE_CHECKING:
    from .session import Session

__all__ = ["Follower", "main"]

_REST = 2.0
"""Seconds that a sharp picture stays at least."""
_RESTLESS = 8.0
"""Seconds after which cameras that never rest get new parameters all the same."""
_LEAVING = 3.0
"""Seconds after which somebody who has gone is taken to have gone."""


class _Run(NamedTuple):
    """What is being trained."""

    root: Path
    device: str
    block: int | None
    what: str


class Follower:
    """Keeps a session up to date with a training run. `tell` sends a line to training."""

    def __init__(self, host: Host, tell: Callable[[dict[str, Any]], None]) -> None:
        self._host, self._tell = host, tell
        self._run: _Run | None = None
        self._shown: _Run | None = None
        self._session: Session | None = None
        self._looking = self._wanted = self._over = False
        self._last_seen = self._last_new = 0.0

    @property
    def over(self) -> bool:
        """Training is over, and nobody looks."""
        return self._over and not self._looking

    def hear(self, said: dict[str, Any]) -> None:
        """A line from training."""
        if "run" in said:
            self._run = _Run(Path(said["run"]), str(said["device"]), said.get("block"), str(said.get("what", "")))
            self._wanted = False  # what was asked for was of another model
        elif "snapshot" in said and self._run is not None:
            self._take(Path(said["snapshot"]))
        elif "report" in said and self._session is not None:
            step, share, psnr, seconds = said["report"]
            left = seconds * (1 - share) / max(share, 1e-3)
            what = "" if self._run is None else self._run.what
            self._say_how(Training(int(step), float(share), float(psnr), float(left), what))
        elif "done" in said:
            self._over = True
            self._finish()

    def tick(self, now: float) -> None:
        """Every fraction of a second: who looks, and whether they wait for something new."""
        session = self._session
        if self._host.visited.is_set() or (session is not None and session.watched):
            self._host.visited.clear()
            self._last_seen = now
        looking = self._last_seen > 0 and now - self._last_seen < _LEAVING
        if looking != self._looking:
            self._looking = looking
            self._tell({"looking": looking})
            self._wanted = False
        if not looking or self._wanted or self._over or self._run is None:
            return
        since = now - self._last_new
        if since < _REST or (session is not None and (session.state.film.busy or (since < _RESTLESS and not session.idle))):
            return
        self._wanted = True
        self._tell({"want": True})

    def _take(self, path: Path) -> None:
        """New parameters: the first ones open the page."""
        from safetensors.torch import load_file

        from .moment import begun, encoders_now, filled

        tensors = load_file(path)
        self._wanted, self._last_new = False, time.monotonic()
        run, session = self._run, self._session
        assert run is not None
        if session is None:
            trained = filled(begun(run.root, run.device, run.block), tensors)
            self._session = self._host.open(lambda: trained, (), 640, encoders_now)
            self._say_how(Training(what=run.what))
        elif run == self._shown:
            session.renew(lambda: filled(session.trained, tensors))
        else:
            session.renew(lambda: filled(begun(run.root, run.device, run.block), tensors))
        self._shown = run

    def _finish(self) -> None:
        """The last parameters and the scene's own style are in the run folder now."""
        if self._session is None or self._run is None:
            return
        from ..training.loading import load_run

        last = load_run(self._run.root, self._run.device)
        self._session.renew(lambda: last, lambda trained, before: trained.encoders())
        self._say_how(Training(last.step, 1.0))

    def _say_how(self, training: Training) -> None:
        if self._session is not None:
            self._session.change(lambda state: replace(state, training=training))


def main(questions: TextIO, answers: TextIO) -> None:
    """Until training ends, or its end of the pipe does."""

    def tell(line: dict[str, Any]) -> None:
        answers.write(json.dumps(line) + "\n")
        answers.flush()

    said = json.loads(questions.readline())
    try:
        access = make_access(said["host"], None)
        host = _host(access, int(said["port"]), bool(said["strict"]))
    except FprfError as error:
        tell({"error": str(error)})
        return
    lines: Queue[dict[str, Any] | None] = Queue()
    with host:
        tell({"address": host.address})
        threading.Thread(target=_hear, args=(questions, lines), daemon=True).start()
        follower = Follower(host, tell)
        while not follower.over:
            try:
                line = lines.get(timeout=0.1)
                if line is None:
                    return
                follower.hear(line)
            except Empty:
                pass
            except FprfError as error:  # the page says so; the next parameters may be better
                host.say(str(error))
            follower.tick(time.monotonic())


def _host(access: Any, port: int, strict: bool) -> Host:
    try:
        return Host(access, port, eager=False)
    except FprfError:
        if strict:
            raise
        return Host(access, 0, eager=False)


def _hear(questions: TextIO, lines: "Queue[dict[str, Any] | None]") -> None:
    try:
        for line in questions:
            lines.put(json.loads(line))
    except ValueError:
        pass
    lines.put(None)


if __name__ == "__main__":
    import contextlib

    with contextlib.suppress(BrokenPipeError, KeyboardInterrupt):
        main(sys.stdin, sys.stdout)
