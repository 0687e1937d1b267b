"""Configs of runs as files, and by the names of methods.

`config.json` holds a config with its method, the version that wrote it and the packages of its plug-ins.
Duplicate keys, NaN, unknown keys and foreign formats are refused. A file is read as the class of config that
its method returns, so a method whose config has fields of its own must be installed. A method is looked up
among the entry points: nothing here knows any kind of scene.
"""

import json
from importlib.metadata import version
from pathlib import Path

import msgspec

from .errors import ConfigError, FprfError, PluginError
from .io.atomic import write_text
from .plugins import registry
from .plugins.codec import from_json, packages_of, read_json, to_json
from .run_config import RunConfig

_METHODS = "fprf.methods"
"""Entry points of methods: functions that return a whole config."""
_PLAIN_KIND = "fields"
"""Kind of scene whose methods may come from a package that is not there any more: they have no fields of their
own.
"""
_PLAIN_METHOD = "fprf"
"""A method of that kind that is always installed: its class of config reads their files."""
_CONFIG_FORMAT = 1
"""Version of config.json."""
_VERSION = version("fprf")
"""Version of fprf that writes it."""


class _ConfigFile(msgspec.Struct, forbid_unknown_fields=True):
    """Content of config.json."""

    format: int
    fprf: str
    """Version that wrote it."""
    method: str
    plugins: dict[str, str]
    """Name, package and version of what fills each slot."""
    config: object
    schema: str = msgspec.field(name="$schema", default="")
    """Address of its schema, for editors."""


def save_config(path: Path, config: RunConfig, method: str) -> None:
    """Write the config, synced and then renamed into place, so that a reader finds the old file or the new
    one.

    Raises ConfigError where the config has fields of its own and `method` would not give them back.
    """
    packages = packages_of(config)
    if not _is_plain(config):
        if type(method_config(method)) is not type(config):
            raise ConfigError(
                f"method {method!r} gives no {type(config).__name__}, so its fields could not be read again"
            )
        packages["method"] = registry.entry(_METHODS, method).package
    whole = {
        "format": _CONFIG_FORMAT,
        "fprf": _VERSION,
        "method": method,
        "plugins": packages,
        "config": to_json(config),
    }
    write_text(path, json.dumps(whole, indent=1, allow_nan=False) + "\n")


def _is_plain(config: RunConfig) -> bool:
    """True for a config without fields beyond those of the plain kind: any version of fprf can read it."""
    return config.kind == _PLAIN_KIND and type(config) is type(method_config(_PLAIN_METHOD))


def load_config(path: Path) -> tuple[RunConfig, str]:
    """The config of a file and the name of its method.

    Raises ConfigError naming the file and the field, PluginError where the method is needed and not
    installed.
    """
    whole = read_json(path)
    try:
        # The format first: what another one holds is not ours to judge.
        if not isinstance(whole, dict) or "format" not in whole:
            raise ConfigError('expected an object with "format": 1, as `fprf train` writes it')
        if whole["format"] != _CONFIG_FORMAT or type(whole["format"]) is not int:
            raise ConfigError(
                f"is of format {whole['format']!r}, written by fprf {whole.get('fprf', '(unknown)')}; "
                f"fprf {_VERSION} reads format {_CONFIG_FORMAT}: use the version that wrote it"
            )
        file = msgspec.convert(whole, _ConfigFile)
        try:
            kind = type(method_config(file.method))
        except PluginError as fault:  # not installed, or broken
            # Only a method whose package is on record had fields of its own.
            if "method" in file.plugins:
                raise PluginError(f"{path}: {fault}; install {file.plugins['method']}") from fault
            kind = type(method_config(_PLAIN_METHOD))
        return from_json(file.config, kind, packages=file.plugins), file.method
    except msgspec.ValidationError as fault:
        raise ConfigError(f"{path}: {fault}; the file is damaged or was edited") from fault
    except ConfigError as fault:
        raise ConfigError(f"{path}: {fault}") from fault


def method_config(name: str) -> RunConfig:
    """The config that an installed method returns. Raises PluginError naming the method and its package."""
    method = registry.load_object(_METHODS, name)
    origin = registry.entry(_METHODS, name).origin
    try:
        config = method() if callable(method) else method
    except FprfError as fault:
        raise PluginError(f"{_METHODS}: {name!r} ({origin}): {fault}") from fault
    except (Exception, SystemExit) as fault:  # a stranger's function
        raise PluginError(
            f"{_METHODS}: {name!r} ({origin}) failed: {type(fault).__name__}: {fault}"
        ) from fault
    if not isinstance(config, RunConfig):
        raise PluginError(f"{_METHODS}: {name!r} ({origin}) gives {type(config).__name__}, not a RunConfig")
    return config
