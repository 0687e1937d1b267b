"""D_VGG of the paper: content features to colour by a two-layer network, point by point."""

from pathlib import Path
from typing import Annotated

import torch
from torch import Tensor, nn

from ...errors import WeightsError
from ...interfaces import Decoder
from ..weightfiles import read_weights

__all__ = ["DECODER_KIND", "MlpDecoder", "load_decoder", "pretrain_line"]

DECODER_KIND = "mlp-decoder"
FOLDER = Path(__file__).parent / "weights"
NAMES = ("first.weight", "first.bias", "second.weight", "second.bias")


class MlpDecoder(Decoder):
    """rgb = sigmoid(W2 relu(W1 f + b1) + b2); centring and scaling of the features are folded into W1 and b1."""

    def __init__(self, channels: int, hidden: int) -> None:
        super().__init__()
        self.first = nn.Linear(channels, hidden)
        self.second = nn.Linear(hidden, 3)

    def forward(self, content: Annotated[Tensor, "N C"]) -> Annotated[Tensor, "N 3"]:
        """sRGB in [0, 1]."""
        return torch.sigmoid(self.second(torch.relu(self.first(content))))


def load_decoder(path: Path | None, *, encoder: str, channels: int) -> MlpDecoder:
    """The frozen decoder of that encoder: from a file, or the shipped one that names it.

    Raises WeightsError where the file belongs to another encoder, or none that ships belongs to this one.
    """
    if path is not None:
        return _loaded(path, *_read(path), encoder=encoder, channels=channels)
    shipped = {}
    for file in sorted(FOLDER.glob("*.safetensors")):
        tensors, metadata = _read(file)
        if metadata["encoder"] == encoder:
            return _loaded(file, tensors, metadata, encoder=encoder, channels=channels)
        shipped[file.stem] = metadata["encoder"]
    raise WeightsError(
        f"no decoder ships for the encoder {encoder} (there are: {', '.join(shipped.values()) or 'none'}); make one with "
        f"`{pretrain_line(encoder)}` and name it with --content.decoder.weights FILE"
    )


def pretrain_line(encoder: str, output: str = "decoder.safetensors") -> str:
    """The command that makes the decoder of an encoder, as far as its identity tells the settings."""
    name, *settings = encoder.split(":")
    flags = f"--encoder {name}"
    if name == "vgg19":
        layer, kind = settings[:2]
        flags += f" --encoder.layer {layer}" + (" --encoder.no-normalise" if kind == "plain" else "")
        flags += " --encoder.weights FILE"
    elif name == "random":
        channels, stride, seed = settings
        flags += f" --encoder.channels {channels}"
        flags += f" --encoder.stride {stride.removeprefix('stride')} --encoder.seed {seed.removeprefix('seed')}"
    elif name in ("dino", "dinov2"):
        model, block, stride = settings[:3]
        flags += f" --encoder.model {model} --encoder.layer {block.removeprefix('block')}"
        flags += f" --encoder.stride {stride.removeprefix('stride')}"
    return f"fprf pretrain decoder {flags} --images DIR --output {output}"


def _read(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    tensors, metadata = read_weights(path)
    if metadata.get("kind") != DECODER_KIND or "encoder" not in metadata or set(tensors) != set(NAMES):
        raise WeightsError(f"{path}: no decoder of `fprf pretrain decoder`; name one, or leave the weights out")
    return tensors, metadata


def _loaded(path: Path, tensors: dict[str, Tensor], metadata: dict[str, str], *, encoder: str, channels: int) -> MlpDecoder:
    hidden, inputs = tensors["first.weight"].shape
    if metadata["encoder"] != encoder or inputs != channels:
        raise WeightsError(
            f"{path}: decodes {inputs} channels of {metadata['encoder']}, but the encoder is {encoder} with {channels}; "
            f"choose that encoder, or make the right decoder with `{pretrain_line(encoder)}`"
        )
    decoder = MlpDecoder(int(inputs), int(hidden))
    decoder.load_state_dict(tensors)
    decoder.eval()
    decoder.requires_grad_(False)
    return decoder
