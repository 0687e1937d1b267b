"""Blocks that were trained keep their folders when a scene is cut anew and they get other numbers."""

import json
import os
import shutil
from collections.abc import Mapping
from pathlib import Path

from .blocks import folder_of

__all__ = ["renumber", "trained_tasks"]

_MOVING = "moving-"


def trained_tasks(root: Path) -> dict[Path, str]:
    """Folders of blocks in a run, whatever their numbers, and what each was begun as."""
    found = {}
    for mark in sorted((root / "blocks").glob("*/task.json")):
        try:
            found[mark.parent] = str(json.loads(mark.read_text())["task"])
        except (OSError, ValueError, KeyError, TypeError):
            continue  # cut short while it was written: as good as not begun
    return found


def renumber(root: Path, asked: Mapping[int, str]) -> None:
    """Move each folder that was begun as what some block is asked for now to that block's number.

    A folder in the way that nobody asks for is removed. Where it is cut off, the next call finishes it.
    """
    known = trained_tasks(root)
    moves: dict[int, Path] = {}
    for block, task in asked.items():
        if known.get(folder_of(root, block)) == task:
            known.pop(folder_of(root, block))
    for block, task in asked.items():
        holder = next((folder for folder, was in known.items() if was == task), None)
        if holder is not None:
            known.pop(holder)
            moves[block] = holder
    # Twice, so that no folder stands in another's way.
    for block, holder in moves.items():
        os.rename(holder, _aside(root, asked[block]))
    for block in moves:
        target = folder_of(root, block)
        shutil.rmtree(target, ignore_errors=True)
        os.rename(_aside(root, asked[block]), target)
    for left in (root / "blocks").glob(f"{_MOVING}*"):
        shutil.rmtree(left)


def _aside(root: Path, task: str) -> Path:
    return root / "blocks" / f"{_MOVING}{task}"
