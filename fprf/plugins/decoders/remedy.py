"""The command line that makes the decoder of an encoder: what somebody whose pair does not fit should type."""

import dataclasses
import json
import shlex
from pathlib import Path
from typing import Any

from ..config import PluginConfig
from ..encoders.config import EncoderConfig
from ..registry import name_of
from ..slots import hints_of, is_slot, members
from ..typed_json import Missing

__all__ = ["pretrain_line"]


def pretrain_line(encoder: EncoderConfig | Missing, output: Path = Path("decoder.safetensors")) -> str:
    """`fprf pretrain decoder ...` with the encoder's name and every field that is not its default, quoted for a shell.

    DIR stands for folders of photographs, which nobody else can know.
    """
    flags = _chosen(encoder, EncoderConfig.group, "--encoder")
    return f"fprf pretrain decoder {shlex.join(flags)} --images DIR --output {shlex.quote(str(output))}"


def _chosen(config: PluginConfig, group: str, path: str) -> list[str]:
    if isinstance(config, Missing):
        return [path, config.name, *_unread(json.loads(config.data), path)]
    kind = type(config)
    plain, hints = kind(), hints_of(kind)
    flags = [path, name_of(group, kind)]
    for field in dataclasses.fields(config):
        value, flag = getattr(config, field.name), f"{path}.{field.name.replace('_', '-')}"
        slot = next(filter(is_slot, members(hints[field.name])), None)
        if value == getattr(plain, field.name):
            continue
        if slot is not None and value is not None:
            flags += _chosen(value, slot.group, flag)
        else:
            flags += _spelled(flag, value)
    return flags


def _unread(data: dict[str, Any], path: str) -> list[str]:
    """The fields of a plug-in that is not installed here, as far as they are plain."""
    plain = {name: value for name, value in data.items() if not isinstance(value, dict)}
    return [word for name, value in plain.items() for word in _spelled(f"{path}.{name.replace('_', '-')}", value)]


def _spelled(flag: str, value: Any) -> list[str]:
    if isinstance(value, bool):
        head, _, name = flag.rpartition(".")
        return [flag if value else f"{head}.no-{name}"]
    if value is None:
        return [flag, "none"]
    if isinstance(value, tuple | list):
        return [flag, *map(str, value)]
    return [flag, str(value)]
