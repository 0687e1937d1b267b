"""Reports of benchmarks: times, rows with goals, provenance, tables, contact sheets.

Times are comparable on a busy machine: what is compared runs in turn, round after round, ratios are taken
within a round, and the median and quartiles over the rounds are reported. One call of each before them does
not count.
"""

import os
import platform
import statistics
import subprocess
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
import torch
from rich.markup import escape
from rich.table import Table
from torch import Tensor

from fprf import __version__
from fprf.io.images import Picture, resized, to_uint8
from fprf.training.prepare import device_of

Clock = Literal["wall", "processor"]


class Spread(NamedTuple):
    """A figure over the rounds."""

    median: float
    low: float
    """First quartile."""
    high: float
    """Third quartile."""
    rounds: int

    def map(self, function: Callable[[float], float]) -> "Spread":
        """The spread of a monotonic function of the figure."""
        low, high = sorted((function(self.low), function(self.high)))
        return Spread(function(self.median), low, high, self.rounds)


def number(value: float | int | str | bool | None) -> str:
    """Three digits that matter, thousands apart; a dash for what was not measured."""
    if value is None:
        return "–"
    if isinstance(value, str):
        return value
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int) or value == 0 or abs(value) >= 100:
        return f"{value:,.0f}"
    if abs(value) < 1e-3:
        return f"{value:.1e}"
    return f"{value:.{1 if abs(value) >= 50 else 2 if abs(value) >= 1 else 3}f}"


def spread(values: Sequence[float]) -> Spread:
    """Median and quartiles, inclusive: of two values they lie between, of one they are the value."""
    if len(values) < 2:
        return Spread(values[0], values[0], values[0], 1)
    low, median, high = statistics.quantiles(values, n=4, method="inclusive")
    return Spread(median, low, high, len(values))


class Watch(NamedTuple):
    """Clock and rounds of a timing."""

    rounds: int
    device: torch.device
    clock: Clock = "wall"

    def once(self, call: Callable[[], object]) -> float:
        """Seconds of one call, until the device has finished; a processor's clock says nothing of another
        device's time.
        """
        now = (
            time.process_time
            if self.clock == "processor" and self.device.type == "cpu"
            else time.perf_counter
        )
        self._wait()
        start = now()
        call()
        self._wait()
        return now() - start

    def in_turn(
        self,
        calls: Mapping[str, Callable[[], object]],
        progress: Callable[[int, int], None] = lambda done, total: None,
    ) -> dict[str, list[float]]:
        """Seconds of every call in every round. The order turns by one a round: no call always follows the
        same.
        """
        names = list(calls)
        seconds: dict[str, list[float]] = {name: [] for name in names}
        for call in calls.values():
            self.once(call)
        for turn in range(self.rounds):
            progress(turn, self.rounds)
            first = turn % len(names)
            for name in names[first:] + names[:first]:
                seconds[name].append(self.once(calls[name]))
        progress(self.rounds, self.rounds)
        return seconds

    def spread(self, call: Callable[[], object]) -> Spread:
        """Of one call alone."""
        return spread(self.in_turn({"": call})[""])

    def _wait(self) -> None:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        elif self.device.type == "mps":
            torch.mps.synchronize()


def ratio(slow: Sequence[float], fast: Sequence[float]) -> Spread:
    """Speed-up, round by round: load that both met in a round cancels."""
    return spread([a / max(b, 1e-12) for a, b in zip(slow, fast, strict=True)])


class Outcome(NamedTuple):
    """Result of a benchmark."""

    document: dict[str, Any]
    """For JSON."""
    tables: list[Table]
    """For the terminal."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """One figure."""

    name: str
    figure: float
    unit: str
    low: float | None = None
    """First quartile over the rounds."""
    high: float | None = None
    """Third quartile."""
    goal: float | None = None
    """Target of the figure; None = none."""
    more_is_better: bool = False
    """True where the figure should be at least the goal, else at most."""
    peer: float | None = None
    """The same figure of what it is compared with."""
    ratio: Spread | None = None
    """Speed-up against the peer, round by round."""
    ratio_goal: float | None = None
    """Least speed-up that is aimed at."""
    error: float | None = None
    """Error at that speed; see `error_kind`."""
    error_kind: str = ""
    peer_error: float | None = None
    """The same error of the peer."""
    note: str = ""

    @property
    def met(self) -> bool:
        """True where the goals, if any, are met."""
        fast = self.ratio_goal is None or (self.ratio is not None and self.ratio.median >= self.ratio_goal)
        if self.goal is None:
            return fast
        return fast and (self.figure >= self.goal if self.more_is_better else self.figure <= self.goal)

    def json(self) -> dict[str, object]:
        """Fields as JSON, rounded to significant digits."""
        known: dict[str, object] = {"name": self.name, "figure": _rounded(self.figure), "unit": self.unit}
        for key in ("low", "high", "goal", "peer", "ratio_goal", "error", "peer_error"):
            value = getattr(self, key)
            if value is not None:
                known[key] = _rounded(value)
        if self.goal is not None:
            known["goal_is"] = "at least" if self.more_is_better else "at most"
        if self.ratio is not None:
            median, low, high, _ = self.ratio
            known |= {"ratio": _rounded(median), "ratio_low": _rounded(low), "ratio_high": _rounded(high)}
        return known | {key: text for key in ("error_kind", "note") if (text := getattr(self, key))}


def machine(device: torch.device) -> dict[str, object]:
    """Machine that ran it: kind of machine, cores, threads, torch, load."""
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else device.type
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None  # Windows has none
    return {
        "processor": platform.machine(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "device": name,
        "system": platform.system(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "fprf": __version__,
        "load": load,
    }


def falls_short(rows: Iterable[Row]) -> list[str]:
    """Names of the rows that miss their goal."""
    return [row.name for row in rows if not row.met]


def document(
    name: str,
    rows: Sequence[Row],
    *,
    device: torch.device,
    settings: Mapping[str, object],
    extra: Mapping[str, Any] = {},
) -> dict[str, Any]:
    """The JSON of a benchmark; `extra` comes after the rows."""
    return {
        "benchmark": name,
        "settings": dict(settings),
        "machine": machine(device),
        "rows": [row.json() for row in rows],
        "falls_short": falls_short(rows),
        **extra,
    }


def table(title: str, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> Table:
    """A plain table: the first column is text, the others are figures."""
    made = Table(
        title=title, title_justify="left", title_style="bold", box=None, pad_edge=False, padding=(0, 3, 0, 0)
    )
    for i, column in enumerate(columns):
        made.add_column(column, justify="right" if i else "left", no_wrap=i > 0)
    for row in rows:
        made.add_row(*map(escape, row))
    return made


def rows_table(title: str, rows: Sequence[Row]) -> Table:
    """The rows as people read them, the spread as half the distance of the quartiles; what a peer is, the
    title says.
    """
    compared = any(row.peer is not None for row in rows)
    columns = ["", "figure", "", *(["peer", "faster"] if compared else []), "error", "goal"]
    made = table(title, columns, (_cells(row, compared) for row in rows))
    short = falls_short(rows)
    made.caption = f"falls short: {escape(', '.join(short))}" if short else None
    made.caption_justify = "left"
    return made


def _cells(row: Row, compared: bool) -> list[str]:
    cells = [row.name, f"{number(row.figure)} {row.unit}", ""]
    if row.low is not None and row.high is not None and row.figure > 0:
        cells[2] = f"± {100 * (row.high - row.low) / (2 * row.figure):.0f} %"
    if compared:
        cells += ["" if row.peer is None else number(row.peer)]
        cells += ["" if row.ratio is None else f"{row.ratio.median:.2f} ×"]
    cells += ["" if row.error is None else f"{row.error:.1e}"]
    goals = [] if row.goal is None else [f"{'≥' if row.more_is_better else '≤'} {number(row.goal)}"]
    goals += [] if row.ratio_goal is None else [f"≥ {number(row.ratio_goal)} ×"]
    return [*cells, ", ".join(goals)]


def _rounded(value: float) -> float:
    return value if isinstance(value, int) else float(f"{value:.5g}")


def provenance(device: str) -> dict[str, object]:
    """Origin of a report: versions, commit, machine; nothing in it depends on the time. `device` as configs
    name it.
    """
    here = device_of(device)
    processor = platform.machine().replace("_", "-")
    return {
        "commit": commit(Path(__file__).parent),
        "fprf": __version__,
        "torch": torch.__version__,
        "machine": torch.cuda.get_device_name(here)
        if here.type == "cuda"
        else f"{os.cpu_count()} {processor} cores",
    }


def commit(folder: Path) -> str | None:
    """Short hash of the checkout that a folder lies in, with `+` where known files were changed; None outside
    of one.
    """
    try:
        answer = subprocess.run(  # nosec B607  # git as the user has it; fixed words
            ["git", "-C", str(folder), "describe", "--always", "--abbrev=12", "--dirty=+", "--exclude=*"],
            capture_output=True,
            text=True,
            timeout=30,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return answer.stdout.strip() or None


def words(origin: Mapping[str, object]) -> str:
    """A line for a page."""
    where = f"commit {origin['commit']}, " if origin["commit"] else ""
    return f"{where}fprf {origin['fprf']}, torch {origin['torch']}, {origin['machine']}"


Column = tuple[str, str, str]
"""Key of the figure, heading, format."""
Rows = Mapping[str, Mapping[str, Any]]


def markdown(rows: Rows, columns: Sequence[Column], *, first: str = "") -> str:
    """A Markdown table with the rows' names in the first column."""
    lines = ["| " + " | ".join([first, *(heading for _, heading, _ in columns)]) + " |"]
    lines.append("|---" + "|---:" * len(columns) + "|")
    lines += ["| " + " | ".join([name, *_figures(row, columns)]) + " |" for name, row in rows.items()]
    return "\n".join(lines)


def printed(title: str, rows: Rows, columns: Sequence[Column]) -> Table:
    """The same for a terminal."""
    headings = ["", *(heading for _, heading, _ in columns)]
    return table(title, headings, ([name, *_figures(row, columns)] for name, row in rows.items()))


def _figures(row: Mapping[str, Any], columns: Sequence[Column]) -> list[str]:
    return ["–" if row.get(key) is None else format(row[key], form) for key, _, form in columns]


_BAR = 18
_MARGIN = 62
_GAP = 3
"""Pixels above the columns, before the rows, and between pictures."""
_INK = (40, 40, 40)
_PAPER = 255


def contact_sheet(rows: Mapping[str, Sequence[Tensor]], columns: Sequence[str], *, height: int) -> Picture:
    """Pictures [H W 3] in [0, 1] by row, each as tall as `height` pixels; a row may be shorter than there are
    columns.

    Columns are as wide as their widest picture.
    """
    drawn = {name: [_scaled(to_uint8(image), height) for image in row] for name, row in rows.items()}
    widths = [
        max((row[i].shape[1] for row in drawn.values() if i < len(row)), default=0)
        for i in range(len(columns))
    ]
    edges = [_MARGIN + sum(widths[:i]) + i * _GAP for i in range(len(columns) + 1)]
    page = np.full((_BAR + len(drawn) * (height + _GAP), edges[-1], 3), _PAPER, dtype=np.uint8)
    for left, name in zip(edges, columns, strict=False):
        _write(page, name, (left + 1, _BAR - 5))
    for k, (name, row) in enumerate(drawn.items()):
        top = _BAR + k * (height + _GAP)
        _write(page, name, (2, top + height // 2))
        for left, picture in zip(edges, row, strict=False):
            page[top : top + height, left : left + picture.shape[1]] = picture
    return page


def _scaled(picture: Picture, height: int) -> Picture:
    return resized(picture, max(1, round(picture.shape[1] * height / picture.shape[0])), height)


def _write(page: Picture, text: str, at: tuple[int, int]) -> None:
    cv2.putText(
        page,
        text.encode("ascii", "replace").decode(),
        at,
        cv2.FONT_HERSHEY_SIMPLEX,
        0.36,
        _INK,
        1,
        cv2.LINE_AA,
    )
