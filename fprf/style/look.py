"""The look of a scene in a style: features to styled features, then colours, strengths and luminance, point
by point.

Letters: N points, C content channels, D semantic channels, K regions of the scene, T style codes. Colours are
sRGB in [0, 1]. Strengths, shares and luminances lie in [0, 1]; strengths are one number or one a point.

A look is one stylizer with its strengths, or a mix of several: features, strengths and luminances are mixed
linearly at every point, so that a style fades into another without either's edges showing.

Colours behind the decoder. A decoder is not linear, and styled features lie off what it has seen: their
statistics may be those of the references while the colours are not. So colours get a map of their own, region
by region,

    c'  =  c + sum_k a_k(point) ((c - m_k) A_k + n_k - c)

where m_k and S_k are mean and covariance of the colours that region k has after the decoder, n_k and T_k
those of pixels of the photographs in the codes that it matches, and A_k S_k A_k = T_k is the optimal
transport of three channels. Colours after the decoder are those of draws from the region's Gaussian of
features: a trained scene knows that and needs no images. A point's colour still depends on the point alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, NamedTuple

import torch
from torch import Tensor, nn

from ..checks import between
from ..interfaces import Decoder, Stylizer
from ..light.config import SunConfig
from ..ops.backend import double
from ..types import Want
from .config import Place
from .dictionary import StyleDictionary, blend_codes, choose, concatenate
from .light import Light, luma
from .placed_light import Measured, PlacedLight
from .scene_style import Membership, RegionWeight, SceneStyle, mixed_maps, own_style
from .statistics import mix, monge, symmetric_root

if TYPE_CHECKING:
    from ..plugins.stylizers.config import StylizerConfig

_REGION_DRAWS = 512
"""Points drawn of each region: means of colours are known to a fiftieth of their deviation."""
_MAX_COLOUR_GAIN = 3.0
"""No direction of colour is amplified more: a flat region's noise must stay unseen."""
_COLOUR_RIDGE_VARIANCE = 2e-4
"""Variance added on both sides: a deviation of four 8-bit steps, below which colours have no shape worth
carrying over.
"""


def keep_luminance(
    styled: Annotated[Tensor, "N 3"], own: Annotated[Tensor, "N 3"], share: float | Annotated[Tensor, "N 1"]
) -> Annotated[Tensor, "N 3"]:
    """Styled colours whose luma is moved towards the scene's own by `share`: 0 changes nothing, 1 gives
    luma(own).

    All in [0, 1]. A colour that would leave that range fades towards grey just as far as it must, which
    leaves its luma. Points are treated, not pixels: luma is linear, so both would agree but for what leaves
    the range, and there a point's colour must stay in [0, 1] (which bounds the renderer's error) and be the
    same from every view.
    """
    before = luma(styled)
    shift = share * (luma(own) - before)
    moved = styled + shift
    level = before + shift
    # Fade the tint, the distance from the grey of the same luma, until the colour fits.
    tint = moved - level
    room = torch.where(tint > 0, 1 - level, level)
    fits = (room / tint.abs().clamp_min(torch.finfo(tint.dtype).tiny)).amin(-1, keepdim=True)
    leaves = ((moved < 0) | (moved > 1)).any(-1, keepdim=True)
    return torch.where(leaves, level + fits * tint, moved).clamp(0, 1)  # rounding alone leaves the range now


def place_weight(place: Place, points: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N"]:
    """1 inside of a place, 0 beyond its border, and falling smoothly with the distance between."""
    corners = points.new_tensor(place.points)
    if place.width is None:
        away = torch.maximum(corners[0] - points, points - corners[1]).clamp_min(0).norm(dim=1)
    else:
        # The nearest point of each piece of the path, and of these the nearest.
        first = corners[:-1]
        along = corners[1:] - corners[:-1]
        local = points[:, None] - first
        share = (local * along).sum(2) / along.square().sum(1).clamp_min(torch.finfo(points.dtype).tiny)
        nearest = local - share.clamp(0, 1)[..., None] * along
        away = (nearest.norm(dim=2).amin(1) - place.width / 2).clamp_min(0)
    if place.border == 0:
        sharp: Tensor = (away == 0).to(points)
        return sharp
    inside = (1 - away / place.border).clamp(0, 1)
    smooth: Tensor = inside.square() * (3 - 2 * inside)
    return smooth


class ColourMaps(nn.Module):
    """An affine map of colours for each region, mixed by membership."""

    matrix: Annotated[Tensor, "K 3 3"]
    bias: Annotated[Tensor, "K 3"]

    def __init__(
        self,
        scene: SceneStyle,
        matrix: Annotated[Tensor, "K 3 3"],
        bias: Annotated[Tensor, "K 3"],
        share: float,
    ) -> None:
        super().__init__()
        self.membership = Membership(scene.keys, scene.semantic_mean)
        # The identity is taken out: what is small stays exact, and a map that changes nothing is nothing.
        self.register_buffer("matrix", (share * (matrix - torch.eye(3).to(matrix))).float())
        self.register_buffer("bias", (share * bias).float())

    @property
    def needs(self) -> Want:
        """Semantics only where there is more than one region."""
        if self.membership.divided:
            return Want.CONTENT | Want.SEMANTIC
        return Want.CONTENT

    def forward(
        self,
        colour: Annotated[Tensor, "N 3"],
        semantic: Annotated[Tensor, "N D"] | None,
        belongs: Annotated[Tensor, "N K"] | None = None,
    ) -> Annotated[Tensor, "N 3"]:
        """Change to add to colours in [0, 1] so that they lie in the style and in [0, 1].

        `belongs` is the points' membership, where it is known.
        """
        if belongs is None:
            belongs = self.membership(colour[:, :0] if semantic is None else semantic)
        change = mixed_maps(colour.to(self.bias), belongs.to(self.bias), self.matrix, self.bias)
        return (colour + change.to(colour)).clamp(0, 1) - colour


@torch.no_grad()
def colour_maps(
    stylizer: Stylizer,
    dictionary: StyleDictionary,
    scene: SceneStyle,
    decoder: Decoder,
    *,
    features: float = 1.0,
    share: float = 1.0,
    smoothing: Annotated[Tensor, "K K"] | None = None,
) -> ColourMaps | None:
    """The maps of a stylizer whose change of features counts `features`; None where nothing is to be carried
    over.

    `share`, in [0, 1], is how much of the way colours go. Regions and codes are matched by the stylizer
    itself; `smoothing` (`region_smoothing`) is what it smooths its matches by. A dictionary without the
    colours of its photographs (that of the scene itself) carries nothing over.
    """
    if share == 0 or dictionary.colour_mean is None or dictionary.colour_covariance is None:
        return None
    # The scene's side is blended and smoothed as the references' is, so that like meets like.
    mean, covariances = decoded_colours(stylizer, scene, decoder, features=features)
    whole = mix(mean, covariances, scene.share)
    mean, covariances = blend_codes(mean, covariances, *whole, mean.new_full((len(mean),), dictionary.blend))
    if smoothing is not None:
        mean, covariances = (
            smoothing.to(mean) @ mean,
            torch.einsum("kl,lij->kij", smoothing.to(mean), covariances),
        )
    device = next(stylizer.buffers(), scene.mean).device
    table = double(stylizer.region_match(scene.keys.to(device))).to(mean)
    return ColourMaps(scene, *carried_colours(mean, covariances, table, dictionary), share)


def region_maps(
    stylizer: Stylizer,
    dictionary: StyleDictionary,
    scene: SceneStyle,
    config: "StylizerConfig",
    allowed: Annotated[Tensor, "K references"],
) -> ColourMaps | None:
    """The maps of scenes whose content is colour (there is no decoder); None where the config asks for none.

    The colours of each region are carried over to those of the codes that it takes; `allowed` as of
    `regional`.
    """
    if config.colours <= 0:
        return None
    # Matched with itself as with the photographs, the scene keeps its colours. Where a region may not take
    # from all, the scene stands in the place of each, so that both sides are smoothed over the same regions.
    names = ("scene",) if bool(allowed.all()) else dictionary.names
    mine = concatenate([own_style(scene, dictionary.blend)] * len(names), names, [1.0] * len(names))
    mine = mine._replace(origin=dictionary.origin)
    table = double(regional(mine, scene, allowed, config).region_match(scene.keys))
    mean = table @ double(mine.mean)
    covariances = torch.einsum("kt,tij->kij", table, double(mine.covariance))
    taken = double(stylizer.region_match(scene.keys))
    return ColourMaps(scene, *carried_colours(mean, covariances, taken, dictionary), config.colours)


def carried_colours(
    mean: Annotated[Tensor, "K 3"],
    covariances: Annotated[Tensor, "K 3 3"],
    table: Annotated[Tensor, "K T"],
    dictionary: StyleDictionary,
) -> tuple[Annotated[Tensor, "K 3 3"], Annotated[Tensor, "K 3"]]:
    """A and b of each region, float64, c' = c A + b: from the colours that it has to those of the codes that
    it takes.

    `table` holds the shares of the codes, and the dictionary the colours of its photographs.
    """
    assert dictionary.colour_mean is not None and dictionary.colour_covariance is not None
    there = double(dictionary.colour_mean).to(mean)
    spread = double(dictionary.colour_covariance).to(mean)
    if len(mean) == 1:  # an undivided scene takes its codes together, with what lies between them
        target, wide = (part[None] for part in mix(there, spread, table[0]))
    else:
        target = table @ there
        wide = torch.einsum("kt,tij->kij", table, spread)
    floor = _COLOUR_RIDGE_VARIANCE * torch.eye(3).to(mean)
    matrix = monge(covariances + floor, wide + floor, gain=_MAX_COLOUR_GAIN)
    return matrix, target - torch.einsum("kc,kcd->kd", mean, matrix)


@torch.no_grad()
def decoded_colours(
    stylizer: Stylizer, scene: SceneStyle, decoder: Decoder | None, *, features: float
) -> tuple[Annotated[Tensor, "K 3"], Annotated[Tensor, "K 3 3"]]:
    """Mean and covariance of each region's colours, float64, after a share of the stylizer's change, and the
    decoder.

    Without a decoder they are those of the content, unchanged.
    """
    if decoder is None:
        return double(scene.region_mean), double(scene.region_covariance)
    device = next(stylizer.buffers(), scene.mean).device
    draw = torch.randn(
        _REGION_DRAWS // 2,
        scene.mean.numel(),
        generator=torch.Generator().manual_seed(0),
        dtype=torch.float64,
    )
    draw = torch.cat([draw, -draw])  # in pairs: the features' mean is met exactly
    means = []
    covariances = []
    for k in range(len(scene.share)):
        # Points of the region's Gaussian of features, all with the semantics of its key.
        root = symmetric_root(double(scene.region_covariance[k])).cpu()
        points = (double(scene.region_mean[k]).cpu() + draw @ root).float().to(device)
        key = scene.keys[k].to(device).expand(len(points), -1)
        styled = stylizer(points, key if Want.SEMANTIC in stylizer.needs else None)
        colour = double(decoder(torch.lerp(points, styled, features))).cpu()
        means.append(colour.mean(0))
        covariances.append(torch.cov(colour.T, correction=0))
    return torch.stack(means), torch.stack(covariances)


def regional(
    dictionary: StyleDictionary,
    scene: SceneStyle,
    allowed: Annotated[Tensor, "K references"],
    config: "StylizerConfig",
) -> Stylizer:
    """Build the stylizer that heeds which references each region may take from; that of all of them where
    none is excluded.

    A region that is pinned to a reference looks as it would if that were the only one, whatever the stylizer,
    and by its own matching. Stylizers that are made of regions heed the choice themselves, at no cost. No
    other needs to know of it: each choice gets a stylizer of its own, and a point takes of each as much as it
    belongs to its regions.
    """
    if bool(allowed.all()):
        return config.build(dictionary=dictionary, scene=scene)
    if getattr(config, "handles_allowed_references", True):  # what is not installed says so when it is built
        return config.build(dictionary=dictionary._replace(allowed=allowed), scene=scene)
    # One stylizer for each different choice of references.
    rows = []
    for row in allowed.tolist():
        rows.append(tuple(row))
    choices = sorted(set(rows))
    chosen = []
    for choice in choices:
        chosen.append(choose(dictionary, torch.tensor(choice)))
    stylizers = []
    for part, _ in chosen:
        stylizers.append(config.build(dictionary=part, scene=scene))
    choice_of_region = torch.tensor([choices.index(row) for row in rows])
    return RegionStylizer(scene, stylizers, torch.stack([codes for _, codes in chosen]), choice_of_region)


class RegionStylizer(Stylizer):
    """P stylizers, each for the regions of one choice of references."""

    codes: Annotated[Tensor, "P T"]
    """The codes of each stylizer among those of all references, bool."""

    def __init__(
        self,
        scene: SceneStyle,
        stylizers: list[Stylizer],
        codes: Annotated[Tensor, "P T"],
        choice_of_region: Annotated[Tensor, "K"],
    ) -> None:
        super().__init__()
        self.stylizers = nn.ModuleList(stylizers)
        self.weight = RegionWeight(scene, nn.functional.one_hot(choice_of_region, len(stylizers)))
        self.register_buffer("codes", codes)
        self.alone = len(stylizers) == 1

    @property
    def needs(self) -> Want:
        if self.alone:
            return self._stylizer(0).needs
        return Want.CONTENT | Want.SEMANTIC

    def forward(
        self, content: Annotated[Tensor, "N C"], semantic: Annotated[Tensor, "N D"] | None
    ) -> Annotated[Tensor, "N C"]:
        """Each point by the stylizers of its regions; the others are not called for it."""
        if self.alone:
            only: Tensor = self._stylizer(0)(content, semantic)
            return only
        assert semantic is not None, "Want.SEMANTIC was asked for"
        share = self.weight(semantic).to(content)
        out = torch.zeros_like(content)
        # Points outside of a stylizer's regions are not computed by it.
        for p, column in enumerate(share.T.contiguous()):
            inside = column.nonzero().squeeze(1)
            styled: Tensor = self._stylizer(p)(
                content.index_select(0, inside), semantic.index_select(0, inside)
            )
            out.index_add_(0, inside, styled * column.index_select(0, inside)[:, None])
        return out

    def match(self, semantic: Annotated[Tensor, "N D"]) -> Annotated[Tensor, "N T"]:
        """The stylizers' own matches, each in its place among the codes of all references."""
        if self.alone:
            share = semantic.new_ones(len(semantic), 1)
        else:
            share = self.weight(semantic)
        out = share.new_zeros(len(semantic), self.codes.shape[1])
        for p in range(len(self.stylizers)):
            out[:, self.codes[p]] += share[:, p, None] * self._stylizer(p).match(semantic)
        return out

    def _stylizer(self, p: int) -> Stylizer:
        stylizer = self.stylizers[p]
        assert isinstance(stylizer, Stylizer)  # nn.ModuleList forgets it
        return stylizer


class Painted(NamedTuple):
    """What one part of a mix does to points."""

    features: Annotated[Tensor, "N C"]
    belongs: Annotated[Tensor, "N K"] | None
    """Membership, once known to the stylizer: it serves regions, colours and light."""
    strength: float | Annotated[Tensor, "N 1"]
    matched: float | Annotated[Tensor, "N 1"]
    """Strength of what is matched: all but what is measured."""
    painted: float | Annotated[Tensor, "N 1"]
    """`matched`, as far as points are sure of their match."""
    paint: Annotated[Tensor, "N 1"] | None
    """How sure points are; None = all are."""
    measured: Measured | None = None
    """Light of the very place; None where no reference shows it."""


def _mixed_features(
    parts: Sequence["Restyle"], features: Sequence[Annotated[Tensor, "N C"]]
) -> tuple[Annotated[Tensor, "N C"], float]:
    """Features and luminance of a mix by the shares of its parts; one alone is left as it is, bit for bit."""
    if len(parts) == 1:
        return features[0], parts[0].luminance
    mixed = torch.zeros_like(features[0])
    luminance = 0.0
    for part, styled in zip(parts, features, strict=True):
        mixed = mixed + part.share * styled
        luminance += part.share * part.luminance
    return mixed, luminance


@dataclass(frozen=True)
class Restyle:
    """A stylizer and how strongly it acts, 0 to 1; at 0 it is never called."""

    stylizer: Stylizer
    strength: float = 1.0
    regions: RegionWeight | None = None
    """Strength of each region, times `strength`; None = all 1."""
    features: float = 1.0
    """Share of the stylizer's change of features at full strength."""
    colours: ColourMaps | None = None
    """Change of colours behind the decoder at full strength; None = none."""
    luminance: float = 0.0
    """Share of the scene's own luminance that is kept."""
    light: Light | None = None
    """What points take, as far as they are not sure of their match, instead of all that the stylizer and
    `colours` do; None = all are sure.
    """
    placed: PlacedLight | None = None
    """Light of the very place, in the place of part of all this; None where no reference shows it."""
    share: float = 1.0
    """Its part of the mix; those of all parts sum to 1."""
    places: tuple[tuple[Place, "Restyle"], ...] = ()
    """Stylizers and colours of places, for Gaussians alone, each over those before it; of these no other
    field counts.
    """
    sun: SunConfig | None = None
    """Light that falls on Gaussians once they have their colours, at any strength of these; None = the captured
    one.
    """
    others: tuple["Restyle", ...] = ()
    """The other parts of the mix, which have none themselves."""

    @property
    def parts(self) -> tuple["Restyle", ...]:
        """All parts of the mix, without their others."""
        return (replace(self, others=()), *self.others)

    @property
    def idle(self) -> bool:
        """It changes nothing: the renderer need not ask."""
        return self.painted_nothing and not self.lit

    @property
    def painted_nothing(self) -> bool:
        """Colours stay as they are, but for a light that may fall on them."""
        return all(part.strength == 0 for part in self.parts if part.share > 0)

    @property
    def lit(self) -> bool:
        """Another light falls on the scene."""
        return any(part.sun is not None for part in self.parts if part.share > 0)

    @property
    def lights(self) -> tuple[tuple[float, SunConfig | None], ...]:
        """The lights of all parts with their shares; None = the captured one."""
        return tuple((part.share, part.sun) for part in self.parts if part.share > 0)

    @property
    def needs(self) -> Want:
        """Features of points that it reads."""
        # What is idle needs nothing: semantics of points cost a second field.
        needs = Want.CONTENT
        for part in self.parts:
            if part.share > 0 and part.strength > 0:
                needs |= part.stylizer.needs
                if part.colours is not None:
                    needs |= part.colours.needs
                if part.light is not None or part.placed is not None:
                    needs |= Want.SEMANTIC
                if part.regions is not None and part.regions.membership.divided:
                    needs |= Want.SEMANTIC
        return needs

    @property
    def faded(self) -> "Restyle":
        """The scene as it is, in the terms of this look: what it fades in from."""
        others = tuple(replace(part, strength=0.0, sun=None) for part in self.others)
        return replace(self, strength=0.0, sun=None, others=others)

    def mixed(self, other: "Restyle", at: float) -> "Restyle":
        """The look on the way to another, which lies at 1. Raises ConfigError outside [0, 1]."""
        between("at", at, 0.0, 1.0)
        # Both mixes become parts of one; a look is its first part, which carries the others.
        first, *rest = (
            *(replace(part, share=part.share * (1 - at)) for part in self.parts),
            *(replace(part, share=part.share * at) for part in other.parts),
        )
        return replace(first, others=tuple(rest))

    def colour(
        self,
        decoder: Decoder,
        content: Annotated[Tensor, "N C"],
        semantic: Annotated[Tensor, "N D"] | None,
        plain: Annotated[Tensor, "N 3"] | None = None,
        points: Annotated[Tensor, "N 3"] | None = None,
    ) -> Annotated[Tensor, "N 3"]:
        """Colours of points in this look, in [0, 1]; `plain` are those of their content, and `points` where they
        lie (world units), where these are known.
        """
        parts = []
        for part in self.parts:
            if part.share > 0:
                parts.append(part)
        painted = []
        for part in parts:
            painted.append(part.painted(content, semantic, points))
        mixed, luminance = _mixed_features(parts, [each.features for each in painted])
        colour: Tensor = decoder(mixed)
        active = []
        for part, each in zip(parts, painted, strict=True):
            if part.strength > 0:
                active.append((part, each))
        own = colour
        if luminance > 0 or any(each.paint is not None or each.measured is not None for _, each in active):
            own = decoder(content) if plain is None else plain
        # Colours: the maps move what was decoded, light moves the scene's own colours.
        changes = []
        for part, each in active:
            if part.colours is not None:
                change = part.colours(colour, semantic, each.belongs)
                changes.append(part.share * each.painted * change)
            if part.light is not None:
                lit = part.light(own, semantic, each.paint, each.belongs)
                changes.append(part.share * each.matched * lit)
            if each.measured is not None:
                changes.append(part.share * each.strength * each.measured.change(own))
        if changes:
            colour = (colour + torch.stack(changes).sum(0)).clamp(0, 1)
        if luminance > 0:
            return keep_luminance(colour, own, luminance)
        return colour

    def painted(
        self,
        content: Annotated[Tensor, "N C"],
        semantic: Annotated[Tensor, "N D"] | None,
        points: Annotated[Tensor, "N 3"] | None = None,
    ) -> "Painted":
        """What this part alone does to features: its stylizer, by its strength and by how sure points are of
        their match.
        """
        if self.strength == 0:
            return Painted(content, None, 0.0, 0.0, 0.0, None)
        moved, belongs = self.stylizer.shared(content, semantic)
        strength: float | Tensor = self.strength
        if self.regions is not None:
            # Without semantics there is one region, and nothing to look up.
            if semantic is None:
                there = content[:, :0]
            else:
                there = semantic
            weight: Tensor = self.regions(there, belongs)
            strength = strength * weight
        matched = strength
        measured = None
        if self.placed is not None:
            assert semantic is not None, "Want.SEMANTIC was asked for"
            measured = self.placed(semantic, belongs, points)
            matched = strength * (1 - measured.share.to(content))
        painted = matched
        paint = None
        if self.light is not None:
            assert semantic is not None, "Want.SEMANTIC was asked for"
            paint = self.light.paint(semantic, belongs)
            painted = matched * paint.to(content)
        # At 0 the scene's own features, at 1 the styled ones, both bit for bit.
        share = self.features * painted
        if isinstance(share, Tensor):
            share = share.to(content)
        moved = torch.lerp(content, moved, share)
        return Painted(moved, belongs, strength, matched, painted, paint, measured)

    def match(
        self, semantic: Annotated[Tensor, "N D"], points: Annotated[Tensor, "N 3"] | None = None
    ) -> Annotated[Tensor, "N T"]:
        """Share that each point takes of each style code, those of all parts one after the other; rows sum to
        1 at most.

        What is missing to 1 is what regions keep; the overall strength does not count. Without `points`
        (world units) neither do places.
        """
        # A place lies over what is below it; what regions keep is taken from all alike.
        taken = []
        for part in self.parts:
            own = part.stylizer.match(semantic)
            if points is not None:
                for place, other in part.places:
                    own = torch.lerp(
                        own, other.stylizer.match(semantic), place_weight(place, points)[:, None]
                    )
            if part.regions is not None:
                own = own * part.regions(semantic)
            taken.append(part.share * own)
        return torch.cat(taken, 1)

    def confidence(
        self, semantic: Annotated[Tensor, "N D"], points: Annotated[Tensor, "N 3"] | None = None
    ) -> Annotated[Tensor, "N 1"]:
        """How sure points are of what they take, in [0, 1]; 1 where nobody asks. `points` as of `match`."""

        def own_confidence(part: "Restyle") -> Annotated[Tensor, "N 1"]:
            ones = semantic.new_ones(len(semantic), 1)
            if part.light is None:
                return ones
            return part.light.confidence(semantic).to(semantic)

        total = semantic.new_zeros(len(semantic), 1)
        for part in self.parts:
            own = own_confidence(part)
            if points is not None:
                for place, other in part.places:
                    own = torch.lerp(own, own_confidence(other), place_weight(place, points)[:, None])
            total = total + part.share * own
        return total
