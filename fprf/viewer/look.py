"""Looks: how a scene is coloured, as immutable values, and what the page's controls make of them. `style_config` translates one
into the terms of `style.json`."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple, TypeAlias

from ..checks import at_least, between, positive
from ..io.images import Picture
from ..plugins.stylizers.config import RegionToneConfig
from ..style.config import StyleConfig
from ..style.dictionary import Reference

RegionAction: TypeAlias = Literal["pin", "forbid", "keep"]


@dataclass(frozen=True, eq=False)
class Photograph:
    """A photograph on the shelf, encoded once; compared by identity."""

    number: int
    """Its name in requests of the page."""
    name: str
    path: Path
    thumbnail: Picture
    reference: Reference


class RegionRule(NamedTuple):
    """A style that a region may take; `photograph` is None where the region is kept as it is."""

    region: int
    action: RegionAction
    photograph: Photograph | None


@dataclass(frozen=True, kw_only=True)
class Look:
    """Colours of a scene; equal looks are the same style. Ranges are those of `StyleConfig`."""

    mix: tuple[tuple[Photograph, float], ...] = ()
    """Photographs with their weights, above 0, in the order of the shelf; none = the scene as it is."""
    strength: float = 1.0
    bold: float = StyleConfig.bold
    """How far paint goes where the match is not sure, in [0, 1]."""
    luminance: float = 0.0
    temperature: float = 0.2
    """Of the matching of regions and codes, relative; low = each region takes from what is most like it."""
    clusters: int = 20
    blend: float = 0.1
    smoothness: float = RegionToneConfig.smoothness
    """Smoothness of styles between neighbouring regions without an edge between them, at least 0."""
    rules: frozenset[RegionRule] = frozenset()

    def __post_init__(self) -> None:
        for name in ("strength", "bold", "blend", "luminance"):
            between(name, getattr(self, name), 0.0, 1.0)
        at_least("clusters", self.clusters, 1)
        positive("temperature", self.temperature)
        at_least("smoothness", self.smoothness, 0.0)
        for _, weight in self.mix:
            positive("weights", weight)

    @property
    def plain(self) -> bool:
        """True for the scene as it was captured."""
        return not self.mix or self.strength == 0


def only(look: Look, photograph: Photograph) -> Look:
    """The look with one photograph alone."""
    return _valid_rules(replace(look, mix=((photograph, 1.0),)))


def set_weight(look: Look, photograph: Photograph, weight: float, shelf: Iterable[Photograph]) -> Look:
    """The look with another weight of a photograph; 0 removes it together with the rules that name it."""
    weights = dict(look.mix) | {photograph: weight}
    mix = tuple((each, weights[each]) for each in shelf if weights.get(each, 0.0) > 0)
    return _valid_rules(replace(look, mix=mix))


def set_rule(look: Look, region: int, action: RegionAction | None, photograph: Photograph | None = None) -> Look:
    """The look with a rule for a region; None removes its rules. Pinning and keeping replace the rules it had.

    A region for which every photograph would be forbidden loses its rules instead.
    """
    mine = {rule for rule in look.rules if rule.region == region}
    rest = look.rules - mine
    if action is None:
        return replace(look, rules=rest)
    new = {RegionRule(region, action, None if action == "keep" else photograph)}
    if action == "forbid":
        new |= {rule for rule in mine if rule.action == "forbid"}
        if {rule.photograph for rule in new} >= {each for each, _ in look.mix}:
            return replace(look, rules=rest)
    return replace(look, rules=rest | new)


def renumbered(look: Look, regions: Sequence[int]) -> Look:
    """The look with region r as regions[r]: regions were measured again."""
    return replace(look, rules=frozenset(rule._replace(region=regions[rule.region]) for rule in look.rules))


def style_config(look: Look, stylizer: RegionToneConfig | None = None) -> StyleConfig:
    """The look as a style; references in the order of the mix."""
    number = {photograph: i for i, (photograph, _) in enumerate(look.mix)}

    def order(rule: RegionRule) -> tuple[int, str, int]:
        return rule.region, rule.action, -1 if rule.photograph is None else number.get(rule.photograph, -1)

    texts: dict[str, list[str]] = {"pin": [], "forbid": [], "keep": []}
    for rule in sorted(look.rules, key=order):
        if rule.photograph is None:
            texts[rule.action].append(str(rule.region))
        elif rule.photograph in number:
            texts[rule.action].append(f"{rule.region}={number[rule.photograph]}")
    return StyleConfig(
        references=tuple(photograph.path for photograph, _ in look.mix),
        weights=tuple(weight for _, weight in look.mix),
        stylizer=replace(stylizer or RegionToneConfig(), temperature=look.temperature, smoothness=look.smoothness),
        clusters=look.clusters,
        blend=look.blend,
        strength=look.strength,
        bold=look.bold,
        luminance=look.luminance,
        pin=tuple(texts["pin"]),
        forbid=tuple(texts["forbid"]),
        keep=tuple(texts["keep"]),
    )


def _valid_rules(look: Look) -> Look:
    """The look without rules for photographs that are not in its mix."""
    mix = {photograph for photograph, _ in look.mix}
    return replace(look, rules=frozenset(rule for rule in look.rules if rule.photograph is None or rule.photograph in mix))
