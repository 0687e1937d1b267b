"""D_VGG of the paper: content features to colour by a two-layer network, point by point."""

from pathlib import Path
from typing import Annotated

import torch
from torch import Tensor, nn

from ...errors import WeightsError
from ...interfaces import Decoder
from ...ops import dense
from ..weights import read_weights
from .config import Objective

DECODER_KIND = "mlp-decoder"
FOLDER = Path(__file__).parent / "weights"
NAMES = ("first.weight", "first.bias", "second.weight", "second.bias")


class MlpDecoder(Decoder):
    """rgb = sigmoid(W2 relu(W1 f + b1) + b2); centring and scaling of the features are folded into W1 and
    b1.
    """

    def __init__(self, channels: int, hidden: int) -> None:
        super().__init__()
        self.first = nn.Linear(channels, hidden)
        self.second = nn.Linear(hidden, 3)

    def forward(self, content: Annotated[Tensor, "N C"]) -> Annotated[Tensor, "N 3"]:
        """sRGB in [0, 1]."""
        maps = self.layers
        return torch.sigmoid(dense.network(content, [w for w, _ in maps], [b for _, b in maps]))

    @property
    def layers(self) -> tuple[tuple[Tensor, Tensor], ...]:
        return (self.first.weight, self.first.bias), (self.second.weight, self.second.bias)


def load_decoder(
    path: Path | None, *, encoder: str, channels: int, objective: Objective = "identity"
) -> MlpDecoder:
    """The frozen decoder of that encoder: from a file, or the shipped one that names it and its objective.

    Raises WeightsError where the file belongs to another encoder, or none that ships belongs to this one.
    """
    if path is not None:
        return _loaded(path, *_read(path), encoder=encoder, channels=channels)
    # The one that ships for this encoder and objective.
    shipped = set()
    for file in sorted(FOLDER.glob("*.safetensors")):
        tensors, metadata = _read(file)
        if metadata["encoder"] == encoder and metadata.get("objective", "identity") == objective:
            return _loaded(file, tensors, metadata, encoder=encoder, channels=channels)
        shipped.add(metadata["encoder"])
    raise WeightsError(
        f"no decoder ships for the encoder {encoder}; there are those of {', '.join(sorted(shipped)) or 'none'}"
    )


def _read(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    tensors, metadata = read_weights(path)
    if metadata.get("kind") != DECODER_KIND or "encoder" not in metadata or set(tensors) != set(NAMES):
        raise WeightsError(
            f"{path}: no decoder of `fprf pretrain decoder`; name one, or leave the weights out"
        )
    return tensors, metadata


def _loaded(
    path: Path, tensors: dict[str, Tensor], metadata: dict[str, str], *, encoder: str, channels: int
) -> MlpDecoder:
    # Its first layer says how many features it takes.
    hidden, inputs = tensors["first.weight"].shape
    if metadata["encoder"] != encoder or inputs != channels:
        raise WeightsError(
            f"{path}: decodes {inputs} channels of {metadata['encoder']}, but the encoder is {encoder} with {channels}; "
            "choose that encoder, or the decoder of this one"
        )
    decoder = MlpDecoder(int(inputs), int(hidden))
    decoder.load_state_dict(tensors)
    decoder.eval()
    decoder.requires_grad_(False)
    return decoder
