"""D_VGG with a colour head of the scene's own, whose share of a colour fades out as a style changes that colour.

In logits: colour = D(content) + head(content), restyled = D(styled) + w head(content). The head learns what the scene-agnostic
decoder gets wrong about this scene; in another style that no longer holds, and would carry the scene's saturated colours over.
"""

from typing import Annotated

import torch
from torch import Tensor, nn

from ...interfaces import Decoder
from ...ops import dense
from .mlp import MlpDecoder

__all__ = ["ColourHead", "ResidualDecoder", "residual_share"]


def residual_share(
    change: Annotated[Tensor, "N 3"], strength: float | Annotated[Tensor, "N 1"], fade: float
) -> Annotated[Tensor, "N 1"]:
    """How much of the residual a restyled colour keeps: 1 - strength (1 - g), with g = exp(-mean(change^2) / fade^2).

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

    def unaided(self, content: Annotated[Tensor, "N C"]) -> Annotated[Tensor, "N 3"]:
        """sigmoid(D)."""
        colour: Tensor = self.frozen(content)
        return colour
