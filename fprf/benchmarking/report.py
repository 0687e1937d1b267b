"""What a benchmark says: rows of figures with their goals, the error beside the time, and the machine; as JSON and a table."""

import os
import platform
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from rich.markup import escape
from rich.table import Table

from .. import __version__
from ..io.figures import number
from .timing import Spread

__all__ = ["Outcome", "Row", "document", "falls_short", "machine", "rows_table", "table"]


class Outcome(NamedTuple):
    """What a benchmark found."""

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
    """What is aimed at; None where nothing is."""
    more_is_better: bool = False
    """Whether the figure should be at least the goal, or at most."""
    peer: float | None = None
    """The same figure of what it is compared with."""
    ratio: Spread | None = None
    """How many times faster than the peer, round by round."""
    ratio_goal: float | None = None
    """How many times faster it should be at least."""
    error: float | None = None
    """What the speed costs; see `error_kind`."""
    error_kind: str = ""
    peer_error: float | None = None
    """The same error of the peer."""
    note: str = ""

    @property
    def met(self) -> bool:
        """Whether the goals, if any, are met."""
        fast = self.ratio_goal is None or (self.ratio is not None and self.ratio.median >= self.ratio_goal)
        if self.goal is None:
            return fast
        return fast and (self.figure >= self.goal if self.more_is_better else self.figure <= self.goal)

    def json(self) -> dict[str, object]:
        """What is known of it, rounded to the digits that mean something."""
        known: dict[str, object] = {"name": self.name, "figure": _rounded(self.figure), "unit": self.unit}
        for key in ("low", "high", "goal", "peer", "ratio_goal", "error", "peer_error"):
            value = getattr(self, key)
            if value is not None:
                known[key] = _rounded(value)
        if self.goal is not None:
            known["goal_is"] = "at least" if self.more_is_better else "at most"
        if self.ratio is not None:
            known |= {key: _rounded(value) for key, value in _ratio_fields(self.ratio).items()}
        return known | {key: text for key in ("error_kind", "note") if (text := getattr(self, key))}


def machine(device: torch.device) -> dict[str, object]:
    """What ran it: kind of machine, cores, threads, torch, load."""
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
    name: str, rows: Sequence[Row], *, device: torch.device, settings: Mapping[str, object], extra: Mapping[str, Any] = {}
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
    made = Table(title=title, title_justify="left", title_style="bold", box=None, pad_edge=False, padding=(0, 3, 0, 0))
    for i, column in enumerate(columns):
        made.add_column(column, justify="right" if i else "left", no_wrap=i > 0)
    for row in rows:
        made.add_row(*map(escape, row))
    return made


def rows_table(title: str, rows: Sequence[Row]) -> Table:
    """The rows as people read them, the spread as half the distance of the quartiles; what a peer is, the title says."""
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


def _ratio_fields(ratio: Spread) -> dict[str, float]:
    return {"ratio": ratio.median, "ratio_low": ratio.low, "ratio_high": ratio.high}


def _rounded(value: float) -> float:
    return value if isinstance(value, int) else float(f"{value:.5g}")
