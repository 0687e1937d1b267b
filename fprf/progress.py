"""Progress of a long command: a live line on a terminal and in a notebook, one JSON line every few seconds
elsewhere.
"""

import html
import json
import sys
import time
from collections.abc import Callable
from types import TracebackType
from typing import Any, NamedTuple, Self

from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TaskID, TextColumn, TimeElapsedColumn

LINE_SECONDS = 5.0
"""Time between JSON lines where standard error is no terminal, and in events.jsonl."""

CELL_SECONDS = 0.25
"""Time between two drawings of a bar in a notebook; by eye."""


class Report(NamedTuple):
    """Progress of training."""

    step: int
    share: float
    """Share of the way, 0 to 1."""
    seconds: float
    """Training time, that of earlier starts included."""
    psnr: float
    """PSNR of the training rays in dB, smoothed."""
    rays_per_second: float
    kept: float
    """Share of the samples that met the content network."""
    losses: dict[str, float]
    skipped: int
    """Steps skipped because their loss or a gradient was not finite."""


class Progressed(NamedTuple):
    """Progress of a long piece of work, as listeners are told."""

    what: str
    """The step that is being taken, such as "training"."""
    share: float
    """Share of that step, 0 to 1."""
    detail: str
    """Counts, quality and the time left, as a terminal shows them."""


Listener = Callable[[Progressed], object]
"""Called with each change, by the thread that works. It may raise `errors.Stopped`."""


class Display:
    """A context manager; `quiet` shows nothing, `listener` is told all the same."""

    def __init__(self, *, quiet: bool = False, listener: Listener | None = None) -> None:
        self.console = Console(stderr=True, highlight=False)
        self.quiet = quiet
        self.listener = listener
        self.live = self.console.is_terminal and not quiet
        self.cell = None
        if self.console.is_jupyter and not quiet:
            self.cell = _Cell()
        self.progress = Progress(
            SpinnerColumn(),
            TextColumn("{task.description}"),
            BarColumn(bar_width=None),
            TextColumn("{task.percentage:>3.0f} %"),
            TextColumn("{task.fields[detail]}", style="cyan"),
            TimeElapsedColumn(),
            console=self.console,
            disable=not self.live,
        )
        self.task: TaskID | None = None
        self.what = ""
        self.last = 0.0

    def __enter__(self) -> Self:
        self.progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.progress.stop()

    def say(self, text: str) -> None:
        """One line that stays."""
        if self.live:
            self.progress.console.print(text, markup=False)
        elif self.cell is not None:
            print(text, file=sys.stderr)
        elif not self.quiet:
            self._line({"event": text})

    def count(self, done: int, total: int, what: str, *, seconds_left: float | None = None) -> None:
        """`done` of `total` of something."""
        if seconds_left is None:
            left = ""
        else:
            left = f"  {_clock(seconds_left)} left"
        self._bar(what, done / max(1, total), f"{done}/{total}{left}")
        if not self.live and self._due(done == total):
            if seconds_left is None:
                ahead = {}
            else:
                ahead = {"seconds_left": round(seconds_left)}
            self._line({"event": what, "done": done, "total": total, **ahead})

    def training(self, report: Report, what: str = "training") -> None:
        """Progress of training."""
        left = report.seconds * (1 - report.share) / max(report.share, 1e-3)
        detail = f"step {report.step}  {report.psnr:.2f} dB  {report.rays_per_second:,.0f} rays/s  {_clock(left)} left"
        self._bar(what, report.share, detail)
        if not self.live and self._due(report.share >= 1):
            self._line(
                {
                    "event": what,
                    "step": report.step,
                    "share": round(report.share, 4),
                    "seconds": round(report.seconds, 1),
                    "psnr": round(report.psnr, 2),
                    "rays_per_second": round(report.rays_per_second),
                    "seconds_left": round(left),
                }
            )

    def _bar(self, what: str, share: float, detail: str) -> None:
        if self.listener is not None:
            self.listener(Progressed(what, min(1.0, share), detail))
        if self.cell is not None:
            self.cell.show(what, share, detail)
        if what != self.what or self.task is None:
            self.what = what
            self.task = self.progress.add_task(what, total=1.0, detail=detail)
        self.progress.update(self.task, completed=min(1.0, share), detail=detail)

    def _due(self, last: bool) -> bool:
        if self.quiet or self.cell is not None:
            return False
        now = time.perf_counter()
        if now - self.last < LINE_SECONDS and not last:
            return False
        self.last = now
        return True

    def _line(self, event: dict[str, object]) -> None:
        print(json.dumps(event), file=sys.stderr, flush=True)


class _Cell:
    """A bar below a notebook's cell, one for each step; drawn by IPython, without widgets."""

    def __init__(self) -> None:
        self.handle: Any = None
        self.what = ""
        self.last = 0.0

    def show(self, what: str, share: float, detail: str) -> None:
        """Draw the bar; at most a few times a second."""
        from IPython.display import HTML, display  # there is one: the console runs in it

        now = time.perf_counter()
        begins = what != self.what
        if not begins and share < 1 and now - self.last < CELL_SECONDS:
            return
        self.last = now
        bar = f'<progress value="{min(1.0, share):.4f}"></progress>'
        shown = HTML(f"{bar} {html.escape(what)} {share:.0%} {html.escape(detail)}")
        if begins:
            self.what = what
            self.handle = display(shown, display_id=True)
        else:
            self.handle.update(shown)


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes}:{rest:02d}"
