"""Configs to plain JSON and back, driven by the type hints.

Nothing in a file is ever imported: a plug-in is named, and the name is looked up among the installed entry
points. One that is not installed is kept as data (`Missing`) and fails only when it is built.
"""

import dataclasses
import enum
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, NoReturn, TypeVar, get_args, get_origin

from ..errors import ConfigError, PluginError
from ..io.strict_json import parse_json
from . import registry
from .config import Need, PluginConfig
from .slots import hints_of, is_slot, members, slots

T = TypeVar("T")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Missing(PluginConfig):
    """Stands where a plug-in was that cannot be loaded here; keeps its data, and fails when it is built."""

    slot: str
    """Dotted path of the slot."""
    kind: str
    """Entry-point group."""
    name: str
    """Name of the plug-in."""
    data: str
    """Its fields, as JSON text."""
    package: str
    """The package that provided it when the file was written, as the file says; may be empty."""
    reason: str
    """Reason why it cannot be loaded."""

    def needs(self) -> tuple[Need, ...]:
        return (Need(self.reason, self._remedy()),)

    def build(self, *args: object, **kwargs: object) -> NoReturn:
        """Raise PluginError: takes what any kind's `build` takes."""
        raise PluginError(f"{self.slot}: {self.reason}; {self._remedy()}")

    def _remedy(self) -> str:
        package = self.package or "the package that provides it"
        return f"install {package}, or choose another with --{self.slot} NAME"


def to_json(config: object) -> Any:
    """A config as dicts, lists, strings and numbers; a plug-in carries its name as `type`."""
    return _encode(config, type(config), "config")


def leaves(config: object) -> dict[str, Any]:
    """Every field of a config tree as JSON by its dotted path. A plug-in's path gives its name; without one
    there, null.
    """
    values: dict[str, Any] = {}

    def walk(tree: Any, path: str) -> None:
        if not isinstance(tree, dict):
            values[path] = tree
            return
        for name, value in tree.items():
            walk(value, path if name == "type" else f"{path}.{name}".lstrip("."))

    walk(to_json(config), "")
    return values


def from_json(
    data: Any, kind: type[T], *, packages: Mapping[str, str] | None = None, path: str = "config"
) -> T:
    """The config of that type. Raises ConfigError naming the field by its dotted path, of which `path` is the
    start.

    A key that is absent takes the code's default; an unknown one is refused. `packages` says by dotted path
    which package each plug-in came from, for the message about a missing one.
    """
    value: T = _read(data, kind, path, packages or {})
    return value


def _encode(value: Any, hint: Any, path: str) -> Any:
    if isinstance(value, Missing):
        return {"type": value.name, **json.loads(value.data)}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        # In a slot a config carries the name that it is installed under.
        kind = next(filter(is_slot, members(hint)), None)
        if kind:
            tag = {"type": registry.name_of(kind.group, type(value))}
        else:
            tag = {}
        hints = hints_of(type(value))
        names = []
        for f in dataclasses.fields(value):
            names.append(f.name)
        if kind and "type" in names:
            raise ConfigError(
                f"{path}: {type(value).__name__} has a field `type`, which names the plug-in; rename it"
            )
        return tag | {name: _encode(getattr(value, name), hints[name], f"{path}.{name}") for name in names}
    if isinstance(value, enum.Enum):
        return value.value
    if isinstance(value, Path):
        return value.as_posix()
    if isinstance(value, tuple | list):
        hint = next((h for h in members(hint) if get_origin(h) in (tuple, list)), tuple[Any, ...])
        items = []
        for i, (v, h) in enumerate(zip(value, _items(hint, len(value)), strict=True)):
            items.append(_encode(v, h, f"{path}.{i}"))
        return items
    if isinstance(value, Mapping):
        hint = next((h for h in members(hint) if get_origin(h) is dict), dict[str, Any])
        entries = {}
        for k, v in value.items():
            entries[str(k)] = _encode(v, get_args(hint)[1], f"{path}.{k}")
        return entries
    if isinstance(value, float) and not math.isfinite(value):
        raise ConfigError(f"{path}: {value} is not a finite number and cannot be saved")
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise ConfigError(f"{path}: {type(value).__name__} cannot be saved; use numbers, text, paths, tuples")


def _read(data: Any, hint: Any, path: str, packages: Mapping[str, str]) -> Any:
    if hint is Any:
        return data
    # Of a union the first kind that the value is of; where it is of none, what each of them expected is told.
    choices = []
    for h in members(hint):
        if h is not type(None):
            choices.append(h)
    if data is None and len(choices) < len(members(hint)):
        return None
    if len(choices) > 1:
        faults = []
        for choice in choices:
            try:
                return _read(data, choice, path, packages)
            except ConfigError as fault:
                faults.append(str(fault).removeprefix(f"{path}: "))
        raise ConfigError(f"{path}: {', nor '.join(faults)}")
    hint = choices[0]
    origin = get_origin(hint)
    args = get_args(hint)
    if is_slot(hint):
        # A number may stand for a plug-in: runs from before cells had layouts hold how many there are.
        numbered = _of_number(data, hint, path)
        if numbered is not None:
            return numbered
        # A plug-in is named; one that cannot be loaded is kept as data.
        fields = dict(_expect(data, dict, path))
        name = fields.pop("type", None)
        if not isinstance(name, str):
            raise ConfigError(f'{path}: expected the plug-in\'s name as "type", found {_shown(repr(name))}')
        try:
            chosen = registry.load(hint.group, name, hint)
        except PluginError as reason:
            slot = path.partition(".")[2]
            text = json.dumps(fields, allow_nan=False)
            package = packages.get(slot, "").removeprefix(f"{name} ")
            return Missing(
                slot=slot, kind=hint.group, name=name, data=text, package=package, reason=str(reason)
            )
        return _read_fields(fields, chosen, path, packages)
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        return _read_fields(_expect(data, dict, path), hint, path, packages)
    # Containers, item by item.
    if origin in (tuple, list):
        items = _expect(data, list, path)
        hints = _items(hint, len(items))
        if len(items) != len(hints):
            raise ConfigError(f"{path}: expected {len(hints)} values, found {len(items)}")
        values = []
        for i, (item, hint) in enumerate(zip(items, hints, strict=True)):
            values.append(_read(item, hint, f"{path}.{i}", packages))
        return origin(values)
    if origin is dict:
        found = {}
        for k, v in _expect(data, dict, path).items():
            found[k] = _read(v, args[1], f"{path}.{k}", packages)
        return found
    if origin is Literal or (isinstance(hint, type) and issubclass(hint, enum.Enum)):
        if origin is Literal:
            allowed = {value: value for value in args}
        else:
            allowed = {}
            for each in hint:
                allowed[each.value] = each
        for value, meant in allowed.items():
            if type(value) is type(data) and value == data:  # True == 1
                return meant
        raise ConfigError(
            f"{path}: {_shown(repr(data))} is not one of {', '.join(map(repr, allowed))}; write one of these there"
        )
    # Plain values.
    if hint is Path:
        return Path(_expect(data, str, path))
    if hint is float:
        number = _expect(data, (float, int), path)
        try:
            value = float(number)
        except OverflowError:
            value = math.inf
        if not math.isfinite(value):
            raise ConfigError(f"{path}: expected a finite number, found one beyond the range of float64")
        return value
    if hint in (bool, int, str):
        return _expect(data, hint, path)
    raise ConfigError(f"{path}: a field of type {hint} cannot be read from a file")


def _of_number(data: Any, kind: type[PluginConfig], path: str) -> PluginConfig | None:
    """The config that a number stands for in a slot; None where it is none, or stands for nothing."""
    if type(data) is not int:
        return None
    try:
        return kind.of_number(data)
    except ConfigError as fault:
        raise ConfigError(f"{path}: {fault}") from fault


def _shown(text: str) -> str:
    """Text of a file in a message."""
    return text if len(text) <= 60 else f"{text[:57]}..."


def _read_fields(data: dict[str, Any], cls: type, path: str, packages: Mapping[str, str]) -> Any:
    """A dataclass of the fields in an object."""
    hints = hints_of(cls)
    fields = {}
    for f in dataclasses.fields(cls):
        if f.init:
            fields[f.name] = f
    names = list(fields)
    for name, field in fields.items():
        if name not in data and field.default is field.default_factory is dataclasses.MISSING:
            raise ConfigError(f"{path}: has no {name!r} (needed of {cls.__name__}: {', '.join(names)})")
    for key in data:
        if key not in names:
            raise ConfigError(
                f"{path}: {cls.__name__} has no field {_shown(repr(key))}{registry.nearest(key, names)} "
                f"(its fields: {', '.join(names) or 'none'})"
            )
    values = {}
    for key, value in data.items():
        values[key] = _read(value, hints[key], f"{path}.{key}", packages)
    try:
        return cls(**values)
    except (ConfigError, TypeError) as fault:  # out of its range
        raise ConfigError(f"{path}: {fault}") from fault


def _items(hint: Any, count: int) -> tuple[Any, ...]:
    """Types of the items of `tuple[A, B]`, `tuple[A, ...]` or `list[A]`."""
    args = get_args(hint)
    if get_origin(hint) is list or args[-1] is Ellipsis:
        return (args[0],) * count
    return args


def _expect(data: Any, kind: type | tuple[type, ...], path: str) -> Any:
    """The datum itself if it is exactly of that type: a bool is no int, 1.0 is no int, "5" is no number."""
    kinds = kind if isinstance(kind, tuple) else (kind,)
    if type(data) not in kinds:
        raise ConfigError(f"{path}: expected {_JSON_KINDS[kinds[0]]}, found {_shown(json.dumps(data))}")
    return data


_JSON_KINDS = {
    bool: "true or false",
    int: "a whole number",
    float: "a number",
    str: "a text",
    dict: "an object",
    list: "a list",
}
"""Names of the kinds of JSON in messages."""


def packages_of(config: object) -> dict[str, str]:
    """Name, package and version of what fills every slot, by dotted path."""
    packages = {}
    for slot in slots(config):
        if isinstance(slot.value, Missing):
            packages[slot.path] = f"{slot.value.name} {slot.value.package}".strip()
        elif slot.value is not None:
            name = registry.name_of(slot.kind.group, type(slot.value))
            packages[slot.path] = f"{name} {registry.entry(slot.kind.group, name).package}"
    return packages


def read_json(path: Path, name: str = "a config.json") -> Any:
    """Strict JSON of a file (see `parse_json`).

    Raises ConfigError, which asks for `name` where there is no such file.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as fault:
        raise ConfigError(f"{path}: cannot be read ({fault.strerror or fault}); name {name}") from fault
    except UnicodeDecodeError as fault:
        raise ConfigError(f"{path}: is not UTF-8 text ({fault.reason} at byte {fault.start})") from fault
    try:
        return parse_json(text)
    except ValueError as fault:
        raise ConfigError(f"{path}: {fault}") from fault
