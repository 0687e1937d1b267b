"""Decoder configs, and the command line that trains the decoder of an encoder. `build` imports the
implementation.
"""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

from ..codec import Missing, leaves
from ..config import Need, PluginConfig, absent_file
from ..encoders.config import EncoderConfig
from ..registry import name_of

if TYPE_CHECKING:
    from ...interfaces import Decoder


Objective = Literal["identity", "paper"]
"""Training objective of a decoder: returning photographs alone, or the paper's content and style losses as
well.
"""


@dataclass(frozen=True, kw_only=True)
class DecoderConfig(PluginConfig):
    """Turns content features into colour, point by point."""

    group: ClassVar[str] = "fprf.decoders"

    def build(self, *, encoder: str, channels: int, seed: int = 0) -> Decoder:
        """The decoder of that encoder (its `identity`). What a scene adds starts from the seed; the rest
        comes frozen.

        Raises WeightsError where none fits.
        """
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class MlpDecoderConfig(DecoderConfig):
    """D_VGG of the paper: a small network, trained once on photographs, frozen ever after."""

    weights: Path | None = None
    """A decoder made by `fprf pretrain decoder`. By default one that ships for the chosen encoder."""
    objective: Objective = "identity"
    """Objective that the shipped decoder was trained with: returning photographs alone, or the paper's
    content and style losses (L_c + lambda L_s) as well. Not used where `weights` names a file.
    """

    def needs(self) -> tuple[Need, ...]:
        """The file, where one is named; whether it fits the encoder is found when it is read."""
        return absent_file(self.weights)

    def build(self, *, encoder: str, channels: int, seed: int = 0) -> Decoder:
        from .decoders import load_decoder

        return load_decoder(self.weights, encoder=encoder, channels=channels, objective=self.objective)


def pretrain_line(encoder: EncoderConfig | Missing, output: Path = Path("decoder.safetensors")) -> str:
    """`fprf pretrain decoder ...` with the encoder's name and every field that is not its default, quoted for
    a shell.

    DIR stands for folders of photographs, which nobody else can know.
    """
    # A slot's path names what fills it; where that is not the default's plug-in, all of its fields are
    # written.
    own = leaves(encoder)
    if isinstance(encoder, Missing):
        default = {}
    else:
        default = leaves(type(encoder)())
    name = own.pop("", None) or name_of(EncoderConfig.group, type(encoder))
    words = ["fprf", "pretrain", "decoder", "--encoder", name]
    written = tuple[str, ...]()
    for path, value in own.items():
        if path in default and default[path] == value and not path.startswith(written):
            continue
        written += (f"{path}.",)
        head, _, field = f"--encoder.{path.replace('_', '-')}".rpartition(".")
        if isinstance(value, bool):
            words.append(f"{head}.{'' if value else 'no-'}{field}")
        else:
            words += [
                f"{head}.{field}",
                *map(str, value if isinstance(value, list) else ["none" if value is None else value]),
            ]
    return f"{shlex.join(words)} --images DIR --output {shlex.quote(str(output))}"
