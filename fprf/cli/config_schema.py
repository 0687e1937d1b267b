"""`fprf config-schema FILE`: the JSON schema of a file that is written by hand, with every plug-in that is installed."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from ..config_files import method_config
from ..io.atomic import write_text
from ..io.overwriting import Origin, OverwriteConfig
from ..plugins.schema import schema_of
from ..style.config import StyleConfig
from ..style.files import Keyframe
from .parsing import parse

_SCHEMA = (str, "Where the schema of this file is: editors complete and check by it.")
_FORMAT = (
    Literal[1],
    "Version of the format.",
)  # _STYLE_FORMAT and _CONFIG_FORMAT of those who write the files
_VERSION = (str, "Version of fprf that wrote it.")
_PLUGINS = (dict[str, str], "Name, package and version of what fills each slot.")


@dataclass(frozen=True, kw_only=True)
class ConfigSchemaConfig(OverwriteConfig):
    """Settings of `fprf config-schema`."""

    file: Literal["config", "style", "keyframes"] = "style"
    """config: the config.json of a run. style: a style.json. keyframes: styles along a camera path."""
    method: str = "fprf-splats"
    """The method whose config.json it is."""
    output: Path | None = None
    """File of the schema; none = it is printed."""


def run(args: list[str]) -> int:
    """Print or write the schema."""
    about = (
        "Print the JSON schema of a file, with every plug-in that is installed. A file that names it under\n"
        '"$schema" is completed and checked by editors; ranges are checked when fprf reads it.'
    )
    config = parse(
        ConfigSchemaConfig(), args, prog="fprf config-schema", description=about, positional=("file",)
    )
    text = json.dumps(schema(config.file, config.method), indent=1)
    if config.output is None:
        print(text)
        return 0
    with Origin(by="config-schema", overwrite=config.overwrite).writing([config.output]):
        write_text(config.output, f"{text}\n")
    return 0


def schema(file: str, method: str = "fprf-splats") -> dict[str, Any]:
    """The schema of a kind of file. Raises PluginError for a method that is not installed."""
    if file == "keyframes":
        keys = (list[Keyframe], "Frames with their styles; between two of them one fades into the other.")
        return schema_of(
            "keyframes.json",
            {"schema": _SCHEMA, "format": _FORMAT, "keyframes": keys},
            ("format", "keyframes"),
        )
    common = {"schema": _SCHEMA, "format": _FORMAT, "fprf": _VERSION, "plugins": _PLUGINS}
    if file == "config":
        name = (str, "Method that the config started from.")
        whole = (type(method_config(method)), "Every field.")
        return schema_of(
            f"config.json of {method}",
            {**common, "method": name, "config": whole},
            ("format", "fprf", "method", "plugins", "config"),
        )
    style = {
        "style": (StyleConfig, "The style: flags of `fprf stylize`."),
        "sha256": (dict[str, str], "Hash of each photograph and mask when the style was saved."),
        "semantic_encoder": (str, "Identity of the encoder that the keys of regions are of."),
        "regions": (
            dict[str, list[float]],
            "Regions by name: their semantics, by which another scene knows them.",
        ),
        "made": (Any, "What was measured; for people to read."),
    }
    return schema_of("style.json", {**common, **style}, ("format", "style"))
