"""Locks of run folders: one training at a time."""

from pathlib import Path

from ..io.folder_lock import LOCK as LOCK
from ..io.folder_lock import is_locked
from ..io.folder_lock import lock_folder as lock_folder


def in_training(folder: Path) -> bool:
    """True while a process holds a folder: what it has learnt so far will change soon."""
    return is_locked(folder)
