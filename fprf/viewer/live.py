"""Follow a training in the viewer. The run folder is the only channel: its newest checkpoint is shown, and as long as somebody
looks the folder says so (`training.driver.watch`), for which training saves more often.
"""

import json
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import FprfError

if TYPE_CHECKING:
    from .server import ViewerServer
    from .session import Session, Viewed
    from .state import TrainingProgress

_POLL = 0.5
"""Seconds between looks at the folder."""
_MIN_PAUSE = 2.0
"""Seconds that a sharp picture stays at least."""
_MAX_PAUSE = 8.0
"""Seconds after which cameras that never rest get new parameters all the same."""
_TAIL = 4096
"""Bytes of the end of events.jsonl that hold its last line."""


class TrainingFollower:
    """Keeps the scene that a server shows at the newest checkpoint of a run. A context manager, which ends its thread.

    `load` opens the run, and `opened` is the session where it is open already; without, it is opened at the first checkpoint.
    """

    def __init__(
        self,
        server: "ViewerServer",
        root: Path,
        load: "Callable[[], Viewed]",
        opened: "Session | None" = None,
        pixels: int = 640,
    ) -> None:
        self._server, self._root, self._load, self._session, self._pixels = server, root, load, opened, pixels
        self._shown = self._newest() if opened is not None else ""
        self._last_new = time.monotonic()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._follow, name="fprf-follow", daemon=True)

    def __enter__(self) -> "TrainingFollower":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join(5)

    def _follow(self) -> None:
        while not self._over.wait(_POLL):
            try:
                self.tick(time.monotonic())
            except FprfError as error:  # the page says so; the next checkpoint may be better
                self._server.notify(str(error))

    def tick(self, now: float) -> None:
        """Say that somebody looks, and show what is new where no client waits for a picture."""
        session = self._session
        if self._server.visited.is_set() or (session is not None and session.has_clients):
            from ..training.driver import watch

            self._server.visited.clear()
            watch(self._root)
        newest, since = self._newest(), now - self._last_new
        if not newest or newest == self._shown:
            return
        if session is not None and (since < _MIN_PAUSE or session.state.film.busy or (since < _MAX_PAUSE and not session.idle)):
            return
        if session is None:
            self._session = session = self._server.open(self._load, (), self._pixels)
        else:
            session.reload(self._load, lambda before: self._load().scene.encoders())
        self._shown, self._last_new = newest, now
        progress = self._progress()
        session.update(lambda state: replace(state, training=progress))

    def _newest(self) -> str:
        """The newest complete checkpoint; empty where there is none."""
        return max((manifest.parent.name for manifest in self._root.glob("checkpoints/step-*/manifest.json")), default="")

    def _progress(self) -> "TrainingProgress | None":
        """How far the run is, by the last line of its events.jsonl; None where it does not say."""
        from ..training.driver import schedule_of
        from ..training.run import Run
        from .state import TrainingProgress

        run = Run(self._root)
        try:
            with (self._root / "events.jsonl").open("rb") as file:
                file.seek(max(0, file.seek(0, 2) - _TAIL))
                lines = [json.loads(line) for line in file.read().decode(errors="replace").splitlines()[1:]]
            last = next(line for line in reversed(lines) if "psnr" in line)
            share = schedule_of(run.load_config()[0], len(run.load_known().train)).share(last["step"], last["seconds"])
            left = last["seconds"] * (1 - share) / max(share, 1e-3)
            return TrainingProgress(int(last["step"]), share, float(last["psnr"]), left)
        except (OSError, ValueError, KeyError, StopIteration):
            return None
