"""Looks of the page as immutable values: photographs, rules for regions and what the sliders set.

`StyleConfig` holds what the sliders set, `Look.config` is the whole style in the terms of `style.json`.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Literal, NamedTuple, TypeAlias, get_args

from ..io.images import Picture
from ..light.config import SunConfig
from ..plugins import slots
from ..style.config import StyleConfig
from ..style.dictionary import Reference
from ..style.seen_sun import light_of_style
from . import messages

MapKind: TypeAlias = Literal["none", "matches", "regions"]
RegionAction: TypeAlias = Literal["pin", "forbid", "keep"]


def sliders(style: StyleConfig) -> dict[str, float]:
    """Values of the sliders of a style."""
    found = {}
    for name in get_args(messages.Slider):
        of_stylizer, _, last = name.rpartition(".")
        config = style.stylizer if of_stylizer else style
        if hasattr(config, last):
            found[name] = getattr(config, last)
    return found


@dataclass(frozen=True, eq=False)
class Photograph:
    """A photograph on the shelf, encoded once; compared by identity."""

    number: int
    """Its name in requests of the page."""
    name: str
    path: Path
    thumbnail: Picture
    """[H W 3], or [H W 4] with alpha."""
    reference: Reference


class RegionRule(NamedTuple):
    """A style that a region may take; `photograph` is None where the region is kept as it is."""

    region: int
    action: RegionAction
    photograph: Photograph | None


@dataclass(frozen=True, kw_only=True)
class Look:
    """Colours of a scene; equal looks are the same style."""

    mix: tuple[tuple[Photograph, float], ...] = ()
    """Photographs with their weights, above 0, in the order of the shelf; none = the scene as it is."""
    style: StyleConfig = StyleConfig()
    """The rest of the style; its references and rules are those of the look."""
    rules: frozenset[RegionRule] = frozenset()

    @property
    def plain(self) -> bool:
        """True for the scene as it was captured."""
        return not self.painted and not self.style.lit

    @property
    def painted(self) -> bool:
        """Photographs change its colours."""
        return bool(self.mix) and self.style.strength > 0

    @property
    def unlit(self) -> "Look":
        """The look in the captured light."""
        own = StyleConfig()
        style = self.style
        for each in fields(SunConfig):
            style = slots.replace(style, each.name, getattr(own, each.name))
        return replace(self, style=style)

    def mixed(self, mix: Iterable[tuple[Photograph, float]]) -> "Look":
        """The look with other photographs; rules that name a photograph that is not among them go."""
        mix = tuple(mix)
        kept = {None, *dict(mix)}
        rules = frozenset(rule for rule in self.rules if rule.photograph in kept)
        return replace(self, mix=mix, rules=rules)

    def weighted(self, photograph: Photograph, weight: float, shelf: Iterable[Photograph]) -> "Look":
        """The look with another weight of a photograph; 0 removes it."""
        weights = dict(self.mix) | {photograph: weight}
        return self.mixed((each, weights[each]) for each in shelf if weights.get(each, 0.0) > 0)

    def ruled(self, region: int, action: RegionAction | None, photograph: Photograph | None = None) -> "Look":
        """The look with a rule for a region; None removes its rules. Pinning and keeping replace the rules it
        had.

        A region for which every photograph would be forbidden loses its rules instead.
        """
        # Rules of other regions stay.
        mine = set()
        for rule in self.rules:
            if rule.region == region:
                mine.add(rule)
        rest = self.rules - mine
        if action is None:
            return replace(self, rules=rest)
        new = {RegionRule(region, action, None if action == "keep" else photograph)}
        # Forbidden photographs add up; every other rule takes the place of those before it.
        if action == "forbid":
            new |= {rule for rule in mine if rule.action == "forbid"}
            if {rule.photograph for rule in new} >= {each for each, _ in self.mix}:
                return replace(self, rules=rest)
        return replace(self, rules=rest | new)

    def renumbered(self, regions: Sequence[int]) -> "Look":
        """The look with region r as regions[r]: regions were measured again."""
        return replace(
            self, rules=frozenset(rule._replace(region=regions[rule.region]) for rule in self.rules)
        )

    def config(self) -> StyleConfig:
        """The look as a style; references in the order of the mix."""
        # REGION=REFERENCE, by the reference's place in the mix, as `--pin` and `--forbid` take them; `--keep`
        # takes regions.
        place = {photograph: i for i, (photograph, _) in enumerate(self.mix)}
        texts: dict[str, list[str]] = {"pin": [], "forbid": [], "keep": []}
        for region, action, photograph in self.rules:
            if photograph is None:
                texts[action].append(str(region))
            elif photograph in place:
                texts[action].append(f"{region}={place[photograph]}")
        return replace(
            self.style,
            references=tuple(photograph.path for photograph, _ in self.mix),
            weights=tuple(weight for _, weight in self.mix),
            pin=tuple(sorted(texts["pin"])),
            forbid=tuple(sorted(texts["forbid"])),
            keep=tuple(sorted(texts["keep"])),
        )


class Shown(NamedTuple):
    """A look, a map and a region to draw."""

    look: Look
    map: MapKind = "none"
    region: int | None = None
    """A region to be highlighted; the others are dimmed."""

    @property
    def unlit(self) -> "Shown":
        """The same in the captured light."""
        return self._replace(look=self.look.unlit)

    @property
    def light(self) -> SunConfig | None:
        """The light that falls on it; None = the captured one. Maps are not lit."""
        if self.map != "none" or self.region is not None:
            return None
        return light_of_style(self.look.config()).config
