"""Following a training: the page shows each new checkpoint of a run."""

import threading
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import FprfError
from ..training.driver import watch
from .session import Session, Viewed
from .uploads import newest_step, training_progress

if TYPE_CHECKING:
    from .server import ViewerServer

_POLL_SECONDS = 0.5
"""Seconds between looks at a run folder."""


class TrainingFollower:
    """Keeps the scene that a server shows at the newest checkpoint of a run.

    `load` opens the run, and `opened` is the session where it is open already; without, it is opened at the
    first checkpoint, and pages are told the text `waiting` until then, with the share of the training that is
    done.
    """

    def __init__(
        self,
        server: "ViewerServer",
        root: Path,
        load: Callable[[], Viewed],
        opened: Session | None = None,
        waiting: str = "",
    ) -> None:
        self._server = server
        self._root = root
        self._load = load
        self.session = opened
        self._waiting = waiting
        self._shown = -1 if opened is None else opened.viewed.step

    def run(self, ended: threading.Event) -> None:
        """Follow until the event is set."""
        while not ended.wait(_POLL_SECONDS):
            try:
                self.tick()
            except (FprfError, OSError) as error:  # the page says so; the next checkpoint may be better
                self._server.notify(str(error))

    def tick(self) -> None:
        """Say that somebody looks, and show what is new."""
        if self._server.pages:
            watch(self._root)
        newest = newest_step(self._root)
        progress = training_progress(self._root)
        if newest <= self._shown:
            if self.session is None and self._waiting and progress is not None:
                self._server.wait("opening", self._waiting, progress["share"])
            return
        self._shown = newest
        if self.session is None:
            self.session = self._server.open(self._load, warm=False)
        else:
            self.session.reload(self._load())
        if progress is not None:
            self.session.trained(progress)
