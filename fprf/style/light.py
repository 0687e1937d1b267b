"""Light where a match is not sure: what the references do not show keeps its material and takes their light.

Letters: N points, D semantic channels, T style codes, K regions of the scene. Colours are sRGB in [0, 1],
rows: c' = c A + b. A region k with mean m_k takes

    light_k(c)  =  (e_k m_k + q_k (c - m_k)) S,        S = (s I + (1 - s) L) diag(g)

with its exposure e_k and contrast q_k, and the saturation s and white balance g of the references; L takes
colours to the grey of their luma. A gain of light is a product, in linear light and, but for the black end,
in sRGB.

- Exposure: the median change of log luma over the things of the scene, each counted as far as it is sure of
  its match, drawn to no change. A night is dark for what it does not show, too; how dark is known within
  limits. The sky is a source of light and no thing; it changes more than what it lights, so smooth regions
  follow their match.
- White balance: the cast that all codes of the references share (`shared`), less that of the scene, drawn to
  none likewise. A sunset is warm in sky, road and tree: that is light. A meadow with a blue sky and a red
  barn shares nothing: that is material.

A point of confidence p takes p paint(c) + (1 - p) light(c) + 4 p (1 - p) u_k. On the way from blue to yellow
lies green: u_k takes it out of the middle where both are opposite along red and blue.

Confidence has two factors. One is a ramp over the likeness of a point and its region to the codes that they
take, in spreads of the cosines between the scene's own regions: encoders differ in these as they do in the
scores of unlike things. The other asks the scene itself, where both sides come from the same pictures
(`unrivalled`): a code that another, unlike region of the scene resembles more belongs to that region's kind.
Where the references lack trees, trees take the road's code, which the road claims. Both are set on painted
pairs of photographs (`benchmarks/semantic_matching.py`): confidence is about the rate at which matches are
right where a right one is as likely as none.
"""

from typing import TYPE_CHECKING, Annotated

import torch
from torch import Tensor, nn

from ..ops import mixture
from ..ops.backend import double
from .dictionary import StyleDictionary, choose, code_odds
from .matching import no_direction, score_spread, share_mean, unit
from .scene_style import Membership, SceneStyle, mixed_maps

if TYPE_CHECKING:
    from ..plugins.stylizers.config import StylizerConfig

SURE = 0.9
"""Likeness, in spreads of the scene's own regions, from which on a match counts wholly; at 0 it counts
nothing.
"""
UNRIVALLED = 0.9
"""Lowe's ratio from which on a claim has no rival: below lies the noise between regions of one kind."""
_MAX_RIVAL_SHARE = 0.8
"""Share that a rival takes from confidence at most."""
_NEAREST_SHARE = 0.05
"""Share of a reference's pixels that a score is the mean of: less may be the rim of something else."""
APPLIED = 0.6
"""Share of the estimated exposure of things, of the cast and of the change of saturation (in logarithms) that is
applied: they are drawn to no change, since a few matches know the light of another place within limits.
"""
_COLOURFUL_SHARE = 0.1
"""Share of the references and of the scene whose saturation is compared, the most colourful. By eye: with a half a
garden by photographs of roads lost the colours of its plants.
"""
_MAX_SOURCE_ROUGHNESS = 0.12
"""Deviation of luma, relative to it, up to which a region is a source of light: skies lie below, by eye."""
_MIN_THING_ROUGHNESS = 0.25
"""The same from which on it is a thing: façades and trees lie above, by eye."""
BLACK_OFFSET = 0.02
"""Added to colours before ratios are taken: five 8-bit steps, below which no ratio is known."""
_MAX_EXPOSED_LUMA = 0.95
"""Luma that a deviation above the mean may reach by exposure: what is white has no shape. By eye."""
_MIN_EXPOSURE_GAIN = 0.05
"""Least gain of light: a night is a twentieth as bright as a day in sRGB. By eye."""
_MAX_EXPOSURE_GAIN = 2.5
"""Largest gain of light: above, the noise of dark places shows. By eye."""
_MIN_SATURATION_GAIN = 0.35
"""Least gain of saturation: black and white takes colour away. By eye."""
_MAX_SATURATION_GAIN = 1.1
"""Largest gain of saturation: a neon street adds little to a wall. By eye."""
_SOURCE_SATURATION_GAIN = 0.7
"""Gain of saturation of sources of light besides: what they show is light, no material, and an overcast sky
is never wrong.
"""
_MAX_CAST = 0.36
"""Largest cast along an axis, in logarithms of sRGB: a factor of 1.4. By eye."""
_CAST_LUMA = 0.15
"""Luma below which colours count less for the cast: what is nearly black has none."""
_MIN_CAST_WEIGHT = 0.05
"""Weight of black in the cast, beside 1 of bright colours: a night has a cast, too. By eye."""
_MIN_VOTE = 0.1
"""Vote of an unsure region on the exposure, beside 1 of a sure one: a scene of nothing but these has an
exposure, too.
"""
_MIN_THING_SHARE = 1e-3
"""Share of things below which all of a scene, nothing but sky, votes on the exposure. By eye."""
_MAX_CONTRAST_LOSS = 3.0
"""Factor by which contrast is reduced at most, however near to white it lies. By eye."""
_MAX_DISSENT_SHARE = 0.2
"""Share of the weight that may have less of a cast, or none, before there is no common one. By eye."""
_RIVAL_LIKENESS_POWER = 4
"""Power of the cosine by which a rival counts as one of the region's kind. By eye."""
_CLAIM_POWER = 0.4
"""Power of the claim: steep where a rival appears, flat where it is much the nearer. By eye."""
_MIN_ANGLE = 1e-6
"""Squared distance of directions, at least: no ratio of two roundings."""
_CAST_AXES = ((0.5**0.5, 0.0, -(0.5**0.5)), (-(6**-0.5), (2 / 3) ** 0.5, -(6**-0.5)))
"""Red against blue, green against magenta; of unit length, at right angles to grey and to each other."""
_LUMA_WEIGHTS = (0.2126, 0.7152, 0.0722)
"""Rec. 709."""


def luma(rgb: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N 1"]:
    """Luma of sRGB colours, in [0, 1] for colours in [0, 1]."""
    return (rgb * rgb.new_tensor(_LUMA_WEIGHTS)).sum(-1, keepdim=True)


class Light(nn.Module):
    """Confidence of points in their match, and the light that they take as far as they have none."""

    maps: Annotated[Tensor, "K 4 3"]
    """A less the identity and below it b of each region, as of `ColourMaps`."""
    between: Annotated[Tensor, "K 3"]
    keys: Annotated[Tensor, "T D"]
    beyond: Annotated[Tensor, "T"]
    middles: Annotated[Tensor, "references D"]
    share: Annotated[Tensor, "T"]
    reference: Annotated[Tensor, "T"]
    forbidden: Annotated[Tensor, "K references"]
    region_likeness: Annotated[Tensor, "K 1"]
    claim: Annotated[Tensor, "K 1"]

    def __init__(
        self,
        scene: SceneStyle,
        dictionary: StyleDictionary,
        maps: Annotated[Tensor, "K 4 3"],
        between: Annotated[Tensor, "K 3"],
        bold: float,
        likeness: Annotated[Tensor, "K"],
        claim: Annotated[Tensor, "K"],
        allowed: Annotated[Tensor, "K references"],
    ) -> None:
        super().__init__()
        self.membership = Membership(scene.keys, scene.semantic_mean)
        self.bold = bold
        self._spread = _spread(scene)
        self._restricted = not bool(allowed.all())
        self.register_buffer("maps", (maps - torch.eye(4, 3).to(maps)).float())
        self.register_buffer("between", between.float())
        self.register_buffer("keys", dictionary.keys.float())
        self.register_buffer("beyond", _beyond(dictionary).float())
        self.register_buffer("middles", _middles(scene, dictionary).float())
        self.register_buffer("share", dictionary.share.float())
        self.register_buffer("reference", dictionary.reference)
        self.register_buffer("forbidden", (~allowed).float())
        self.register_buffer("region_likeness", likeness.float()[:, None])
        self.register_buffer("claim", claim.float()[:, None])

    def confidence(
        self, semantic: Annotated[Tensor, "N D"], belongs: Annotated[Tensor, "N K"] | None = None
    ) -> Annotated[Tensor, "N 1"]:
        """How sure points are of their match, in [0, 1].

        Likeness is that of a point to its nearest codes and that of its regions to those that they take, half
        each.
        """
        belongs = self._belongs(semantic, belongs)
        points = semantic.to(self.keys)
        # Of references that are forbidden to their regions, points know nothing.
        lower = 2 * (belongs @ self.forbidden) if self._restricted else None
        if mixture.usable(points, self.keys, self.middles):
            own = self._nearest(points, lower)
        else:
            own = self._nearest_reference(points, lower)
        likeness = (own[:, None] / self._spread + belongs @ self.region_likeness) / 2
        return (likeness / SURE).clamp(0, 1) * (belongs @ self.claim)

    def _nearest_reference(
        self, points: Annotated[Tensor, "N D"], lower: Annotated[Tensor, "N references"] | None
    ) -> Annotated[Tensor, "N"]:
        """The most like of all references, each by the mean cosine with its nearest codes."""
        own = points.new_full((len(points),), -1.0)
        for i, middle in enumerate(self.middles):
            codes = self._codes(i)
            near = cosines(points, self.keys[codes], self.beyond[codes], self.membership.centre, middle)
            if lower is not None:
                near = near - lower[:, i, None]
            # From the nearest code on, until a twentieth of the reference's pixels is full; the last one
            # counts in part.
            near, order = near.sort(1, descending=True)
            size = (self.share[codes] / self.share[codes].sum())[order]
            taken = (_NEAREST_SHARE - (size.cumsum(1) - size)).clamp_min(0).minimum(size)
            own = torch.maximum(own, (taken * near).sum(1) / taken.sum(1))
        return own

    def _nearest(
        self, points: Annotated[Tensor, "N D"], lower: Annotated[Tensor, "N references"] | None
    ) -> Annotated[Tensor, "N"]:
        """`_nearest_reference`, compiled."""
        centre = self.membership.centre
        keys = []
        aside = []
        sizes = []
        for i, middle in enumerate(self.middles):
            codes = self._codes(i)
            keys.append(shown_units(self.keys[codes], self.beyond[codes], centre))
            aside.append(shown_units(self.keys[codes], self.beyond[codes], middle))
            sizes.append(self.share[codes] / (self.share[codes].sum() * _NEAREST_SHARE))
        views = torch.cat([centre[None], self.middles])
        tables = mixture.nearest_codes(keys, aside, sizes)
        return mixture.nearest(points, views, tables, least=no_direction(views), lower=lower)

    def _codes(self, reference: int) -> Annotated[Tensor, "codes"]:
        return (self.reference == reference).nonzero().squeeze(1)

    def paint(
        self, semantic: Annotated[Tensor, "N D"], belongs: Annotated[Tensor, "N K"] | None = None
    ) -> Annotated[Tensor, "N 1"]:
        """Share of paint at points, in [0, 1]: the confidence at `bold` 0.5, none at 0, all at 1."""
        # Linear in `bold` on either side of 0.5, where paint is the confidence itself.
        sure = self.confidence(semantic, belongs)
        if self.bold <= 0.5:
            return 2 * self.bold * sure
        return sure + (2 * self.bold - 1) * (1 - sure)

    def change(
        self,
        semantic: Annotated[Tensor, "N D"],
        paint: Annotated[Tensor, "N 1"],
        belongs: Annotated[Tensor, "N K"] | None = None,
    ) -> Annotated[Tensor, "N 4 3"]:
        """What is added to colours beside the paint: A and below it b of each point, c' = c + c A + b."""
        # A and b of the regions, mixed by membership, as far as points are not painted; u is largest
        # half-way.
        belongs = self._belongs(semantic, belongs)
        lit = (belongs @ self.maps.flatten(1)).view(-1, 4, 3) * (1 - paint)[..., None]
        lit[:, 3] += 4 * paint * (1 - paint) * (belongs @ self.between)
        return lit

    def forward(
        self,
        colour: Annotated[Tensor, "N 3"],
        semantic: Annotated[Tensor, "N D"],
        paint: Annotated[Tensor, "N 1"],
        belongs: Annotated[Tensor, "N K"] | None = None,
    ) -> Annotated[Tensor, "N 3"]:
        """Addition of `change` to the scene's own colours."""
        belongs = self._belongs(semantic, belongs)
        lit = mixed_maps(colour.to(self.maps), belongs, self.maps[:, :3], self.maps[:, 3])
        middle = belongs @ self.between
        return torch.addcmul(lit * (1 - paint), 4 * paint * (1 - paint), middle).to(colour)

    def _belongs(self, semantic: Tensor, belongs: Tensor | None) -> Annotated[Tensor, "N K"]:
        if belongs is None:
            belongs = self.membership(semantic)
        return belongs.to(self.maps)


def light_of(
    scene: SceneStyle,
    dictionary: StyleDictionary,
    config: "StylizerConfig",
    colours: tuple[Annotated[Tensor, "K 3"], Annotated[Tensor, "K 3 3"]],
    *,
    bold: float,
    allowed: Annotated[Tensor, "K references"] | None = None,
) -> Light | None:
    """The light of references on a scene; None where all is painted (`bold` 1), or nothing tells regions or
    colours apart.

    The stylizer of `config` matches codes and regions; `colours` are mean and covariance of the regions' own
    colours. A region that may not take from all references is lit as if there were only those that it may
    take from.
    """
    if bold == 1 or len(scene.share) == 1 or dictionary.colour_mean is None:
        return None
    count = len(scene.share)
    if allowed is None:
        every = torch.ones(count, len(dictionary.names), dtype=torch.bool)
    else:
        every = allowed.cpu()
    mean, covariance = (double(part).cpu() for part in colours)
    likeness = mean.new_zeros(count)
    claim = mean.new_zeros(count)
    maps = mean.new_zeros(count, 4, 3)
    between = torch.zeros_like(mean)
    cosine = _code_cosines(scene, dictionary)
    for row in sorted({tuple(row) for row in every.tolist()}):
        # All regions are matched with one choice of references; those that made it take their rows.
        chosen = torch.tensor(row)
        (part, codes) = choose(dictionary, chosen)
        rows = (every == chosen).all(1)
        table = double(config.build(dictionary=part, scene=scene).region_match(scene.keys)).cpu()
        # Likeness is the mean cosine with the codes that a region takes, in spreads of the scene's own
        # regions.
        alike = (table * cosine[:, codes]).sum(1) / _spread(scene)
        alone = unrivalled(scene, part, table)
        likeness[rows] = alike[rows]
        claim[rows] = alone[rows]
        sure = (alike / SURE).clamp(0, 1) * alone
        lit, added = light_maps(mean, covariance, double(scene.share), table, part, sure)
        maps[rows] = lit[rows]
        between[rows] = added[rows]
    return Light(scene, dictionary, maps, between, bold, likeness, claim, every)


def _code_cosines(scene: SceneStyle, dictionary: StyleDictionary) -> Annotated[Tensor, "K T"]:
    """Cosine of each region with each code, float64: each reference is seen from its own middle."""
    own = double(scene.keys).cpu()
    keys = double(dictionary.keys).cpu()
    centre = double(scene.semantic_mean).cpu()
    beyond = double(_beyond(dictionary)).cpu()
    cosine = own.new_zeros(len(own), len(keys))
    for i, middle in enumerate(double(_middles(scene, dictionary)).cpu()):
        codes = (dictionary.reference == i).nonzero().squeeze(1)
        cosine[:, codes] = cosines(own, keys[codes], beyond[codes], centre, middle)
    return cosine


def cosines(
    x: Annotated[Tensor, "N D"],
    keys: Annotated[Tensor, "T D"],
    beyond: Annotated[Tensor, "T"],
    centre: Annotated[Tensor, "D"],
    middle: Annotated[Tensor, "D"],
) -> Annotated[Tensor, "N T"]:
    """The lesser of the cosines seen from the scene's mean and from the middle between scene and reference.

    In a room all of a meadow lies in one direction from the mean, and from the middle all of the room does.
    What codes have `beyond` the basis of the scene (squared length) is at right angles to all that the scene
    has.
    """

    def seen(at: Tensor) -> Tensor:
        return unit(x, at) @ shown_units(keys, beyond, at).T

    return torch.minimum(seen(centre), seen(middle))


def shown_units(
    keys: Annotated[Tensor, "T D"], beyond: Annotated[Tensor, "T"], at: Annotated[Tensor, "D"]
) -> Annotated[Tensor, "T D"]:
    """Directions of codes from a place, shorter by what lies `beyond` the basis: a product with a direction
    in the basis is the cosine in all channels.
    """
    length = (keys - at).square().sum(1)
    shown = (length / (length + beyond).clamp_min(torch.finfo(length.dtype).tiny)).sqrt()
    return unit(keys, at) * shown[:, None]


def _beyond(dictionary: StyleDictionary) -> Annotated[Tensor, "T"]:
    if dictionary.beyond is None:
        return torch.zeros_like(dictionary.share)
    return dictionary.beyond


def _middles(scene: SceneStyle, dictionary: StyleDictionary) -> Annotated[Tensor, "references D"]:
    """Centre between the scene's mean and that of each reference."""
    rows = []
    for i in range(len(dictionary.names)):
        own = dictionary.reference == i
        rows.append((scene.semantic_mean + share_mean(dictionary.keys[own], dictionary.share[own])) / 2)
    return torch.stack(rows)


def unrivalled(
    scene: SceneStyle, dictionary: StyleDictionary, table: Annotated[Tensor, "K T"]
) -> Annotated[Tensor, "K"]:
    """How little other, unlike regions claim the codes that each region takes, in [0, 1], float64.

    With the squared distance d of directions from the scene's mean, a region k takes code t against its
    strongest rival l by

        min over l of   r + (1 - r) max(0, cos(k, l))^4,      r = min(1, d(l, t) / d(k, t))

    r is Lowe's ratio of distances (IJCV 2004, section 7.1), with rivals of the scene in the place of rival
    codes; a rival that is like the region takes nothing from it, since what it claims is of its kind. Cosines
    between regions know no gap between two sets of pictures: codes come back to the scene (cycle
    consistency).
    """
    # d, r and cos(k, l) of the formula; the least over rivals counts.
    units = unit(double(scene.keys), double(scene.semantic_mean))
    cosine = units @ unit(double(dictionary.keys), double(scene.semantic_mean)).T
    distance = (1 - cosine).clamp_min(_MIN_ANGLE)
    ratio = (distance[None] / distance[:, None]).clamp_max(1)
    like = (units @ units.T).clamp_min(0).pow(_RIVAL_LIKENESS_POWER)[..., None]
    share = (table * (ratio + (1 - ratio) * like).amin(1)).sum(1)
    # Steep where a rival appears, flat where it is much the nearer: that much a wrong match still tells.
    return 1 - _MAX_RIVAL_SHARE * (1 - (share / UNRIVALLED).clamp(0, 1)).pow(_CLAIM_POWER)


def light_maps(
    mean: Annotated[Tensor, "K 3"],
    covariance: Annotated[Tensor, "K 3 3"],
    share: Annotated[Tensor, "K"],
    table: Annotated[Tensor, "K T"],
    dictionary: StyleDictionary,
    sure: Annotated[Tensor, "K"],
) -> tuple[Annotated[Tensor, "K 4 3"], Annotated[Tensor, "K 3"]]:
    """The affine map of each region by the references' light (A, below it b), and u, float64; see the top of
    the file.
    """
    assert dictionary.colour_mean is not None
    codes = double(dictionary.colour_mean)
    odds = code_odds(dictionary)
    painted = table @ codes
    own = luma(mean)[:, 0]
    grey = luma(torch.eye(3, dtype=torch.float64))
    axes = torch.tensor(_CAST_AXES, dtype=torch.float64)
    deviation = _luma_deviation(covariance)
    source = sources(mean, covariance)
    # What is nearly white already, as a marble statue is, cannot become brighter without losing its shape.
    gain = _exposure(own, luma(painted)[:, 0], share, source, sure)
    gain = gain.minimum((_MAX_EXPOSED_LUMA / (own + deviation)).clamp_min(1.0))
    balance = _white_balance(mean, share, codes, odds, axes)
    # Saturation s of the references against the scene's, and S = (s I + (1 - s) L) diag(g).
    change = (_saturation(codes, odds) / _saturation(mean, share)) ** APPLIED
    change = change.clamp(_MIN_SATURATION_GAIN, _MAX_SATURATION_GAIN)
    softer = torch.lerp(torch.ones_like(source), source.new_tensor(_SOURCE_SATURATION_GAIN), source)
    saturation = (change * softer)[:, None, None]
    towards = (saturation * torch.eye(3).to(grey) + (1 - saturation) * grey.expand(3, 3)) * balance
    # Contrast q: two deviations above the mean stay below white, with at least a third of the contrast.
    below_white = (1 - gain * own) / (2 * deviation).clamp_min(BLACK_OFFSET)
    contrast = gain.minimum(below_white.clamp_min(gain.clamp_max(1) / _MAX_CONTRAST_LOSS))
    bias = torch.einsum("kc,kcd->kd", (gain - contrast)[:, None] * mean, towards)
    lit_mean = torch.einsum("kc,kcd->kd", gain[:, None] * mean, towards)
    maps = torch.cat([contrast[:, None, None] * towards, bias[:, None]], 1)
    return maps, _between(lit_mean, painted, axes)


def sources(mean: Annotated[Tensor, "K 3"], covariance: Annotated[Tensor, "K 3 3"]) -> Annotated[Tensor, "K"]:
    """How far regions of these colours are sources of light, in [0, 1]: smooth ones are, as the sky is; rough
    ones are things.
    """
    roughness = _luma_deviation(covariance) / (luma(mean)[:, 0] + BLACK_OFFSET)
    source: Tensor = (_MIN_THING_ROUGHNESS - roughness) / (_MIN_THING_ROUGHNESS - _MAX_SOURCE_ROUGHNESS)
    return source.clamp(0, 1)


def _luma_deviation(covariance: Annotated[Tensor, "K 3 3"]) -> Annotated[Tensor, "K"]:
    grey = luma(torch.eye(3).to(covariance))
    return torch.einsum("kij,ix,jx->k", covariance, grey, grey).clamp_min(0).sqrt()


def _exposure(
    own: Annotated[Tensor, "K"],
    painted: Annotated[Tensor, "K"],
    share: Annotated[Tensor, "K"],
    source: Annotated[Tensor, "K"],
    sure: Annotated[Tensor, "K"],
) -> Annotated[Tensor, "K"]:
    """Exposure e from the logarithms of the regions' luma and that of their match: things take the median of
    their changes, sources the change of their match.
    """
    vote = share * (1 - source)
    if float(vote.sum()) < _MIN_THING_SHARE * float(share.sum()):
        vote = share  # of a scene of nothing but sky, all
    change = (painted + BLACK_OFFSET).log() - (own + BLACK_OFFSET).log()
    thing = torch.full_like(change, APPLIED * _quantile(change, vote * (sure + _MIN_VOTE), 0.5))
    return torch.lerp(thing, change, source).exp().clamp(_MIN_EXPOSURE_GAIN, _MAX_EXPOSURE_GAIN)


def _white_balance(
    mean: Annotated[Tensor, "K 3"],
    share: Annotated[Tensor, "K"],
    codes: Annotated[Tensor, "T 3"],
    odds: Annotated[Tensor, "T"],
    axes: Annotated[Tensor, "2 3"],
) -> Annotated[Tensor, "3"]:
    """White balance g from the logarithms of colours: the cast of the references less that of the scene, axis
    by axis.
    """
    here = (mean.clamp_min(0) + BLACK_OFFSET).log() @ axes.T
    there = (codes.clamp_min(0) + BLACK_OFFSET).log() @ axes.T
    bright = odds * (luma(codes)[:, 0] / _CAST_LUMA).clamp(_MIN_CAST_WEIGHT, 1)
    casts = []
    for a in range(len(axes)):
        cast = shared(there[:, a], bright)
        # Where the references share nothing, what the scene shares may be its material: a plant is yellowish
        # throughout.
        if cast:
            cast -= shared(here[:, a], share)
        casts.append(cast)
    cast_of_axes = torch.tensor(casts, dtype=torch.float64).clamp(-_MAX_CAST, _MAX_CAST)
    return (APPLIED * cast_of_axes @ axes).exp()


def _between(
    lit: Annotated[Tensor, "K 3"], painted: Annotated[Tensor, "K 3"], axes: Annotated[Tensor, "2 3"]
) -> Annotated[Tensor, "K 3"]:
    """u, which takes green and magenta out of the middle of the lit and the painted mean, as far as these are
    opposite along red and blue.
    """
    red, green = (lit @ axes.T).unbind(1)
    other_red, other_green = (painted @ axes.T).unbind(1)
    largest = red.square().maximum(other_red.square()).clamp_min(1e-12)  # black on both sides: no ratio
    opposite = (-red * other_red / largest).clamp(0, 1)
    return (-opposite * (green + other_green) / 2)[:, None] * axes[1]


def shared(value: Annotated[Tensor, "N"], weight: Annotated[Tensor, "N"]) -> float:
    """What four fifths of the weight have at least, with its sign; 0 where signs differ."""
    low = _quantile(value, weight, _MAX_DISSENT_SHARE)
    high = _quantile(value, weight, 1 - _MAX_DISSENT_SHARE)
    if low > 0:
        return low
    return min(high, 0.0)


def _quantile(value: Tensor, weight: Tensor, at: float) -> float:
    order = value.argsort()
    edges = weight[order].cumsum(0)
    return float(value[order][int(torch.searchsorted(edges, at * edges[-1]).clamp_max(len(value) - 1))])


def _saturation(colour: Annotated[Tensor, "N 3"], weight: Annotated[Tensor, "N"]) -> Tensor:
    """Distance of colours from grey, relative to their luma, that a tenth has at least; never 0.

    Roads and skies are grey in any light: the most colourful things tell black and white, and fog.
    """
    grey = luma(colour)
    apart = (colour - grey).abs().amax(1) / (grey[:, 0] + BLACK_OFFSET)
    return torch.tensor(_quantile(apart, weight, 1 - _COLOURFUL_SHARE) + BLACK_OFFSET)


def _spread(scene: SceneStyle) -> float:
    units = unit(scene.keys, scene.semantic_mean)
    return score_spread(units, units)
