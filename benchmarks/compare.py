"""Two results of one benchmark, row by row: fails where the new one has lost.

    python -m benchmarks compare OLD.json NEW.json

What counts is the speed-up against the peer that ran in the same rounds, which a busy or another machine moves
little; on one kind of machine the figure counts as well, since a peer may have become faster: a row has lost
where all that counts is worse by more than `--loss`. An error more than `--error` times as large, and a row
that is gone, are losses too.
"""

import argparse
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from fprf.errors import DataError

from .common import console
from .report import number, table

_RISING = ("/s", "dB")
"""Ends of units of which more is better; of all others less is."""
_SAME_MACHINE = ("processor", "cores", "threads", "device")
"""Properties that two machines must share for plain figures to be compared."""


class Change(NamedTuple):
    """One row, before and after."""

    name: str
    before: str
    after: str
    gain: float | None
    """After over before, above 1 where it is better: the largest of what counts. None where nothing does."""
    fault: str
    """Losses; empty = none."""


def main(argv: list[str]) -> int:
    """0 where nothing is lost, 1 where something is."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks compare",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("old", type=Path, metavar="OLD.json", help="the result before a change")
    parser.add_argument("new", type=Path, metavar="NEW.json", help="the result after it")
    parser.add_argument("--loss", type=float, default=0.1, help="share of a speed that may be lost (0.1)")
    parser.add_argument("--error", type=float, default=1.5, help="times that an error may grow (1.5)")
    asked = parser.parse_args(argv)
    old = _read(asked.old)
    new = _read(asked.new)
    found = changes(old, new, loss=asked.loss, error=asked.error)
    rows = []
    for each in found:
        gain = "–" if each.gain is None else f"{each.gain:.2f} ×"
        rows.append((each.name, each.before, each.after, gain, each.fault or "ok"))
    console().print(table(f"{asked.new} against {asked.old}", ("", "before", "after", "gain", ""), rows))
    for key in sorted(set(old.get("settings", {})) | set(new.get("settings", {}))):
        one = old.get("settings", {}).get(key)
        two = new.get("settings", {}).get(key)
        if one != two:
            print(f"settings differ: {key} was {one}, is {two}", file=sys.stderr)
    lost = [each.name for each in found if each.fault]
    if lost:
        print(f"lost: {', '.join(lost)}", file=sys.stderr)
    return int(bool(lost))


def changes(old: Mapping[str, Any], new: Mapping[str, Any], *, loss: float, error: float) -> list[Change]:
    """Each row of the old result beside that of the new one. Raises DataError where they are of different
    benchmarks.
    """
    if old.get("benchmark") != new.get("benchmark"):
        raise DataError(
            f"the results are of {old.get('benchmark')} and {new.get('benchmark')}; compare two of one benchmark"
        )
    here = old.get("machine", {})
    there = new.get("machine", {})
    same = all(here.get(key) == there.get(key) for key in _SAME_MACHINE)
    after = {row["name"]: row for row in new["rows"]}
    found = []
    for row in old["rows"]:
        if row["name"] in after:
            found.append(change(row, after[row["name"]], loss=loss, error=error, same=same))
        else:
            found.append(Change(row["name"], _figure(row), "–", None, "gone"))
    return found


def change(
    before: Mapping[str, Any], after: Mapping[str, Any], *, loss: float, error: float, same: bool
) -> Change:
    """A row before and after; plain figures are compared on the `same` kind of machine alone."""
    gains = []
    if "ratio" in before and "ratio" in after:
        gains.append(after["ratio"] / before["ratio"])
    if same and before["figure"] > 0 and after["figure"] > 0:
        gain = after["figure"] / before["figure"]
        gains.append(gain if before["unit"].endswith(_RISING) else 1 / gain)
    faults = []
    best = max(gains, default=None)
    if best is not None and best < 1 - loss:
        faults.append("slower" if "ratio" in before else "worse")
    if before.get("error", 0) > 0 and after.get("error", 0) > error * before["error"]:
        faults.append(f"error {number(before['error'])} to {number(after['error'])}")
    return Change(before["name"], _figure(before), _figure(after), best, ", ".join(faults))


def _figure(row: Mapping[str, Any]) -> str:
    if "ratio" in row:
        return f"{number(row['ratio'])} × ({number(row['figure'])} {row['unit']})"
    return f"{number(row['figure'])} {row['unit']}"


def _read(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(path.read_text("utf-8"))
    except OSError as problem:
        raise DataError(f"{path}: {problem.strerror}; name a result of a benchmark (--output)") from problem
    except ValueError as problem:
        raise DataError(f"{path}: no JSON ({problem}); name a result of a benchmark (--output)") from problem
    rows = found.get("rows") if isinstance(found, dict) else None
    if not isinstance(rows, list) or not all(
        isinstance(r, dict) and {"name", "figure", "unit"} <= set(r) for r in rows
    ):
        raise DataError(f"{path}: no rows with name, figure and unit; name a result such as that of speed")
    result: dict[str, Any] = found
    return result
