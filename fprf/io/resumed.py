"""Frames that outlive an interruption: a folder remembers what it is rendered from, and only missing frames are made again."""

import json
from collections.abc import Sequence
from pathlib import Path

from .atomic import write_json

__all__ = ["missing"]

_RECORD = ".render.json"


def missing(folder: Path, key: str, paths: Sequence[Path]) -> list[Path]:
    """Which of the frames are not there yet; all, where the folder was rendered from something else than `key` says.

    The key is written down at once, so that what is rendered from now on counts. Frames are whole or absent.
    """
    record = folder / _RECORD
    try:
        known = json.loads(record.read_text("utf-8")).get("key")
    except (OSError, ValueError, AttributeError):
        known = None
    if known == key:
        return [path for path in paths if not path.is_file()]
    for path in paths:
        path.unlink(missing_ok=True)
    write_json(record, {"key": key})
    return list(paths)
