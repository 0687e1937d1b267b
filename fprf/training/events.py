"""What a run told while it was trained: events.jsonl, read back. A damaged line is skipped, as a killed run may leave one."""

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from ..errors import CheckpointError

__all__ = ["History", "read_history"]


class History(NamedTuple):
    """One training: of the run, or of one of its blocks."""

    name: str
    """Empty for the run itself."""
    step: list[int]
    seconds: list[float]
    """Training time at each step, over all resumes."""
    values: dict[str, list[float | None]]
    """psnr, rays_per_second, kept and each loss by its name, at each step; None where a line does not say."""
    parts: dict[str, float]
    """Seconds of each part of training by its name, all resumes together."""
    notes: list[str]
    """What went wrong: skipped steps, damaged checkpoints, returns to an earlier one."""


def read_history(run: Path) -> list[History]:
    """The histories of a run and of its blocks, in the order of their names; those without any line are left out.

    Where a run was resumed from an earlier step, the later steps of the first try are dropped. Raises CheckpointError
    where there is no line at all.
    """
    files = [run / "events.jsonl", *sorted((run / "blocks").glob("*/events.jsonl"))]
    found = [_history("" if file.parent == run else file.parent.name, file) for file in files if file.is_file()]
    found = [history for history in found if history.step or history.parts]
    if not found:
        raise CheckpointError(f"{run}: no events.jsonl with a line of training; `fprf train` writes it as it goes")
    return found


def _history(name: str, file: Path) -> History:
    lines: list[dict[str, Any]] = []
    parts: dict[str, float] = {}
    notes: list[str] = []
    for event in _events(file):
        if "part" in event and _number(event.get("seconds")) is not None:
            parts[str(event["part"])] = parts.get(str(event["part"]), 0.0) + float(event["seconds"])
        elif isinstance(event.get("step"), int) and _number(event.get("seconds")) is not None:
            while lines and lines[-1]["step"] >= event["step"]:
                lines.pop()
            lines.append(event)
        else:
            notes.append(", ".join(f"{key.replace('_', ' ')}: {value}" for key, value in event.items()))
    flat = [{**event, **(event["losses"] if isinstance(event.get("losses"), dict) else {})} for event in lines]
    known = dict.fromkeys(key for event in flat for key in event if key not in ("step", "seconds", "losses"))
    values = {key: [_number(event.get(key)) for event in flat] for key in known}
    return History(name, [e["step"] for e in lines], [float(e["seconds"]) for e in lines], values, parts, notes)


def _events(file: Path) -> Iterator[dict[str, Any]]:
    for line in file.read_text("utf-8", errors="replace").splitlines():
        try:
            event = json.loads(line)
        except ValueError:
            continue
        if isinstance(event, dict):
            yield event


def _number(value: object) -> float | None:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return None
    return float(value)
