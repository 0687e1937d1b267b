"""The look of a scene in a style: features to styled features, strengths and colours, point by point.

A look is one stylizer with its strengths, or a mix of several: features, strengths and luminances are mixed linearly at every
point, so that a style fades into another without either's edges showing.
"""

import hashlib
import io
import pickle
from dataclasses import dataclass, replace
from typing import Annotated, Any, NamedTuple, TypeAlias

import torch
from torch import Tensor

from ..checks import between
from ..interfaces import Decoder, Stylizer
from ..types import Want
from .colours import ColourMaps
from .config import Place
from .controls import blend_strength, keep_luminance, place_weight
from .light import Light
from .regional import RegionWeight

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
