"""Light where a reference shows the very place (`placing`): measured point by point, not carried over from
things of the same kind.

Letters: N points or pairs, D semantic channels, K regions of the scene, R references that show the place.
Colours are sRGB in [0, 1].

Two things are regressed on what tells points apart, their direction u in semantics and their membership m in
regions: logarithms of the gains of all pairs of colours, channel by channel, and the colours shown themselves,

    g(u, m)  =  exp(W u + V m + b),        s(u, m)  =  W' u + V' m + b'
    c'  =  q ((c + o) g - o)  +  (1 - q) s

where q follows the slope of the colours shown on the colours by gain, both less s, over the pairs of a region, in
[0, 1]: 1 where the scene's own colours say what the photograph shows; 0 in a sky, whose clouds are others. Where
views and photograph do not quite lie on each other the slope is small, too, but things keep their contrast: of what
is missing to 1 they take half. Within a region façades differ from roofs. All this
needs no statistics of regions, so that nothing else that a region holds shows in it, and extends to what the
photograph does not show. It is affine in the colour c. Regions take it as far as pairs lie in them; the rest stays
as matching would have it.
"""

from collections.abc import Sequence
from typing import Annotated, NamedTuple

import torch
from torch import Tensor, nn

from ..ops.backend import double
from .dictionary import StyleDictionary
from .light import BLACK_OFFSET, sources
from .matching import unit
from .placing import Pairs
from .scene_style import Membership, SceneStyle

_GAIN_RIDGE = 0.003
"""Weight of the squared coefficients beside the mean squared error of a logarithm."""
_COLOUR_RIDGE = 0.002
"""The same of a colour."""
_THING_CONTRAST = 0.5
"""Share of the contrast that pairs deny things, which these keep nevertheless: with 0 photographs in the wild are
0.4 dB nearer, and their façades look as in a fog; with 1 0.6 dB further.
"""
_APPLIED = 0.85
"""Share of a look that is measured where pairs are many: the rest is matched, and errs elsewhere."""
_MIN_SURE_PAIRS = 2.0
"""Pairs in a region with which it takes half of that; it has so many of average contrast for the slope 1, too."""
_MIN_LOG_GAIN = -4.0
"""Least logarithm of a gain: a night is a fiftieth as bright as a white sky."""
_MAX_LOG_GAIN = 1.5
"""Largest logarithm of a gain, 4.5 times: above, the noise of dark places shows. By eye."""


class Measured(NamedTuple):
    """Measured light of points: c' = c + (1 - share) (change by the rest of the look) + excess c + offset."""

    share: Annotated[Tensor, "N 1"]
    """Part of the look that is measured, in [0, 1]."""
    excess: Annotated[Tensor, "N 3"]
    """Factors of colours less 1, by the shares of the references."""
    offset: Annotated[Tensor, "N 3"]

    def change(self, colour: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N 3"]:
        """Change to add to the scene's own colours."""
        return self.excess * colour + self.offset

    @property
    def maps(self) -> Annotated[Tensor, "N 4 3"]:
        """`change` as A and below it b, c' = c + c A + b."""
        return torch.cat([torch.diag_embed(self.excess), self.offset[:, None]], 1)


class Fit(NamedTuple):
    """Coefficients that pairs of colours at one place give to points described by X numbers."""

    gains: Annotated[Tensor, "X 3"]
    """Coefficients of logarithms of gains: W, V and b."""
    colours: Annotated[Tensor, "X 3"]
    """Coefficients of the colours shown: W', V' and b'."""
    slopes: Annotated[Tensor, "K"]
    """q of each region."""


class PlacedLight(nn.Module):
    """Colours of points by the light that references show at the very place."""

    gains: Annotated[Tensor, "R D+K+1 3"]
    colours: Annotated[Tensor, "R D+K+1 3"]
    slopes: Annotated[Tensor, "K R"]
    trust: Annotated[Tensor, "K R"]
    """Share of each reference's light that a region takes; rows sum to 1 at most."""

    def __init__(self, scene: SceneStyle, fits: Sequence[Fit], trust: Annotated[Tensor, "K R"]) -> None:
        super().__init__()
        self.membership = Membership(scene.keys, scene.semantic_mean)
        self.register_buffer("gains", torch.stack([each.gains for each in fits]).float())
        self.register_buffer("colours", torch.stack([each.colours for each in fits]).float())
        self.register_buffer("slopes", torch.stack([each.slopes for each in fits], 1).float())
        self.register_buffer("trust", trust.float())

    def forward(
        self, semantic: Annotated[Tensor, "N D"], belongs: Annotated[Tensor, "N K"] | None = None
    ) -> Measured:
        """Shares, factors and offsets; `belongs` is the points' membership, where it is known."""
        semantic = semantic.to(self.gains)
        belongs = self.membership(semantic) if belongs is None else belongs.to(self.gains)
        what = _described(semantic, belongs, self.membership.centre)
        trust = belongs @ self.trust
        slopes = belongs @ self.slopes
        excess = semantic.new_zeros(len(semantic), 3)
        offset = semantic.new_zeros(len(semantic), 3)
        for r, (gains, colours) in enumerate(zip(self.gains, self.colours, strict=True)):
            share = trust[:, r, None]
            slope = slopes[:, r, None]
            gain = _gain(what, gains)
            excess = excess + share * (slope * gain - 1)
            shown = (what @ colours).clamp(0, 1)
            offset = offset + share * (slope * BLACK_OFFSET * (gain - 1) + (1 - slope) * shown)
        return Measured(trust.sum(1, keepdim=True), excess, offset)


def _gain(what: Annotated[Tensor, "N X"], gains: Annotated[Tensor, "X 3"]) -> Annotated[Tensor, "N 3"]:
    return (what @ gains).clamp(_MIN_LOG_GAIN, _MAX_LOG_GAIN).exp()


def _described(
    semantic: Annotated[Tensor, "N D"], belongs: Annotated[Tensor, "N K"], centre: Annotated[Tensor, "D"]
) -> Annotated[Tensor, "N D+K+1"]:
    """Direction u, membership m, and 1."""
    return torch.cat([unit(semantic, centre), belongs, torch.ones_like(semantic[:, :1])], 1)


def fit(
    own: Annotated[Tensor, "N 3"],
    shown: Annotated[Tensor, "N 3"],
    what: Annotated[Tensor, "N X"],
    belongs: Annotated[Tensor, "N K"],
    source: Annotated[Tensor, "K"],
) -> Fit:
    """Light that takes colours `own` to `shown`, by `what` tells the points apart and their regions, float64.

    `source` is how far regions are sources of light (`sources`).
    For gains pairs count by how bright they are: what is black in the scene has none to speak of.
    """
    own = double(own)
    shown = double(shown)
    what = double(what)
    logarithm = ((shown + BLACK_OFFSET) / (own + BLACK_OFFSET)).log()
    gains = _regressed(what, logarithm, own.mean(1, keepdim=True) + BLACK_OFFSET, _GAIN_RIDGE)
    colours = _regressed(what, shown, torch.ones_like(own[:, :1]), _COLOUR_RIDGE)
    # q of each region: how far colours by gain, about the mean that is shown, are those shown.
    middle = what @ colours
    contrast = (own + BLACK_OFFSET) * _gain(what, gains) - BLACK_OFFSET - middle
    both = (contrast * (shown - middle)).sum(1)
    alone = contrast.square().sum(1)
    expected = _MIN_SURE_PAIRS * alone.mean() + torch.finfo(alone.dtype).tiny
    weight = double(belongs).T
    slopes = ((weight @ both + expected) / (weight @ alone + expected)).clamp(0, 1)
    kept = _THING_CONTRAST * (1 - double(source).to(slopes))
    return Fit(gains, colours, torch.lerp(slopes, torch.ones_like(slopes), kept))


def _regressed(
    what: Annotated[Tensor, "N X"],
    value: Annotated[Tensor, "N 3"],
    weight: Annotated[Tensor, "N 1"],
    ridge: float,
) -> Annotated[Tensor, "X 3"]:
    """Coefficients of a weighted ridge regression."""
    weight = weight / weight.sum()
    normal = what.T @ (weight * what) + ridge * torch.eye(what.shape[1]).to(what)
    solved: Tensor = torch.linalg.solve(normal, what.T @ (weight * value))
    return solved


def placed_light(
    scene: SceneStyle,
    dictionary: StyleDictionary,
    allowed: Annotated[Tensor, "K references"],
    colours: tuple[Annotated[Tensor, "K 3"], Annotated[Tensor, "K 3 3"]],
) -> PlacedLight | None:
    """The light of those references that show the very place; None where none does.

    A region takes of each by its weight among all that it may take from (`allowed`, bool); `colours` are mean
    and covariance of the regions' own colours.
    """
    weights = []
    for i in range(len(dictionary.names)):
        weights.append(float(dictionary.weight[dictionary.reference == i][0]))
    odds = allowed.cpu().double() * torch.tensor(weights, dtype=torch.float64)
    odds = odds / odds.sum(1, keepdim=True).clamp_min(1e-12)
    membership = Membership(scene.keys, scene.semantic_mean)
    source = sources(*(double(part).cpu() for part in colours))
    fits = []
    trust = []
    for i, pairs in enumerate(dictionary.placed):
        if pairs is not None:
            belongs = membership(pairs.semantic)
            what = _described(pairs.semantic.to(belongs), belongs, membership.centre)
            fits.append(fit(pairs.own, pairs.shown, what, belongs, source))
            trust.append(_APPLIED * odds[:, i] * _support(pairs, belongs))
    if not fits:
        return None
    return PlacedLight(scene, fits, torch.stack(trust, 1))


def _support(pairs: Pairs, belongs: Annotated[Tensor, "N K"]) -> Annotated[Tensor, "K"]:
    """Trust in each region by the number of its pairs, in [0, 1), float64."""
    count = double(belongs).sum(0)
    return count / (count + _MIN_SURE_PAIRS)
