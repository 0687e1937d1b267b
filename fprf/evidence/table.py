"""Figures as tables: for a terminal and for a page. A dash stands for what a method does not have."""

from collections.abc import Mapping, Sequence
from typing import Any

from rich.table import Table

__all__ = ["Column", "markdown", "printed"]

Column = tuple[str, str, str]
"""Key of the figure, heading, format."""
Rows = Mapping[str, Mapping[str, Any]]


def markdown(rows: Rows, columns: Sequence[Column], *, first: str = "") -> str:
    """A Markdown table with the rows' names in the first column."""
    lines = ["| " + " | ".join([first, *(heading for _, heading, _ in columns)]) + " |"]
    lines.append("|---" + "|---:" * len(columns) + "|")
    lines += ["| " + " | ".join([name, *_cells(row, columns)]) + " |" for name, row in rows.items()]
    return "\n".join(lines)


def printed(title: str, rows: Rows, columns: Sequence[Column]) -> Table:
    """The same for a terminal."""
    made = Table(title=title, title_justify="left", title_style="bold", box=None, pad_edge=False, padding=(0, 2, 0, 0))
    made.add_column("", no_wrap=True)
    for _, heading, _ in columns:
        made.add_column(heading, justify="right")
    for name, row in rows.items():
        made.add_row(name, *_cells(row, columns))
    return made


def _cells(row: Mapping[str, Any], columns: Sequence[Column]) -> list[str]:
    return ["–" if row.get(key) is None else format(row[key], form) for key, _, form in columns]
