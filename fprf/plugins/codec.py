"""`config.json`: a config with its method, the version that wrote it and the packages of its plug-ins.

Strict: duplicate keys, NaN, unknown keys and foreign formats are refused. Written whole or not at all.
"""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from .. import __version__
from ..errors import ConfigError
from ..output.atomic import write_text
from . import registry
from .slots import slots
from .typed_json import Missing, from_json, to_json

if TYPE_CHECKING:
    from ..config import TrainConfig

__all__ = ["Missing", "from_json", "load_config", "packages_of", "read_json", "save_config", "to_json"]

_FORMAT = 1
_KEYS = ("format", "fprf", "method", "plugins", "config")


def save_config(path: Path, config: "TrainConfig", method: str) -> None:
    """Write the config, synced and then renamed into place, so that a reader finds the old file or the new one."""
    whole = {
        "format": _FORMAT,
        "fprf": __version__,
        "method": method,
        "plugins": packages_of(config),
        "config": to_json(config),
    }
    text = json.dumps(whole, indent=1, allow_nan=False) + "\n"
    write_text(path, text)


def load_config(path: Path) -> "tuple[TrainConfig, str]":
    """The config of a file and the name of its method. Raises ConfigError naming the file and the field."""
    from ..config import TrainConfig  # the knob tree is made of plug-in configs, which lie above this module

    whole = read_json(path)
    try:
        _check(whole)
        return from_json(whole["config"], TrainConfig, packages=whole["plugins"]), whole["method"]
    except ConfigError as fault:
        raise ConfigError(f"{path}: {fault}") from fault


def packages_of(config: object) -> dict[str, str]:
    """Name, package and version of what fills every slot, by dotted path."""
    found = {}
    for slot in slots(config):
        if isinstance(slot.value, Missing):
            found[slot.path] = f"{slot.value.name} {slot.value.package}".strip()
        elif slot.value is not None:
            name = registry.name_of(slot.kind.group, type(slot.value))
            found[slot.path] = f"{name} {registry.entry(slot.kind.group, name).package}"
    return found


def read_json(path: Path, name: str = "a config.json") -> Any:
    """Strict JSON: no duplicate keys, no NaN, no numbers beyond float64.

    Raises ConfigError, which asks for `name` where there is no such file.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as fault:
        raise ConfigError(f"{path}: cannot be read ({fault.strerror or fault}); name {name}") from fault
    except UnicodeDecodeError as fault:
        raise ConfigError(f"{path}: is not UTF-8 text ({fault.reason} at byte {fault.start})") from fault
    try:
        return json.loads(text, object_pairs_hook=_unique, parse_constant=_not_json, parse_float=_number)
    except ConfigError as fault:
        raise ConfigError(f"{path}: {fault}") from fault
    except json.JSONDecodeError as fault:
        raise ConfigError(f"{path}: is not JSON: line {fault.lineno}, column {fault.colno}: {fault.msg}") from fault
    except (ValueError, RecursionError) as fault:  # a number of thousands of digits; a thousand nested brackets
        raise ConfigError(f"{path}: is not a config: {fault}") from fault


def _check(whole: Any) -> None:
    if not isinstance(whole, dict) or "format" not in whole:
        raise ConfigError('expected an object with "format": 1, as `fprf train` writes it')
    if whole["format"] != _FORMAT or type(whole["format"]) is not int:
        raise ConfigError(
            f"is of format {whole['format']!r}, written by fprf {whole.get('fprf', '(unknown)')}; "
            f"fprf {__version__} reads format {_FORMAT}: use the version that wrote it"
        )
    for key in _KEYS:
        if key not in whole:
            raise ConfigError(f"{key!r} is absent; the file is damaged or was edited")
    for key in whole:
        if key not in _KEYS:
            raise ConfigError(f"unknown key {key!r}{registry.nearest(key, list(_KEYS))} (allowed: {', '.join(_KEYS)})")
    if not isinstance(whole["method"], str):
        raise ConfigError(f"method: expected a name, found {whole['method']!r}")
    plugins = whole["plugins"]
    if not isinstance(plugins, dict) or not all(isinstance(v, str) for v in plugins.values()):
        raise ConfigError("plugins: expected an object of texts")


def _unique(pairs: list[tuple[str, Any]]) -> Mapping[str, Any]:
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found:
            raise ConfigError(f"the key {key!r} stands twice in one object")
        found[key] = value
    return found


def _number(text: str) -> float:
    # Of a plug-in that is not installed nothing is known: its numbers are kept as they are, and must be written again.
    value = float(text)
    if not math.isfinite(value):
        raise ConfigError(f"{text} is beyond the largest number of float64, 1.8e308")
    return value


def _not_json(constant: str) -> NoReturn:
    raise ConfigError(f"{constant} is not a number that JSON knows")
