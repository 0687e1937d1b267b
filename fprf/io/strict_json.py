"""Strict JSON: no repeated keys, no NaN, no numbers beyond float64, no text that cannot be written again."""

import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ..errors import CheckpointError, ConfigError

_UNEXPECTED = (
    OSError,
    ValueError,
    LookupError,
    TypeError,
    AttributeError,
    ArithmeticError,
    RuntimeError,
    ConfigError,
)
"""Errors of a block that takes a value apart which is not what it expects; RuntimeError is what torch
raises.
"""


def parse_json(text: str, *, nan: bool = False) -> Any:
    """Parse a JSON value, NaN and infinities too where `nan` allows them. Raises ValueError, and nothing
    else.
    """

    def constant(text: str) -> float:
        if not nan:
            raise ValueError(f"{text} is not a number that JSON knows")
        return float(text)

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        members: dict[str, Any] = {}
        for key, value in pairs:
            if key in members:
                raise ValueError(f"the key {key!r} stands twice in one object")
            members[key] = value
        return members

    try:
        value = json.loads(
            text, object_pairs_hook=unique, parse_constant=constant, parse_float=_real, parse_int=_whole
        )
        if "\\u" in text:
            json.dumps(value, ensure_ascii=False).encode()  # half of a surrogate pair has no UTF-8
    except json.JSONDecodeError as error:
        raise ValueError(f"is not JSON: line {error.lineno}, column {error.colno}: {error.msg}") from error
    except RecursionError as error:
        raise ValueError("is nested too deeply") from error
    return value


@contextmanager
def open_json(path: Path, remedy: str) -> Iterator[Any]:
    """Give the value in a file of a run to the block that takes it apart.

    Raises CheckpointError, which ends in the `remedy`, where the file cannot be read or holds what the block
    does not expect.
    """
    try:
        yield parse_json(path.read_text("utf-8"))
    except _UNEXPECTED as error:
        readable = isinstance(error, OSError | ValueError | ConfigError)
        reason = str(error) if readable else repr(error)
        raise CheckpointError(f"{path}: cannot be read ({reason}); {remedy}") from error


def _real(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text[:20]} is beyond the largest number of float64, 1.8e308")
    return value


def _whole(text: str) -> int:
    _real(text)
    return int(text)
