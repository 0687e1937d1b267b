"""Follow a training in the viewer. The run folder is the only channel: its newest checkpoint is shown, and as long as somebody
looks the folder says so (`training.driver.watch`), for which training saves more often.
"""

import json
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import FprfError
from ..training.driver import schedule_of, watch
from ..training.run import Run
from .uploads import newest_step

if TYPE_CHECKING:
    from .server import ViewerServer
    from .session import Session, Viewed

_POLL = 0.5
"""Seconds between looks at the folder."""
_TAIL = 4096
"""Bytes of the end of events.jsonl that hold its last line."""


class TrainingFollower:
    """Keeps the scene that a server shows at the newest checkpoint of a run.

    `load` opens the run, and `opened` is the session where it is open already; without, it is opened at the first checkpoint,
    with `references` on the shelf.
    """

    def __init__(
        self,
        server: "ViewerServer",
        root: Path,
        load: "Callable[[], Viewed]",
        opened: "Session | None" = None,
        references: Sequence[Path] = (),
        pixels: int = 640,
    ) -> None:
        self._server, self._root, self._load, self.session = server, root, load, opened
        self._references, self._pixels = references, pixels
        self._shown = -1 if opened is None else opened.viewed.step

    def run(self, ended: threading.Event) -> None:
        """Follow until the event is set."""
        while not ended.wait(_POLL):
            try:
                self.tick()
            except (FprfError, OSError) as error:  # the page says so; the next checkpoint may be better
                self._server.notify(str(error))

    def tick(self) -> None:
        """Say that somebody looks, and show what is new."""
        if self._server.pages:
            watch(self._root)
        newest = newest_step(self._root)
        if newest <= self._shown:
            return
        self._shown = newest
        if self.session is None:
            self.session = self._server.open(self._load, self._references, self._pixels, warm=False)
        else:
            self.session.reload(self._load())
        if (progress := training_progress(self._root)) is not None:
            self.session.trained(progress)


def training_progress(root: Path) -> dict[str, Any] | None:
    """How far a run is, by the last line of its events.jsonl: step, share, psnr, seconds left; None where it does not say."""
    run = Run(root)
    try:
        with (root / "events.jsonl").open("rb") as file:
            file.seek(max(0, file.seek(0, 2) - _TAIL))
            # The first line of the tail may be cut off; events without a step tell nothing of progress.
            lines = [json.loads(line) for line in file.read().decode(errors="replace").splitlines()[1:]]
        last = next(line for line in reversed(lines) if "psnr" in line)
        share = schedule_of(run.load_config()[0], len(run.load_known().train)).share(last["step"], last["seconds"])
        # As long again for each share that is left, at the speed so far.
        left = last["seconds"] * (1 - share) / max(share, 1e-3)
        return {"step": int(last["step"]), "share": share, "psnr": float(last["psnr"]), "seconds_left": round(left)}
    except (OSError, ValueError, KeyError, StopIteration):
        return None
