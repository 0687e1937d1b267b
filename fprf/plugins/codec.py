"""`config.json`: a config with its method, the version that wrote it and the packages of its plug-ins.

Strict: duplicate keys, NaN, unknown keys and foreign formats are refused. Written whole or not at all.

A method returns a `RunConfig`, of fprf or of its own: a file is read as the class that its method returns, so a method whose
config has fields of its own must be installed.
"""

import json
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import ConfigError, FprfError, PluginError
from ..io.atomic import write_text
from ..io.strict_json import parse_json
from . import registry
from .slots import slots
from .typed_json import Missing as Missing
from .typed_json import from_json as from_json
from .typed_json import to_json as to_json

if TYPE_CHECKING:
    from ..config import RunConfig

_METHODS = "fprf.methods"

_FORMAT, _VERSION = 1, version("fprf")
_KEYS = ("format", "fprf", "method", "plugins", "config")


def save_config(path: Path, config: "RunConfig", method: str) -> None:
    """Write the config, synced and then renamed into place, so that a reader finds the old file or the new one.

    Raises ConfigError where the config has fields of its own and `method` would not give them back.
    """
    from ..config import TrainConfig  # the knob tree is made of plug-in configs, which lie above this module

    packages = packages_of(config)
    if type(config) is not TrainConfig:
        if type(method_config(method)) is not type(config):
            raise ConfigError(f"method {method!r} gives no {type(config).__name__}, so its fields could not be read again")
        packages["method"] = registry.entry(_METHODS, method).package
    whole = {"format": _FORMAT, "fprf": _VERSION, "method": method, "plugins": packages, "config": to_json(config)}
    write_text(path, json.dumps(whole, indent=1, allow_nan=False) + "\n")


def load_config(path: Path) -> "tuple[RunConfig, str]":
    """The config of a file and the name of its method.

    Raises ConfigError naming the file and the field, PluginError where the method is needed and not installed.
    """
    from ..config import TrainConfig

    whole = read_json(path)
    try:
        _check(whole)
        fields, method, packages = whole["config"], whole["method"], whole["plugins"]
        try:
            kind = type(method_config(method))
        except PluginError as fault:  # not installed, or broken
            # Only a method whose package is on record had fields of its own.
            if "method" in packages:
                raise PluginError(f"{path}: {fault}; install {packages['method']}") from fault
            kind = TrainConfig
        return from_json(fields, kind, packages=packages), method
    except ConfigError as fault:
        raise ConfigError(f"{path}: {fault}") from fault


def method_config(name: str) -> "RunConfig":
    """The config that an installed method returns. Raises PluginError naming the method and its package."""
    from ..config import RunConfig

    method = registry.load_object(_METHODS, name)
    origin = registry.entry(_METHODS, name).origin
    try:
        config = method() if callable(method) else method
    except FprfError as fault:
        raise PluginError(f"{_METHODS}: {name!r} ({origin}): {fault}") from fault
    except (Exception, SystemExit) as fault:  # a stranger's function
        raise PluginError(f"{_METHODS}: {name!r} ({origin}) failed: {type(fault).__name__}: {fault}") from fault
    if not isinstance(config, RunConfig):
        raise PluginError(f"{_METHODS}: {name!r} ({origin}) gives {type(config).__name__}, not a RunConfig")
    return config


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


def _check(whole: Any) -> None:
    # The format first: what another one holds is not ours to judge.
    if not isinstance(whole, dict) or "format" not in whole:
        raise ConfigError('expected an object with "format": 1, as `fprf train` writes it')
    if whole["format"] != _FORMAT or type(whole["format"]) is not int:
        raise ConfigError(
            f"is of format {whole['format']!r}, written by fprf {whole.get('fprf', '(unknown)')}; "
            f"fprf {_VERSION} reads format {_FORMAT}: use the version that wrote it"
        )
    for key in _KEYS:
        if key not in whole:
            raise ConfigError(f"{key!r} is absent; the file is damaged or was edited")
    for key in whole:
        if key not in _KEYS:
            raise ConfigError(f"unknown key {key!r}{registry.nearest(key, list(_KEYS))} (allowed: {', '.join(_KEYS)})")
    # What is read before the config itself.
    if not isinstance(whole["method"], str):
        raise ConfigError(f"method: expected a name, found {whole['method']!r}")
    plugins = whole["plugins"]
    if not isinstance(plugins, dict) or not all(isinstance(v, str) for v in plugins.values()):
        raise ConfigError("plugins: expected an object of texts")
