"""Decoder configs, and the command line that trains the decoder of an encoder. `build` imports the implementation."""

from __future__ import annotations

import dataclasses
import json
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from ..config import Need, PluginConfig, absent_file
from ..encoders.config import EncoderConfig
from ..registry import name_of
from ..slots import hints_of, is_slot, members
from ..typed_json import Missing

if TYPE_CHECKING:
    from ...interfaces import Decoder


Objective = Literal["identity", "paper"]
"""Training objective of a decoder: returning photographs alone, or the paper's content and style losses as well."""


@dataclass(frozen=True, kw_only=True)
class DecoderConfig(PluginConfig):
    """Turns content features into colour, point by point."""

    group: ClassVar[str] = "fprf.decoders"

    def build(self, *, encoder: str, channels: int, seed: int = 0) -> Decoder:
        """The decoder of that encoder (its `identity`). What a scene adds starts from the seed; the rest comes frozen.

        Raises WeightsError where none fits.
        """
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class MlpDecoderConfig(DecoderConfig):
    """D_VGG of the paper: a small network, trained once on photographs, frozen ever after."""

    weights: Path | None = None
    """A decoder made by `fprf pretrain decoder`. By default one that ships for the chosen encoder."""
    objective: Objective = "identity"
    """Objective that the shipped decoder was trained with: returning photographs alone, or the paper's content and style losses
    (L_c + lambda L_s) as well. Not used where `weights` names a file."""

    def needs(self) -> tuple[Need, ...]:
        """The file, where one is named; whether it fits the encoder is found when it is read."""
        return absent_file(self.weights)

    def build(self, *, encoder: str, channels: int, seed: int = 0) -> Decoder:
        from .decoders import load_decoder

        return load_decoder(self.weights, encoder=encoder, channels=channels, objective=self.objective)


def pretrain_line(encoder: EncoderConfig | Missing, output: Path = Path("decoder.safetensors")) -> str:
    """`fprf pretrain decoder ...` with the encoder's name and every field that is not its default, quoted for a shell.

    DIR stands for folders of photographs, which nobody else can know.
    """
    flags = _chosen(encoder, EncoderConfig.group, "--encoder")
    return f"fprf pretrain decoder {shlex.join(flags)} --images DIR --output {shlex.quote(str(output))}"


def _chosen(config: PluginConfig, group: str, path: str) -> list[str]:
    if isinstance(config, Missing):
        plain = {name: value for name, value in json.loads(config.data).items() if not isinstance(value, dict)}
        words = [word for name, value in plain.items() for word in _spelled(f"{path}.{name.replace('_', '-')}", value)]
        return [path, config.name, *words]
    # Fields that differ from the defaults; a slot brings the fields of what fills it.
    kind = type(config)
    default, hints = kind(), hints_of(kind)
    flags = [path, name_of(group, kind)]
    for field in dataclasses.fields(config):
        value, flag = getattr(config, field.name), f"{path}.{field.name.replace('_', '-')}"
        slot = next(filter(is_slot, members(hints[field.name])), None)
        if value == getattr(default, field.name):
            continue
        if slot is not None and value is not None:
            flags += _chosen(value, slot.group, flag)
        else:
            flags += _spelled(flag, value)
    return flags


def _spelled(flag: str, value: Any) -> list[str]:
    if isinstance(value, bool):
        head, _, name = flag.rpartition(".")
        return [flag if value else f"{head}.no-{name}"]
    if value is None:
        return [flag, "none"]
    if isinstance(value, tuple | list):
        return [flag, *map(str, value)]
    return [flag, str(value)]
