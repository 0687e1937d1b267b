"""Lines of `fprf doctor`: what was looked at, what was found, and what mends it."""

from collections.abc import Iterable
from typing import NamedTuple

from rich.console import Console
from rich.markup import escape


class Finding(NamedTuple):
    """One line of the report."""

    what: str
    found: str
    remedy: str = ""
    """The one command or act that mends it; empty where nothing is wrong."""
    optional: bool = False
    """Everything else works without it."""


def show(findings: Iterable[Finding]) -> bool:
    """Print findings as they come; True if something that is needed is wrong."""
    console, bad = Console(highlight=False), False
    for finding in findings:
        mark = "[green]ok[/]      " if not finding.remedy else "[yellow]optional[/]" if finding.optional else "[red]problem[/] "
        bad |= bool(finding.remedy) and not finding.optional
        console.print(f"{mark}  [bold]{escape(finding.what):<14}[/] {escape(finding.found)}", soft_wrap=True)
        if finding.remedy:
            console.print(f"{'':<26} → {escape(finding.remedy)}", soft_wrap=True)
    return bad
