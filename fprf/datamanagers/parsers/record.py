"""Typed reading of JSON records; fields may also be given once for all. Each error names the file, place and key."""

from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ...errors import DataError
from .files import Json

__all__ = ["Record", "record_of"]

_Object: TypeAlias = dict[str, Json]


@dataclass(frozen=True)
class Record:
    """One JSON object; what it lacks is looked up in `common`."""

    where: str
    """File and place, the start of every message."""
    own: _Object
    common: _Object

    def get(self, key: str) -> Json:
        """The value, or None where it is absent or null."""
        value = self.own.get(key)
        return self.common.get(key) if value is None else value

    def number(self, key: str) -> float | None:
        """A number, or None where it is absent."""
        value = self.get(key)
        if value is None:
            return None
        if isinstance(value, bool) or not isinstance(value, int | float) or abs(value) > 1e300:
            raise DataError(f"{self.where}: {key} is {_short(value)}, not a number; correct it")
        return float(value)

    def text(self, key: str) -> str | None:
        """A string, or None where it is absent."""
        value = self.get(key)
        if value is not None and not isinstance(value, str):
            raise DataError(f"{self.where}: {key} is {_short(value)}, not a string; correct it")
        return value

    def texts(self, key: str) -> list[str] | None:
        """A list of strings, or None where it is absent."""
        value = self.get(key)
        if value is None:
            return None
        if not isinstance(value, list):
            raise DataError(f"{self.where}: {key} is {_short(value)}, not a list of strings; correct it")
        found = [item for item in value if isinstance(item, str)]
        if len(found) != len(value):
            raise DataError(f"{self.where}: {key} holds something that is not a string; correct it")
        return found

    def matrix(self, key: str) -> NDArray[np.float64]:
        """A list of 3 or 4 rows of 4 numbers."""
        value = self.get(key)
        rows = value if isinstance(value, list) else []
        numbers: list[float] = []
        for row in rows:
            cells = row if isinstance(row, list) else []
            real = [c for c in cells if isinstance(c, int | float) and not isinstance(c, bool) and abs(c) < 1e300]
            numbers += [float(c) for c in real] if len(real) == len(cells) == 4 else [np.nan]
        if len(numbers) not in (12, 16) or len(numbers) != 4 * len(rows) or not np.isfinite(numbers).all():
            raise DataError(f"{self.where}: {key} is {_short(value)}, not 3 or 4 rows of 4 numbers; correct it")
        return np.array(numbers, dtype=np.float64).reshape(-1, 4)

    def records(self, key: str) -> "list[Record]":
        """A list of objects, each falling back to this one."""
        value = self.own.get(key)
        if not isinstance(value, list) or not value:
            raise DataError(f"{self.where}: no list of {key}, or an empty one; an entry for each image is needed")
        return [record_of(f"{self.where}: {key}[{k}]", item, self.own) for k, item in enumerate(value)]


def record_of(where: str | Path, value: Json, common: _Object | None = None) -> Record:
    """A record of a JSON value, which must be an object."""
    if not isinstance(value, dict):
        raise DataError(f"{where}: {_short(value)} instead of an object in braces; correct it")
    return Record(str(where), value, common or {})


def _short(value: Json) -> str:
    if value is None:
        return "missing"
    text = repr(value) if not isinstance(value, dict | list) else "a list" if isinstance(value, list) else "an object"
    return text if len(text) <= 60 else text[:57] + "..."
