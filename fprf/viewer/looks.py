"""What the page's controls say, as values: a look is everything that decides how the scene is coloured.

Looks never change and can be compared and hashed: equal looks are the same style, an older one can be kept, returned to, or
lie at the end of a fade. `style_of` says a look in the terms of `style.json`.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeAlias

from ..checks import at_least, between, positive
from ..io.images import Picture
from ..plugins.stylizers.config import RegionToneConfig
from ..style.config import StyleConfig
from ..style.dictionary import Reference
from ..style.presets import PRESETS

__all__ = ["Card", "Look", "Order", "Verb", "moved", "only", "ordered", "preset", "settled", "style_of", "weighed"]

Verb: TypeAlias = Literal["pin", "forbid", "keep"]


@dataclass(frozen=True, eq=False)
class Card:
    """A photograph on the shelf, encoded once; as a key it is itself alone."""

    number: int
    """What the page calls it by."""
    name: str
    path: Path
    picture: Picture
    """A thumbnail."""
    reference: Reference


class Order(NamedTuple):
    """What is wanted of a region; `card` is None where it is to be kept."""

    region: int
    verb: Verb
    card: Card | None


@dataclass(frozen=True, kw_only=True)
class Look:
    """How the scene is coloured. Ranges are those of `StyleConfig`."""

    mix: tuple[tuple[Card, float], ...] = ()
    """Photographs with their weights, above 0, in the order of the shelf; none = the scene as it is."""
    strength: float = 1.0
    temperature: float = 0.2
    """Of the matching of regions and codes, relative; low = each region takes from what is most like it."""
    clusters: int = 20
    blend: float = 0.1
    luminance: float = 0.0
    smoothness: float = RegionToneConfig.smoothness
    """How alike regions are styled that meet without an edge of colour, at least 0."""
    orders: frozenset[Order] = frozenset()
    towards: "Look | None" = None
    """Another look, and how far the scene is on the way to it, in [0, 1]; that look has none itself."""
    at: float = 0.0

    def __post_init__(self) -> None:
        for name in ("strength", "blend", "luminance", "at"):
            between(name, getattr(self, name), 0.0, 1.0)
        at_least("clusters", self.clusters, 1)
        positive("temperature", self.temperature)
        at_least("smoothness", self.smoothness, 0.0)
        for _, weight in self.mix:
            positive("weights", weight)

    @property
    def plain(self) -> bool:
        """It is the scene as it was captured."""
        return (not self.mix or self.strength == 0) and (self.towards is None or self.at == 0)


def only(look: Look, card: Card) -> Look:
    """The look with one photograph alone; wishes about others are void."""
    return _held(replace(look, mix=((card, 1.0),)))


def weighed(look: Look, card: Card, weight: float, shelf: Iterable[Card]) -> Look:
    """The look with another weight of a photograph; 0 takes it out, and with it what regions were to take of it."""
    weights = dict(look.mix) | {card: weight}
    mix = tuple((each, weights[each]) for each in shelf if weights.get(each, 0.0) > 0)
    return _held(replace(look, mix=mix))


def ordered(look: Look, region: int, verb: Verb | None, card: Card | None = None) -> Look:
    """The look with a wish about a region; None frees it. Pinning and keeping replace all that was wished of it.

    A region that would be forbidden every photograph is freed instead: something it must take.
    """
    mine = {order for order in look.orders if order.region == region}
    rest = look.orders - mine
    if verb is None:
        return replace(look, orders=rest)
    new = {Order(region, verb, None if verb == "keep" else card)}
    if verb == "forbid":
        new |= {order for order in mine if order.verb == "forbid"}
        if {order.card for order in new} >= {each for each, _ in look.mix}:
            return replace(look, orders=rest)
    return replace(look, orders=rest | new)


def preset(look: Look, name: str) -> Look:
    """The look with the values of a preset (`PRESETS`); what the preset does not set stays."""
    values: dict[str, Any] = {path.rpartition(".")[2]: value for path, value in PRESETS[name].items()}
    return replace(look, **values)


def settled(look: Look) -> Look:
    """The same look, going towards another one only where both are styles and it lies between them.

    What is on the way to the scene as it is, or comes from it, is simply less strong: features are mixed linearly.
    """
    if look.towards is None or look.at == 0:
        return replace(look, towards=None, at=0.0)
    end, start = look.towards, replace(look, towards=None, at=0.0)
    if look.at == 1 or start.plain:
        return replace(end, strength=end.strength * look.at)
    return replace(start, strength=start.strength * (1 - look.at)) if end.plain else look


def moved(look: Look, regions: Sequence[int]) -> Look:
    """The look with its wishes about regions by their new numbers."""
    orders = frozenset(order._replace(region=regions[order.region]) for order in look.orders)
    towards = None if look.towards is None else moved(look.towards, regions)
    return replace(look, orders=orders, towards=towards)


def style_of(look: Look, stylizer: RegionToneConfig | None = None) -> StyleConfig:
    """The look as a style, without what it goes towards; references in the order of the mix."""
    number = {card: i for i, (card, _) in enumerate(look.mix)}
    wishes: dict[str, list[str]] = {"pin": [], "forbid": [], "keep": []}
    for order in sorted(look.orders, key=lambda each: (each.region, each.verb, number.get(each.card, -1) if each.card else -1)):
        if order.card is None:
            wishes[order.verb].append(str(order.region))
        elif order.card in number:
            wishes[order.verb].append(f"{order.region}={number[order.card]}")
    return StyleConfig(
        references=tuple(card.path for card, _ in look.mix),
        weights=tuple(weight for _, weight in look.mix),
        stylizer=replace(stylizer or RegionToneConfig(), temperature=look.temperature, smoothness=look.smoothness),
        clusters=look.clusters,
        blend=look.blend,
        strength=look.strength,
        luminance=look.luminance,
        pin=tuple(wishes["pin"]),
        forbid=tuple(wishes["forbid"]),
        keep=tuple(wishes["keep"]),
    )


def _held(look: Look) -> Look:
    """Without wishes for photographs that are no longer in the mix."""
    cards = {card for card, _ in look.mix}
    return replace(look, orders=frozenset(order for order in look.orders if order.card is None or order.card in cards))
