"""The course of a training, read back from events.jsonl of a run and of its parts."""

from pathlib import Path
from typing import Any, NamedTuple

from ..errors import CheckpointError
from ..io.strict_json import parse_json

_MAX_FIGURE = 3.4e38
"""Figure up to which a line is believed: training computes in float32, and sums of larger ones overflow."""
_MAX_STEP = 2**63
"""Step below which a line is believed: charts take 64-bit numbers."""


class History(NamedTuple):
    """One training: of the run, or of one of its parts."""

    name: str
    """Empty for the run itself."""
    step: list[int]
    seconds: list[float]
    """Training time at each step, over all resumes."""
    values: dict[str, list[float | None]]
    """psnr, rays_per_second, kept and each loss by its name, at each step; None where a line does not say."""
    notes: list[str]
    """Faults of the training: skipped steps, damaged checkpoints, returns to an earlier one."""


def read_history(run: Path) -> list[History]:
    """The histories of a run and of its parts: blocks, or the overview and cells; those without any line are
    left out.

    Where a run was resumed from an earlier step, the later steps of the first try are dropped. Raises
    CheckpointError where there is no line at all.
    """
    files = [run / "events.jsonl"]
    for part in ("overview", "blocks/*", "cells/*"):
        files += sorted(run.glob(f"{part}/events.jsonl"))
    histories = []
    for file in files:
        if file.is_file():
            histories.append(_history("" if file.parent == run else file.parent.name, file))
    histories = [history for history in histories if history.step]
    if not histories:
        raise CheckpointError(
            f"{run}: no events.jsonl with a line of training; `fprf train` writes it as it goes"
        )
    return histories


def _history(name: str, file: Path) -> History:
    """The lines of a file, which a killed process may have cut short, and which may come from anywhere."""
    lines: list[dict[str, Any]] = []
    notes: list[str] = []
    for text in file.read_text("utf-8", errors="replace").splitlines():
        try:
            event = parse_json(text, nan=True)
        except ValueError:
            continue
        if not isinstance(event, dict):
            continue
        step = event.get("step")
        if type(step) is int and abs(step) < _MAX_STEP and _number(event.get("seconds")) is not None:
            # After a resume the steps come again.
            while lines and lines[-1]["step"] >= step:
                lines.pop()
            lines.append(event)
        else:
            notes.append(", ".join(f"{key.replace('_', ' ')}: {value}" for key, value in event.items()))
    # Losses stand beside the other figures of their line; what a line does not say is None.
    flat = []
    values: dict[str, list[float | None]] = {}
    for event in lines:
        losses = event.get("losses")
        if isinstance(losses, dict):
            whole = event | losses
        else:
            whole = event
        flat.append(whole)
        for key in whole:
            if key not in ("step", "seconds", "losses"):
                values[key] = []
    for key, column in values.items():
        column += [_number(event.get(key)) for event in flat]
    return History(name, [e["step"] for e in lines], [float(e["seconds"]) for e in lines], values, notes)


def _number(value: object) -> float | None:
    """A figure as training writes it; None for anything else."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < _MAX_FIGURE:
        return None
    return float(value)
