"""Light where a reference shows the very place (`placing`): measured point by point, not carried over from
things of the same kind.

Letters: N points or pairs, D semantic channels, K regions of the scene, R references that show the place.
Colours are sRGB in [0, 1].

Logarithms of the gains of all pairs of colours, channel by channel, are regressed on what tells points apart,
their direction u in semantics and their membership m in regions,

    g(u, m)  =  exp(W u + V m + b),        c'  =  (c + o) g - o

A region has a gain, and within it façades differ from roofs. It needs no statistics of regions, so that nothing
else that a region holds shows in it, and extends to what the photograph does not show. It is affine in the
colour c. Regions take it as far as pairs lie in them; the rest stays as matching would have it.
"""

from typing import Annotated, NamedTuple

import torch
from torch import Tensor, nn

from ..ops.backend import double
from .dictionary import StyleDictionary
from .light import BLACK_OFFSET
from .matching import unit
from .placing import Pairs
from .scene_style import Membership, SceneStyle

_RIDGE = 0.003
"""Weight of the squared coefficients beside the mean squared error of a logarithm."""
_APPLIED = 0.85
"""Share of a look that is measured where pairs are many: the rest is matched, and errs elsewhere."""
_MIN_SURE_PAIRS = 2.0
"""Pairs in a region with which it takes half of that."""
_MIN_LOG_GAIN = -4.0
"""Least logarithm of a gain: a night is a fiftieth as bright as a white sky."""
_MAX_LOG_GAIN = 1.5
"""Largest logarithm of a gain, 4.5 times: above, the noise of dark places shows. By eye."""


class Measured(NamedTuple):
    """Measured light of points: c' = c + (1 - share) (change by the rest of the look) + excess (c + o)."""

    share: Annotated[Tensor, "N 1"]
    """Part of the look that is measured, in [0, 1]."""
    excess: Annotated[Tensor, "N 3"]
    """Gains less 1, by the shares of the references."""

    def change(self, colour: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N 3"]:
        """Change to add to the scene's own colours."""
        return self.excess * (colour + BLACK_OFFSET)

    @property
    def maps(self) -> Annotated[Tensor, "N 4 3"]:
        """`change` as A and below it b, c' = c + c A + b."""
        return torch.cat([torch.diag_embed(self.excess), BLACK_OFFSET * self.excess[:, None]], 1)


class PlacedLight(nn.Module):
    """Gains of points by the light that references show at the very place."""

    gains: Annotated[Tensor, "R D+K+1 3"]
    """Coefficients of logarithms of gains: W, V and b."""
    trust: Annotated[Tensor, "K R"]
    """Share of each reference's gains that a region takes; rows sum to 1 at most."""

    def __init__(
        self,
        scene: SceneStyle,
        gains: Annotated[Tensor, "R D+K+1 3"],
        trust: Annotated[Tensor, "K R"],
    ) -> None:
        super().__init__()
        self.membership = Membership(scene.keys, scene.semantic_mean)
        self.register_buffer("gains", gains.float())
        self.register_buffer("trust", trust.float())

    def forward(
        self, semantic: Annotated[Tensor, "N D"], belongs: Annotated[Tensor, "N K"] | None = None
    ) -> Measured:
        """Shares and gains; `belongs` is the points' membership, where it is known."""
        semantic = semantic.to(self.gains)
        belongs = self.membership(semantic) if belongs is None else belongs.to(self.gains)
        what = _described(semantic, belongs, self.membership.centre)
        trust = belongs @ self.trust
        excess = semantic.new_zeros(len(semantic), 3)
        for r, coefficients in enumerate(self.gains):
            logarithm = (what @ coefficients).clamp(_MIN_LOG_GAIN, _MAX_LOG_GAIN)
            excess = excess + trust[:, r, None] * torch.expm1(logarithm)
        return Measured(trust.sum(1, keepdim=True), excess)


def _described(
    semantic: Annotated[Tensor, "N D"], belongs: Annotated[Tensor, "N K"], centre: Annotated[Tensor, "D"]
) -> Annotated[Tensor, "N D+K+1"]:
    """Direction u, membership m, and 1."""
    return torch.cat([unit(semantic, centre), belongs, torch.ones_like(semantic[:, :1])], 1)


def fit_gains(
    own: Annotated[Tensor, "N 3"], shown: Annotated[Tensor, "N 3"], what: Annotated[Tensor, "N X"]
) -> Annotated[Tensor, "X 3"]:
    """Coefficients of the logarithms of gains from `own` to `shown` on `what`, by weighted ridge regression,
    float64.

    Pairs count by how bright they are: what is black in the scene has no gain to speak of.
    """
    own = double(own)
    what = double(what)
    gain = ((double(shown) + BLACK_OFFSET) / (own + BLACK_OFFSET)).log()
    weight = own.mean(1, keepdim=True) + BLACK_OFFSET
    weight = weight / weight.sum()
    normal = what.T @ (weight * what) + _RIDGE * torch.eye(what.shape[1]).to(what)
    solved: Tensor = torch.linalg.solve(normal, what.T @ (weight * gain))
    return solved


def placed_light(
    scene: SceneStyle, dictionary: StyleDictionary, allowed: Annotated[Tensor, "K references"]
) -> PlacedLight | None:
    """The light of those references that show the very place; None where none does.

    A region takes of each by its weight among all that it may take from (`allowed`, bool).
    """
    weights = []
    for i in range(len(dictionary.names)):
        weights.append(float(dictionary.weight[dictionary.reference == i][0]))
    odds = allowed.cpu().double() * torch.tensor(weights, dtype=torch.float64)
    odds = odds / odds.sum(1, keepdim=True).clamp_min(1e-12)
    membership = Membership(scene.keys, scene.semantic_mean)
    gains = []
    trust = []
    for i, pairs in enumerate(dictionary.placed):
        if pairs is not None:
            belongs = membership(pairs.semantic)
            what = _described(pairs.semantic.to(belongs), belongs, membership.centre)
            gains.append(fit_gains(pairs.own, pairs.shown, what))
            trust.append(_APPLIED * odds[:, i] * _support(pairs, belongs))
    if not gains:
        return None
    return PlacedLight(scene, torch.stack(gains), torch.stack(trust, 1))


def _support(pairs: Pairs, belongs: Annotated[Tensor, "N K"]) -> Annotated[Tensor, "K"]:
    """Trust in each region by the number of its pairs, in [0, 1), float64."""
    count = double(belongs).sum(0)
    return count / (count + _MIN_SURE_PAIRS)
