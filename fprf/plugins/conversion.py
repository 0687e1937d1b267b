"""Values of config fields as callers in Python write them: text or path-like objects for paths, lists, arrays or one
value for tuples, whole numbers for floats.
"""

import os
from collections.abc import Iterable, Sequence
from dataclasses import fields, is_dataclass, replace
from numbers import Integral, Real
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from ..errors import ConfigError
from ..io.paths import as_path
from .slots import hints_of, members


def convert_fields(config: Any) -> None:
    """Bring the fields of a frozen config to their types, also those of configs within it: for `__post_init__`.

    Values of other types than their field takes stay as they are, but for paths and tuples. Raises ConfigError
    naming the field.
    """
    hints = hints_of(type(config))
    for field in fields(config):
        value = getattr(config, field.name)
        converted = _converted(value, hints[field.name], field.name)
        if converted is not value:
            object.__setattr__(config, field.name, converted)


def _converted(value: Any, hint: Any, name: str) -> Any:
    """A value as its type hint has it."""
    kinds = members(hint)
    if value is None and type(None) in kinds:
        return None
    if is_dataclass(value) and not isinstance(value, type):
        return _converted_config(value)
    numbers = []
    for kind in (int, float):
        if kind in kinds:
            numbers.append(kind)
    if numbers and isinstance(value, Real) and not isinstance(value, bool):
        return _number(value, numbers)
    if Path in kinds:
        return _path(value, name)
    if str in kinds and isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, str) and any(
        value in get_args(kind) for kind in kinds if get_origin(kind) is Literal
    ):
        return value
    rows = []
    for kind in kinds:
        if get_origin(kind) is tuple:
            rows.append(kind)
    return _tuple(value, rows[0], name) if rows else value


def _converted_config(config: Any) -> Any:
    """A config with its fields converted; itself where nothing changes."""
    hints = hints_of(type(config))
    changed = {}
    for field in fields(config):
        value = getattr(config, field.name)
        converted = _converted(value, hints[field.name], field.name)
        if converted is not value:
            changed[field.name] = converted
    return replace(config, **changed) if changed else config


def _number(value: Real, kinds: Sequence[type]) -> Any:
    """A number of any library as int or float; a whole one stays whole where both are taken."""
    whole = isinstance(value, Integral)
    if type(value) in kinds:
        return value
    if whole and int in kinds:
        return int(value)  # type: ignore[call-overload]
    return float(value) if float in kinds else value


def _path(value: Any, name: str) -> Path:
    """A path of whatever names one; the same object where that is a path without `~`."""
    try:
        path = as_path(value)
    except TypeError as error:
        raise ConfigError(f"{name}: {value!r} is no path; give a text or a pathlib.Path") from error
    if isinstance(value, Path) and value == path:
        return value
    return path


def _tuple(value: Any, hint: Any, name: str) -> Any:
    """A tuple of whatever holds its items; one item alone, of a tuple of any length, is a tuple of it."""
    args = get_args(hint)
    several = len(args) == 2 and args[1] is Ellipsis
    items = value
    if hasattr(value, "tolist"):  # an array or a tensor
        items = value.tolist()
    single = isinstance(items, str | os.PathLike | Real)
    if single and several:
        items = [items]
    if isinstance(items, str | os.PathLike) or not isinstance(items, Iterable):
        if several:
            wanted = "a tuple or list"
        else:
            wanted = f"{len(args)} values"
        raise ConfigError(f"{name}: {value!r}; {wanted} is needed")
    items = list(items)
    if not several and len(items) != len(args):
        raise ConfigError(f"{name}: {len(items)} values, {len(args)} are needed")
    kinds = [args[0]] * len(items) if several else list(args)
    found = tuple(_converted(item, kind, name) for item, kind in zip(items, kinds, strict=True))
    same = isinstance(value, tuple) and all(a is b for a, b in zip(value, found, strict=True))
    return value if same else found


def three_numbers(name: str, values: Any) -> tuple[float, float, float]:
    """Three numbers of whatever holds them: a tuple, a list, an array, a tensor. Raises ConfigError."""
    x, y, z = _tuple(values, tuple[float, float, float], name)
    return x, y, z
