"""The look of a scene in a style: features to styled features, strengths and colours, point by point.

A look is one stylizer with its strengths, or a mix of several: features, strengths and luminances are mixed linearly at every
point, so that a style fades into another without either's edges showing.
"""

import hashlib
import io
import pickle
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, TypeAlias

import torch
from torch import Tensor, nn

from ..checks import between
from ..errors import UsageError
from ..interfaces import Decoder, Stylizer
from ..ops import mixture
from ..ops.precision import double
from ..types import Want
from .config import Place
from .dictionary import StyleDictionary, blend_codes, choose
from .light import Light, luma
from .scene_style import Membership, RegionWeight, SceneStyle
from .statistics import mix, monge, symmetric_root

if TYPE_CHECKING:
    from ..plugins.stylizers.config import StylizerConfig


def blend_strength(
    content: Annotated[Tensor, "N C"], styled: Annotated[Tensor, "N C"], strength: float | Annotated[Tensor, "N 1"]
) -> Annotated[Tensor, "N C"]:
    """Between the scene's features (strength 0, bit for bit) and the styled ones (strength 1, bit for bit), all finite.

    Raises UsageError for one strength outside [0, 1].
    """
    if isinstance(strength, Tensor):
        return torch.lerp(content, styled, strength.to(content))
    if not 0.0 <= strength <= 1.0:
        raise UsageError(f"strength: {strength} must lie in [0, 1]")
    if strength == 0.0:
        return content
    if strength == 1.0:
        return styled
    return torch.lerp(content, styled, strength)


def keep_luminance(
    styled: Annotated[Tensor, "N 3"], own: Annotated[Tensor, "N 3"], share: float | Annotated[Tensor, "N 1"]
) -> Annotated[Tensor, "N 3"]:
    """Styled colours whose luma is moved towards the scene's own by `share`: 0 changes nothing, 1 gives luma(own).

    All in [0, 1]. A colour that would leave that range fades towards grey just as far as it must, which leaves its luma.
    """
    before = luma(styled)
    shift = share * (luma(own) - before)
    moved, level = styled + shift, before + shift
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
        first, along = corners[:-1], corners[1:] - corners[:-1]
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


_DRAWS = 512
"""Points drawn of each region: means of colours are known to a fiftieth of their deviation."""
_GAIN = 3.0
"""No direction of colour is amplified more: a flat region's noise must stay unseen."""
_QUIET = 2e-4
"""Variance added on both sides: a deviation of four 8-bit steps, below which colours have no shape worth carrying over."""


class ColourMaps(nn.Module):
    """An affine map of colours for each region, mixed by membership."""

    matrix: Annotated[Tensor, "K 3 3"]
    bias: Annotated[Tensor, "K 3"]
    origin: Annotated[Tensor, "3"]

    def __init__(
        self, scene: SceneStyle, matrix: Annotated[Tensor, "K 3 3"], bias: Annotated[Tensor, "K 3"], share: float
    ) -> None:
        super().__init__()
        self.membership = Membership(scene)
        # The identity is taken out: what is small stays exact, and a map that changes nothing is nothing.
        self.register_buffer("matrix", (share * (matrix - torch.eye(3).to(matrix))).float())
        self.register_buffer("bias", (share * bias).float())
        self.register_buffer("origin", torch.zeros(3))

    @property
    def needs(self) -> Want:
        """Semantics only where there is more than one region."""
        return Want.CONTENT | Want.SEMANTIC if self.membership.divided else Want.CONTENT

    def forward(
        self,
        colour: Annotated[Tensor, "N 3"],
        semantic: Annotated[Tensor, "N D"] | None,
        belongs: Annotated[Tensor, "N K"] | None = None,
    ) -> Annotated[Tensor, "N 3"]:
        """Change to add to colours in [0, 1] so that they lie in the style and in [0, 1].

        `belongs` is the points' membership, where somebody has it.
        """
        if belongs is None:
            belongs = self.membership(colour[:, :0] if semantic is None else semantic)
        change = mixture.affine(colour.to(self.bias), belongs.to(self.bias), self.matrix, self.bias, centre=self.origin)
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
    """The maps of a stylizer whose change of features counts `features`; None where nothing is to be carried over.

    `share`, in [0, 1], is how much of the way colours go. Regions and codes are matched by the stylizer itself; `smoothing`
    (`region_smoothing`) is what it smooths its matches by. A dictionary without the colours of its photographs (that of the
    scene itself) carries nothing over.
    """
    if share == 0 or dictionary.colour_mean is None or dictionary.colour_covariance is None:
        return None
    mean, covariances = decoded_colours(stylizer, scene, decoder, features=features)
    whole = mix(mean, covariances, scene.share)
    at = mean.new_full((len(mean),), dictionary.blend)
    mean, covariances = blend_codes(mean, covariances, *whole, at)
    if smoothing is not None:
        mean, covariances = smoothing.to(mean) @ mean, torch.einsum("kl,lij->kij", smoothing.to(mean), covariances)
    table = double(stylizer.region_match(scene.keys.to(_device(stylizer, scene)))).to(mean)
    return ColourMaps(scene, *carried_colours(mean, covariances, table, dictionary), share)


def carried_colours(
    mean: Annotated[Tensor, "K 3"],
    covariances: Annotated[Tensor, "K 3 3"],
    table: Annotated[Tensor, "K T"],
    dictionary: StyleDictionary,
) -> tuple[Annotated[Tensor, "K 3 3"], Annotated[Tensor, "K 3"]]:
    """A and b of each region, float64, c' = c A + b: from the colours that it has to those of the codes that it takes.

    `table` holds the shares of the codes, and the dictionary the colours of its photographs.
    """
    assert dictionary.colour_mean is not None and dictionary.colour_covariance is not None
    there, spread = double(dictionary.colour_mean).to(mean), double(dictionary.colour_covariance).to(mean)
    if len(mean) == 1:  # an undivided scene takes its codes together, with what lies between them
        target, wide = (part[None] for part in mix(there, spread, table[0]))
    else:
        target, wide = table @ there, torch.einsum("kt,tij->kij", table, spread)
    floor = _QUIET * torch.eye(3).to(mean)
    matrix = monge(covariances + floor, wide + floor, gain=_GAIN)
    return matrix, target - torch.einsum("kc,kcd->kd", mean, matrix)


@torch.no_grad()
def decoded_colours(
    stylizer: Stylizer, scene: SceneStyle, decoder: Decoder, *, features: float = 1.0
) -> tuple[Annotated[Tensor, "K 3"], Annotated[Tensor, "K 3 3"]]:
    """Mean and covariance of each region's colours, float64, after the stylizer and the decoder."""
    device = _device(stylizer, scene)
    draw = torch.randn(_DRAWS // 2, scene.mean.numel(), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    draw = torch.cat([draw, -draw])  # in pairs: the features' mean is met exactly
    means, covariances = [], []
    for k in range(len(scene.share)):
        root = symmetric_root(double(scene.region_covariance[k])).cpu()
        points = (double(scene.region_mean[k]).cpu() + draw @ root).float().to(device)
        key = scene.keys[k].to(device).expand(len(points), -1)
        styled = blend_strength(points, stylizer(points, key if Want.SEMANTIC in stylizer.needs else None), features)
        colour = double(decoder(styled)).cpu()
        means.append(colour.mean(0))
        covariances.append(torch.cov(colour.T, correction=0))
    return torch.stack(means), torch.stack(covariances)


def own_colours(
    stylizer: Stylizer, scene: SceneStyle, decoder: Decoder | None
) -> tuple[Annotated[Tensor, "K 3"], Annotated[Tensor, "K 3 3"]]:
    """Mean and covariance of each region's own colours, float64; without a decoder they are the content."""
    if decoder is None:
        return double(scene.region_mean), double(scene.region_covariance)
    return decoded_colours(stylizer, scene, decoder, features=0.0)


def _device(stylizer: Stylizer, scene: SceneStyle) -> torch.device:
    return next(stylizer.buffers(), scene.mean).device


def regional(
    dictionary: StyleDictionary, scene: SceneStyle, allowed: Annotated[Tensor, "K references"], config: "StylizerConfig"
) -> Stylizer:
    """The stylizer that heeds which references each region may take from; that of all of them where nothing is excluded."""
    if bool(allowed.all()):
        return config.build(dictionary=dictionary, scene=scene)
    if config.handles_allowed_references:
        return config.build(dictionary=dictionary._replace(allowed=allowed), scene=scene)
    rows = [tuple(row) for row in allowed.tolist()]
    choices = sorted(set(rows))
    made = [choose(dictionary, torch.tensor(chosen)) for chosen in choices]
    codes, of = torch.stack([codes for _, codes in made]), torch.tensor([choices.index(row) for row in rows])
    return RegionStylizer(scene, [config.build(dictionary=part, scene=scene) for part, _ in made], codes, of)


class RegionStylizer(Stylizer):
    """P stylizers, each for the regions of one choice of references."""

    codes: Annotated[Tensor, "P T"]

    def __init__(
        self,
        scene: SceneStyle,
        parts: list[Stylizer],
        codes: Annotated[Tensor, "P T"],
        of: Annotated[Tensor, "K"],
    ) -> None:
        super().__init__()
        self.parts = nn.ModuleList(parts)
        self.weight = RegionWeight(scene, nn.functional.one_hot(of, len(parts)))
        self.register_buffer("codes", codes)
        self.alone = len(parts) == 1

    @property
    def needs(self) -> Want:
        return self._part(0).needs if self.alone else Want.CONTENT | Want.SEMANTIC

    def forward(self, content: Annotated[Tensor, "N C"], semantic: Annotated[Tensor, "N D"] | None) -> Annotated[Tensor, "N C"]:
        """Each point by the stylizers of its regions; the others are not called for it."""
        if self.alone:
            only: Tensor = self._part(0)(content, semantic)
            return only
        assert semantic is not None, "Want.SEMANTIC was asked for"
        share = self.weight(semantic).to(content)
        out = torch.zeros_like(content)
        for p, column in enumerate(share.T.contiguous()):
            inside = column.nonzero().squeeze(1)
            styled: Tensor = self._part(p)(content.index_select(0, inside), semantic.index_select(0, inside))
            out.index_add_(0, inside, styled * column.index_select(0, inside)[:, None])
        return out

    def match(self, semantic: Annotated[Tensor, "N D"]) -> Annotated[Tensor, "N T"]:
        """The parts' own matches, each in its place among the codes of all references."""
        share = semantic.new_ones(len(semantic), 1) if self.alone else self.weight(semantic)
        out = share.new_zeros(len(semantic), self.codes.shape[1])
        for p in range(len(self.parts)):
            out[:, self.codes[p]] += share[:, p, None] * self._part(p).match(semantic)
        return out

    def _part(self, p: int) -> Stylizer:
        part = self.parts[p]
        assert isinstance(part, Stylizer)  # nn.ModuleList forgets it
        return part


Applied: TypeAlias = tuple[Annotated[Tensor, "N C"], float | Annotated[Tensor, "N 1"], float]
"""Features, strength (one, or one a point) and luminance that is kept."""


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
    """What points take, as far as they are not sure of their match, instead of all that the stylizer and `colours` do; None =
    all are sure."""
    share: float = 1.0
    """Its part of the mix; those of all parts sum to 1."""
    places: tuple[tuple[Place, "Restyle"], ...] = ()
    """Stylizers and colours of places, for Gaussians alone, each over those before it; of these no other field counts."""
    others: tuple["Restyle", ...] = ()
    """The other parts of the mix, which have none themselves."""

    @property
    def parts(self) -> tuple["Restyle", ...]:
        """All parts of the mix, without their others."""
        return (replace(self, others=()), *self.others)

    @property
    def digest(self) -> str:
        """A key of all that it does: of every number in it."""
        file = io.BytesIO()
        _Pickler(file).dump(self)
        return hashlib.sha256(file.getvalue()).hexdigest()

    @property
    def idle(self) -> bool:
        """It changes nothing: the renderer need not ask."""
        return all(part.strength == 0 for part in self.parts if part.share > 0)

    @property
    def needs(self) -> Want:
        """Features of points that it reads."""
        needs = Want.CONTENT
        for part in self.parts:
            if part.share > 0 and part.strength > 0:
                needs |= part.stylizer.needs
                if part.colours is not None:
                    needs |= part.colours.needs
                if part.light is not None or (part.regions is not None and part.regions.membership.divided):
                    needs |= Want.SEMANTIC
        return needs

    @property
    def faded(self) -> "Restyle":
        """The scene as it is, in the terms of this look: what it fades in from."""
        return replace(self, strength=0.0, others=tuple(replace(part, strength=0.0) for part in self.others))

    def mixed(self, other: "Restyle", at: float) -> "Restyle":
        """The look on the way to another, which lies at 1. Raises ConfigError outside [0, 1]."""
        between("at", at, 0.0, 1.0)
        first, *rest = (
            *(replace(part, share=part.share * (1 - at)) for part in self.parts),
            *(replace(part, share=part.share * at) for part in other.parts),
        )
        return replace(first, others=tuple(rest))

    def colour(
        self, decoder: Decoder, content: Annotated[Tensor, "N C"], semantic: Annotated[Tensor, "N D"] | None
    ) -> Annotated[Tensor, "N 3"]:
        """Colours of points in this look, in [0, 1]."""
        shown = [(part, part._alone(content, semantic)) for part in self.parts if part.share > 0]
        styled, _, luminance = _mix([(part.share, acting.applied) for part, acting in shown])
        colour: Tensor = decoder(styled)
        lit = any(acting.paint is not None for _, acting in shown)
        own = decoder(content) if luminance > 0 or lit else colour
        changes = (change for part, acting in shown for change in part._recoloured(colour, own, semantic, acting))
        change = [x for x in changes if x is not None]
        if change:
            colour = (colour + torch.stack(change).sum(0)).clamp(0, 1)
        return keep_luminance(colour, own, luminance) if luminance > 0 else colour

    def applied(self, content: Annotated[Tensor, "N C"], semantic: Annotated[Tensor, "N D"] | None) -> Applied:
        """The features with all strengths applied, and what a decoder must know besides."""
        return _mix([(part.share, part._alone(content, semantic).applied) for part in self.parts if part.share > 0])

    def match(
        self, semantic: Annotated[Tensor, "N D"], points: Annotated[Tensor, "N 3"] | None = None
    ) -> Annotated[Tensor, "N T"]:
        """Share that each point takes of each style code, those of all parts one after the other; rows sum to 1 at most.

        What is missing to 1 is what regions keep; the overall strength does not count. Without `points` (world units) neither
        do places.
        """
        taken = []
        for part in self.parts:
            own = part.stylizer.match(semantic)
            if points is not None:
                for place, other in part.places:
                    own = torch.lerp(own, other.stylizer.match(semantic), place_weight(place, points)[:, None])
            taken.append(part.share * (own if part.regions is None else own * part.regions(semantic)))
        return torch.cat(taken, 1)

    def confidence(
        self, semantic: Annotated[Tensor, "N D"], points: Annotated[Tensor, "N 3"] | None = None
    ) -> Annotated[Tensor, "N 1"]:
        """How sure points are of what they take, in [0, 1]; 1 where nobody asks. `points` as of `match`."""
        total = semantic.new_zeros(len(semantic), 1)
        for part in self.parts:
            own = part._sure(semantic)
            if points is not None:
                for place, other in part.places:
                    own = torch.lerp(own, other._sure(semantic), place_weight(place, points)[:, None])
            total = total + part.share * own
        return total

    def _sure(self, semantic: Annotated[Tensor, "N D"]) -> Annotated[Tensor, "N 1"]:
        return semantic.new_ones(len(semantic), 1) if self.light is None else self.light.confidence(semantic).to(semantic)

    def _alone(self, content: Tensor, semantic: Tensor | None) -> "_Acting":
        """Points in this part's style."""
        if self.strength == 0:
            return _Acting((content, 0.0, self.luminance), None, 0.0, None)
        styled, belongs = self.stylizer.shared(content, semantic)
        strength, share = self._strength(content, semantic, belongs), None
        if self.light is not None:
            assert semantic is not None, "Want.SEMANTIC was asked for"
            share = self.light.paint(semantic, belongs)
            strength = strength * share.to(content)
        paint = self.features * strength
        return _Acting((blend_strength(content, styled, paint), paint, self.luminance), belongs, strength, share)

    def _strength(
        self, points: Annotated[Tensor, "N X"], semantic: Tensor | None, belongs: Tensor | None
    ) -> float | Annotated[Tensor, "N 1"]:
        if self.regions is None:
            return self.strength
        # Without semantics there is one region, and nothing to look up.
        weight: Tensor = self.regions(points[:, :0] if semantic is None else semantic, belongs)
        return self.strength * weight

    def _recoloured(
        self, colour: Annotated[Tensor, "N 3"], own: Annotated[Tensor, "N 3"], semantic: Tensor | None, acting: "_Acting"
    ) -> tuple[Annotated[Tensor, "N 3"] | None, Annotated[Tensor, "N 3"] | None]:
        """Changes of colours by this part, painted and lit; None = none."""
        painted = lit = None
        if self.colours is not None and self.share > 0 and self.strength > 0:
            painted = self.share * acting.strength * self.colours(colour, semantic, acting.belongs)
        if self.light is not None and acting.paint is not None and self.share > 0 and self.strength > 0:
            strength = self._strength(colour, semantic, acting.belongs)
            lit = self.share * strength * self.light(own, semantic, acting.paint, acting.belongs)
        return painted, lit


class _Acting(NamedTuple):
    """One part at points."""

    applied: Applied
    belongs: Annotated[Tensor, "N K"] | None
    """Regions, if the stylizer has computed them."""
    strength: float | Annotated[Tensor, "N 1"]
    """Of the change of colours."""
    paint: Annotated[Tensor, "N 1"] | None
    """Share of paint; None = all."""


class _Pickler(pickle.Pickler):
    """Tensors by their values alone."""

    def reducer_override(self, value: Any) -> Any:
        if isinstance(value, Tensor):
            return bytes, (value.detach().cpu().contiguous().view(-1).view(torch.uint8).numpy().tobytes(),)
        return NotImplemented


def _mix(parts: list[tuple[float, Applied]]) -> Applied:
    """Parts of a mix by their shares; one alone is left as it is, bit for bit."""
    if len(parts) == 1:
        return parts[0][1]
    styled, luminance = torch.zeros_like(parts[0][1][0]), 0.0
    strength: float | Tensor = 0.0
    for share, (features, at, kept) in parts:
        styled, luminance = styled + share * features, luminance + share * kept
        strength = strength + share * at
    return styled, strength, luminance
