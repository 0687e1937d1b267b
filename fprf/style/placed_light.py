"""Light where a reference shows the very place (`placing`): measured point by point, not carried over from
things of the same kind.

Letters: N points or pairs, D semantic channels, K regions of the scene, R references that show the place, J
inducing pairs. Colours are sRGB in [0, 1].

Two things are regressed on what tells points apart, their direction u in semantics, their membership m in regions
and what they are near to, n: logarithms of the gains of all pairs of colours, channel by channel, and the colours
shown themselves,

    g(u, m, n)  =  exp(W u + V m + U n + b),        s(u, m, n)  =  W' u + V' m + U' n + b'
    c'  =  q ((c + o) g - o)  +  (1 - q) s

n are J Nystroem features (Williams and Seeger, NIPS 2000): their products are the likeness of two points in
semantics and direction t from the eye that sees what the photograph shows, exp(u u' - 1 + 5 (t t' - 1)), as far as
J of the pairs tell it (`InducingPairs`). A wall in the shade and another in the sun take each the light that is
shown beside them, and far from all pairs n is nothing.

q follows the slope of the colours shown on the colours by gain, both less s, over the pairs of a region, in
[0, 1]: 1 where the scene's own colours say what the photograph shows; 0 in a sky, whose clouds are others. Where
views and photograph do not quite lie on each other the slope is small, too, but things keep their contrast: of what
is missing to 1 they take half. Things are rough, in the scene and in the photograph. Pairs whose semantics differ
count less: a branch before the sky is none of it. Within a region façades differ from roofs. All this
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
from .statistics import group_moments

_GAIN_RIDGE = 0.003
"""Weight of the squared coefficients beside the mean squared error of a logarithm."""
_COLOUR_RIDGE = 0.002
"""The same of a colour."""
_NEAR_COLOUR_RIDGE = 0.02
"""The same of a colour by what points are near to: with a tenth of it a scene in the wild loses 0.02 dB, and fixed
cameras gain as much.
"""
_THING_CONTRAST = 0.5
"""Share of the contrast that pairs deny things, which these keep nevertheless: with 0 photographs in the wild are
0.4 dB nearer, and their façades look as in a fog; with 1 0.6 dB further.
"""
_DIRECTION_WEIGHT = 5.0
"""Weight of the cosine of directions beside that of semantics: likeness falls to 0.6 at 26 degrees."""
_INDUCING_PAIRS = 128
"""Pairs, in even steps through all, that points are near to, at most."""
_INDUCING_RIDGE = 1e-4
"""Added to the likeness of these with themselves, 1: a hundredth squared."""
_APPLIED = 0.85
"""Share of a look that is measured where pairs are many: the rest is matched, and errs elsewhere."""
_MIN_SURE_PAIRS = 2.0
"""Pairs in a region with which it takes half of that, and half of the slope that they say: without any it is 1."""
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


class InducingPairs(nn.Module):
    """Pairs of one photograph that others are compared with, in semantics and as its eye sees them."""

    keys: Annotated[Tensor, "J D+3"]
    """Directions in semantics, and weighted ones in the world, side by side."""
    root: Annotated[Tensor, "J J"]
    """Likenesses with these pairs times this are n."""
    eye: Annotated[Tensor, "3"]

    def __init__(self, pairs: Pairs, centre: Annotated[Tensor, "D"]) -> None:
        super().__init__()
        some = slice(0, None, -(-len(pairs.own) // _INDUCING_PAIRS))
        keys = _beside(double(unit(pairs.semantic[some].to(centre), centre)), double(pairs.toward[some]))
        same = _likeness(keys, keys) + _INDUCING_RIDGE * torch.eye(len(keys)).to(keys)
        upper = torch.linalg.cholesky(same).T
        self.register_buffer("keys", keys.float())
        self.register_buffer("root", torch.linalg.inv(upper).float())
        self.register_buffer("eye", pairs.eye.float())

    def forward(
        self, direction: Annotated[Tensor, "N D"], toward: Annotated[Tensor, "N 3"]
    ) -> Annotated[Tensor, "N J"]:
        """Likenesses of points with these pairs, in [0, 1], by directions in semantics and from the eye."""
        return _likeness(_beside(direction, toward.to(direction)), self.keys.to(direction))

    def seen(self, points: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N 3"]:
        """Unit directions from the eye to points in the world."""
        return nn.functional.normalize(points.to(self.eye) - self.eye, dim=1)


def _beside(
    direction: Annotated[Tensor, "N D"], toward: Annotated[Tensor, "N 3"]
) -> Annotated[Tensor, "N D+3"]:
    return torch.cat([direction, _DIRECTION_WEIGHT**0.5 * toward], 1)


def _likeness(a: Annotated[Tensor, "N D+3"], b: Annotated[Tensor, "J D+3"]) -> Annotated[Tensor, "N J"]:
    return (a @ b.T - (1 + _DIRECTION_WEIGHT)).exp()


class Fit(NamedTuple):
    """Coefficients that pairs of colours at one place give to points described by X numbers."""

    gains: Annotated[Tensor, "X 3"]
    """Coefficients of logarithms of gains: W, V, b and U."""
    colours: Annotated[Tensor, "X 3"]
    """Coefficients of the colours shown: W', V', b' and U'."""
    slopes: Annotated[Tensor, "K"]
    """q of each region."""


class PlacedLight(nn.Module):
    """Colours of points by the light that references show at the very place."""

    slopes: Annotated[Tensor, "K R"]
    trust: Annotated[Tensor, "K R"]
    """Share of each reference's light that a region takes; rows sum to 1 at most."""

    def __init__(
        self,
        scene: SceneStyle,
        fits: Sequence[Fit],
        inducing: Sequence[InducingPairs],
        trust: Annotated[Tensor, "K R"],
    ) -> None:
        super().__init__()
        self.membership = Membership(scene.keys, scene.semantic_mean)
        self.inducing = nn.ModuleList(inducing)
        for r, (each, near) in enumerate(zip(fits, inducing, strict=True)):
            # Gains and colours side by side, and coefficients of likenesses in the place of those of n.
            table = torch.cat([each.gains, each.colours], 1)
            count = len(table) - len(near.keys)
            table = torch.cat([table[:count], double(near.root) @ table[count:]])
            self.register_buffer(f"coefficients{r}", table.float())
        self.register_buffer("slopes", torch.stack([each.slopes for each in fits], 1).float())
        self.register_buffer("trust", trust.float())

    def forward(
        self,
        semantic: Annotated[Tensor, "N D"],
        belongs: Annotated[Tensor, "N K"] | None = None,
        points: Annotated[Tensor, "N 3"] | None = None,
    ) -> Measured:
        """Shares, factors and offsets; `belongs` is the points' membership, where it is known, and `points` are
        where they lie (world units). Where that is unknown they are near to nothing.
        """
        semantic = semantic.to(self.trust)
        belongs = self.membership(semantic) if belongs is None else belongs.to(self.trust)
        what = _described(semantic, belongs, self.membership.centre)
        direction = what[:, : semantic.shape[1]]
        trust = belongs @ self.trust
        slopes = belongs @ self.slopes
        excess = semantic.new_zeros(len(semantic), 3)
        offset = semantic.new_zeros(len(semantic), 3)
        for r in range(self.trust.shape[1]):
            share = trust[:, r, None]
            slope = slopes[:, r, None]
            table: Tensor = getattr(self, f"coefficients{r}")
            both = what @ table[: what.shape[1]]
            if points is not None:
                inducing = self.inducing[r]
                assert isinstance(inducing, InducingPairs)  # nn.ModuleList forgets it
                both = both + inducing(direction, inducing.seen(points)) @ table[what.shape[1] :]
            gain = _gain(both[:, :3])
            excess = excess + share * (slope * gain - 1)
            shown = both[:, 3:].clamp(0, 1)
            offset = offset + share * (slope * BLACK_OFFSET * (gain - 1) + (1 - slope) * shown)
        return Measured(trust.sum(1, keepdim=True), excess, offset)


def _gain(logarithm: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N 3"]:
    return logarithm.clamp(_MIN_LOG_GAIN, _MAX_LOG_GAIN).exp()


def _described(
    semantic: Annotated[Tensor, "N D"], belongs: Annotated[Tensor, "N K"], centre: Annotated[Tensor, "D"]
) -> Annotated[Tensor, "N D+K+1"]:
    """Direction u, membership m, and 1."""
    return torch.cat([unit(semantic, centre), belongs, torch.ones_like(semantic[:, :1])], 1)


def fit(
    pairs: Pairs,
    what: Annotated[Tensor, "N X"],
    near: Annotated[Tensor, "N J"],
    belongs: Annotated[Tensor, "N K"],
    source: Annotated[Tensor, "K"],
) -> Fit:
    """Light that takes a scene's colours to those that a photograph shows, by `what` tells the points apart, what they
    are near to, and their regions, float64.

    `source` is how far regions are sources of light (`sources`). Pairs count by their weight, and for gains by
    how bright they are, too: what is black in the scene has none to speak of.
    """
    own = double(pairs.own)
    shown = double(pairs.shown)
    what = double(what)
    near = double(near)
    counts = double(pairs.weight)
    bright = counts * (own.mean(1) + BLACK_OFFSET)
    logarithm = ((shown + BLACK_OFFSET) / (own + BLACK_OFFSET)).log()
    # q of each region: how far colours by gain, about the mean that is shown, are those shown. What points are near
    # to fits clouds, too, and says nothing of that.
    gains = _regressed(what, logarithm, bright, what.new_full((what.shape[1],), _GAIN_RIDGE))
    colours = _regressed(what, shown, counts, what.new_full((what.shape[1],), _COLOUR_RIDGE))
    middle = what @ colours
    contrast = (own + BLACK_OFFSET) * _gain(what @ gains) - BLACK_OFFSET - middle
    tiny = torch.finfo(own.dtype).tiny
    weight = double(belongs).T * counts
    count = weight.sum(1)
    mean = weight / count.clamp_min(tiny)[:, None]
    alone = mean @ contrast.square().sum(1) + tiny
    both = mean @ (contrast * (shown - middle)).sum(1)
    sure = _sure(count)
    slopes = torch.lerp(torch.ones_like(sure), both / alone, sure).clamp(0, 1)
    # A sky of many captured skies is rough, and smooth in the photograph.
    smooth = sources(*group_moments(shown, weight.T)[:2])
    thing = 1 - double(source).to(smooth).maximum(sure * smooth)
    slopes = torch.lerp(slopes, torch.ones_like(slopes), _THING_CONTRAST * thing)
    every = torch.cat([what, near], 1)
    ridge = every.new_full((every.shape[1],), _COLOUR_RIDGE)
    ridge[what.shape[1] :] = _NEAR_COLOUR_RIDGE
    gains = _regressed(every, logarithm, bright, torch.full_like(ridge, _GAIN_RIDGE))
    return Fit(gains, _regressed(every, shown, counts, ridge), slopes)


def _regressed(
    what: Annotated[Tensor, "N X"],
    value: Annotated[Tensor, "N 3"],
    weight: Annotated[Tensor, "N"],
    ridge: Annotated[Tensor, "X"],
) -> Annotated[Tensor, "X 3"]:
    """Coefficients of a weighted ridge regression."""
    weight = (weight / weight.sum().clamp_min(torch.finfo(weight.dtype).tiny))[:, None]
    normal = what.T @ (weight * what) + torch.diag(ridge)
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
    inducing = []
    trust = []
    for i, pairs in enumerate(dictionary.placed):
        if pairs is not None:
            belongs = membership(pairs.semantic)
            what = _described(pairs.semantic.to(belongs), belongs, membership.centre)
            near = InducingPairs(pairs, membership.centre)
            n = near(what[:, : pairs.semantic.shape[1]], pairs.toward) @ near.root.to(what)
            fits.append(fit(pairs, what, n, belongs, source))
            inducing.append(near)
            trust.append(_APPLIED * odds[:, i] * _support(pairs, belongs))
    if not fits:
        return None
    return PlacedLight(scene, fits, inducing, torch.stack(trust, 1))


def _support(pairs: Pairs, belongs: Annotated[Tensor, "N K"]) -> Annotated[Tensor, "K"]:
    """Trust in each region by the number of its pairs, in [0, 1), float64."""
    return _sure(double(pairs.weight).to(belongs.device) @ double(belongs))


def _sure(count: Annotated[Tensor, "K"]) -> Annotated[Tensor, "K"]:
    """Belief in so many pairs, in [0, 1)."""
    return count / (count + _MIN_SURE_PAIRS)
