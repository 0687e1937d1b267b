"""D_VGG of the paper: content features to colour by a two-layer network, point by point.

D_VGG with a colour head of the scene's own, whose share of a colour fades out as a style changes that colour.

In logits: colour = D(content) + head(content), restyled = D(styled) + w head(content). The head learns what the scene-agnostic
decoder gets wrong about this scene; in another style that no longer holds, and would carry the scene's saturated colours over.
"""

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
    """rgb = sigmoid(W2 relu(W1 f + b1) + b2); centring and scaling of the features are folded into W1 and b1."""

    def __init__(self, channels: int, hidden: int) -> None:
        super().__init__()
        self.first = nn.Linear(channels, hidden)
        self.second = nn.Linear(hidden, 3)

    def forward(self, content: Annotated[Tensor, "N C"]) -> Annotated[Tensor, "N 3"]:
        """sRGB in [0, 1]."""
        maps = (self.first, self.second)
        return torch.sigmoid(dense.network(content, [m.weight for m in maps], [m.bias for m in maps]))

    def hidden(self, content: Annotated[Tensor, "N C"]) -> Annotated[Tensor, "N H"]:
        """The hidden units: of about unit scale for features like those it was trained on."""
        return dense.network(content, [self.first.weight], [self.first.bias], last="relu")

    def logit(self, hidden: Annotated[Tensor, "N H"]) -> Annotated[Tensor, "N 3"]:
        """The colour that hidden units give, before its sigmoid."""
        return dense.network(hidden, [self.second.weight], [self.second.bias])

    def restyled(
        self,
        content: Annotated[Tensor, "N C"],
        styled: Annotated[Tensor, "N C"],
        strength: float | Annotated[Tensor, "N 1"],
    ) -> Annotated[Tensor, "N 3"]:
        """The decoded style: there is nothing of the scene's own to be kept."""
        colour: Tensor = self(styled)
        return colour

    def frozen_colour(self, content: Annotated[Tensor, "N C"]) -> None:
        """None: it has no parameters of a scene."""


def load_decoder(path: Path | None, *, encoder: str, channels: int, objective: Objective = "identity") -> MlpDecoder:
    """The frozen decoder of that encoder: from a file, or the shipped one that names it and its objective.

    Raises WeightsError where the file belongs to another encoder, or none that ships belongs to this one.
    """
    if path is not None:
        return _loaded(path, *_read(path), encoder=encoder, channels=channels)
    shipped = set()
    for file in sorted(FOLDER.glob("*.safetensors")):
        tensors, metadata = _read(file)
        if metadata["encoder"] == encoder and metadata.get("objective", "identity") == objective:
            return _loaded(file, tensors, metadata, encoder=encoder, channels=channels)
        shipped.add(metadata["encoder"])
    raise WeightsError(f"no decoder ships for the encoder {encoder}; there are those of {', '.join(sorted(shipped)) or 'none'}")


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
            "choose that encoder, or the decoder of this one"
        )
    decoder = MlpDecoder(int(inputs), int(hidden))
    decoder.load_state_dict(tensors)
    decoder.eval()
    decoder.requires_grad_(False)
    return decoder


def residual_share(
    change: Annotated[Tensor, "N 3"], strength: float | Annotated[Tensor, "N 1"], fade: float
) -> Annotated[Tensor, "N 1"]:
    """Share of the residual that a restyled colour keeps: 1 - strength (1 - g), with g = exp(-mean(change^2) / fade^2).

    1 without a change or at strength 0, exactly; at full strength 1/e where the decoded logits change by `fade` (root mean
    square over the channels), and soon nothing.
    """
    return 1 + strength * torch.expm1(-change.square().mean(-1, keepdim=True) / fade**2)


class ColourHead(nn.Module):
    """One hidden layer on the decoder's hidden units, which are of unit scale for any encoder. Starts at exactly 0.

    Weights are kept times the root of their fan-in. Adam moves each by the learning rate, whatever its size: at the rate
    that planes need, plain weights move a logit by half a unit in one step, and on a red flower the head ran off and died
    (20.4 -> 16.2 dB after 400 steps).
    """

    def __init__(self, inputs: int, hidden: int, generator: torch.Generator) -> None:
        super().__init__()
        bound = 6**0.5
        self.first = nn.Parameter(torch.empty(hidden, inputs).uniform_(-bound, bound, generator=generator))
        self.first_bias = nn.Parameter(torch.zeros(hidden))
        self.second = nn.Parameter(torch.zeros(3, hidden))
        self.second_bias = nn.Parameter(torch.zeros(3))

    def forward(self, hidden: Annotated[Tensor, "N I"]) -> Annotated[Tensor, "N 3"]:
        """Logits to be added."""
        maps = [weight / weight.shape[1] ** 0.5 for weight in (self.first, self.second)]
        return dense.network(hidden, maps, [self.first_bias, self.second_bias])


class ResidualDecoder(Decoder):
    """A frozen `MlpDecoder` and a `ColourHead` that is trained with the scene."""

    def __init__(self, frozen: MlpDecoder, *, hidden: int, fade: float, generator: torch.Generator) -> None:
        super().__init__()
        self.frozen = frozen
        self.head = ColourHead(frozen.first.out_features, hidden, generator)
        self._fade = fade

    def forward(self, content: Annotated[Tensor, "N C"]) -> Annotated[Tensor, "N 3"]:
        """sigmoid(D + head), in [0, 1]."""
        hidden = self.frozen.hidden(content)
        return torch.sigmoid(self.frozen.logit(hidden) + self.head(hidden))

    def restyled(
        self,
        content: Annotated[Tensor, "N C"],
        styled: Annotated[Tensor, "N C"],
        strength: float | Annotated[Tensor, "N 1"],
    ) -> Annotated[Tensor, "N 3"]:
        """sigmoid(D(styled) + w head(content)), w by `residual_share`."""
        hidden = self.frozen.hidden(content)
        logit = self.frozen.logit(self.frozen.hidden(styled))
        share = residual_share(logit - self.frozen.logit(hidden), strength, self._fade)
        return torch.sigmoid(logit + share * self.head(hidden))

    def frozen_colour(self, content: Annotated[Tensor, "N C"]) -> Annotated[Tensor, "N 3"]:
        """sigmoid(D)."""
        colour: Tensor = self.frozen(content)
        return colour
