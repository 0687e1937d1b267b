"""Everything that the page shows and its controls hold, as immutable values and functions that return changed ones.

A look decides how the scene is coloured. Looks can be compared and hashed: equal looks are the same style; an older one can
be kept, restored, or be the end of a fade. `style_config` translates a look into the terms of `style.json`.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeAlias

from ..checks import at_least, between, positive
from ..errors import UsageError
from ..io.images import Picture
from ..plugins.stylizers.config import RegionToneConfig
from ..style.config import PRESETS, StyleConfig
from ..style.dictionary import Reference
from .cameras import CameraState

RegionAction: TypeAlias = Literal["pin", "forbid", "keep"]
Map: TypeAlias = Literal["none", "matches", "regions", "depth"]
MAPS: tuple[Map, ...] = ("none", "matches", "regions", "depth")
DropMode: TypeAlias = Literal["alone", "in the mix"]
"""A photograph that is dropped becomes the style alone, or joins the others."""

SHELF = 12
"""Photographs on the shelf; the oldest that is not in use makes room."""
MIN_PIXELS, MAX_PIXELS = 64, 2048
"""Longest side of the sharpest picture, in pixels."""
_MAX_KEYS = 64


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
    """Controls of the scene's colours. Ranges are those of `StyleConfig`."""

    mix: tuple[tuple[Photograph, float], ...] = ()
    """Photographs with their weights, above 0, in the order of the shelf; none = the scene as it is."""
    strength: float = 1.0
    temperature: float = 0.2
    """Of the matching of regions and codes, relative; low = each region takes from what is most like it."""
    clusters: int = 20
    blend: float = 0.1
    luminance: float = 0.0
    smoothness: float = RegionToneConfig.smoothness
    """Smoothness of styles between neighbouring regions without an edge between them, at least 0."""
    rules: frozenset[RegionRule] = frozenset()
    towards: "Look | None" = None
    """Another look, which has none itself, and how far the scene is on the way to it, in [0, 1]."""
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
        """True for the scene as it was captured."""
        return (not self.mix or self.strength == 0) and (self.towards is None or self.at == 0)


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


def apply_preset(look: Look, name: str) -> Look:
    """The look with the values of a preset (`PRESETS`)."""
    values: dict[str, Any] = {path.rpartition(".")[2]: value for path, value in PRESETS[name].items()}
    return replace(look, **values)


def simplified(look: Look) -> Look:
    """The same look, with `towards` only where both ends are styles and the look lies between them.

    A fade from or to the scene as it is becomes less strength, since features are mixed linearly.
    """
    if look.towards is None or look.at == 0:
        return replace(look, towards=None, at=0.0)
    end, start = look.towards, replace(look, towards=None, at=0.0)
    if look.at == 1 or start.plain:
        return replace(end, strength=end.strength * look.at)
    return replace(start, strength=start.strength * (1 - look.at)) if end.plain else look


def style_config(look: Look, stylizer: RegionToneConfig | None = None) -> StyleConfig:
    """The look as a style, without `towards`; references in the order of the mix."""
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
        luminance=look.luminance,
        pin=tuple(texts["pin"]),
        forbid=tuple(texts["forbid"]),
        keep=tuple(texts["keep"]),
    )


def _valid_rules(look: Look) -> Look:
    """The look without rules for photographs that are not in its mix."""
    mix = {photograph for photograph, _ in look.mix}
    return replace(look, rules=frozenset(rule for rule in look.rules if rule.photograph is None or rule.photograph in mix))


def _renumbered(look: Look, regions: Sequence[int]) -> Look:
    rules = frozenset(rule._replace(region=regions[rule.region]) for rule in look.rules)
    towards = None if look.towards is None else _renumbered(look.towards, regions)
    return replace(look, rules=rules, towards=towards)


class ViewSettings(NamedTuple):
    """Parts of a view that the page shows."""

    look: Look
    map: Map = "none"
    map_opacity: float = 1.0
    wipe: float | None = None
    """Left of this share of the width is the scene as it was captured; None = nowhere."""
    region: int | None = None
    """A region to be highlighted; the others are dimmed."""

    @property
    def shows_regions(self) -> bool:
        """True where regions of the scene are shown."""
        return self.map == "regions" or self.region is not None

    @property
    def layers(self) -> frozenset[str]:
        """Names of the layers that must be rendered."""
        wanted = {"look"}
        if self.map != "none":
            wanted.add(self.map)
        if self.wipe is not None:
            wanted.add("plain")
        if self.region is not None:
            wanted.add(f"region {self.region}")
        return frozenset(wanted)


class RegionInfo(NamedTuple):
    """A region that was picked."""

    region: int
    share: float
    """Of the scene."""
    taken: tuple[tuple[str, float], ...]
    """Share that it takes from each photograph, the largest first; empty without a style."""


@dataclass(frozen=True, eq=False)
class Thumbnail:
    """A small picture; compared by identity."""

    number: int
    """Its name in requests of the page."""
    picture: Picture


class Key(NamedTuple):
    """A keyframe of a film."""

    camera: CameraState
    look: Look
    thumbnail: Thumbnail | None = None


@dataclass(frozen=True)
class FilmProgress:
    """Frames of the film that is being made, or was."""

    done: int = 0
    total: int = 0
    path: Path | None = None
    """The film, when it is finished."""

    @property
    def busy(self) -> bool:
        """True while it is being made."""
        return self.total > 0 and self.path is None


@dataclass(frozen=True)
class TrainingProgress:
    """Progress of a training run."""

    step: int = 0
    share: float = 0.0
    """Of the run, in [0, 1]; 1 = it has ended."""
    psnr: float | None = None
    """Of the training rays; None = not known yet."""
    seconds_left: float | None = None
    what: str = ""
    """A part of a scene in blocks."""


@dataclass(frozen=True, kw_only=True)
class State:
    """State of the page, for all clients alike but for their cameras."""

    shelf: tuple[Photograph, ...] = ()
    look: Look = Look()
    drop_mode: DropMode = "alone"
    map: Map = "none"
    map_opacity: float = 0.85
    wipe: float | None = None
    picking: bool = False
    """True where a click on the scene picks a region."""
    picked: RegionInfo | None = None
    saved: tuple[tuple[str, Look], ...] = ()
    """Looks that were kept, by name."""
    keys: tuple[Key, ...] = ()
    selected_key: int | None = None
    playing: bool = False
    """True while a flight is shown to somebody."""
    film: FilmProgress = FilmProgress()
    pictures: tuple[Path, ...] = ()
    """Pictures that were saved."""
    pixels: int = 640
    """Longest side of the sharpest picture."""
    training: TrainingProgress | None = None
    """None = the scene is not being trained."""

    def __post_init__(self) -> None:
        if self.map not in MAPS:
            raise UsageError(f"map: {self.map!r} is none of {', '.join(MAPS)}")
        between("cover", self.map_opacity, 0.0, 1.0)
        if self.wipe is not None:
            between("wipe", self.wipe, 0.0, 1.0)
        between("pixels", self.pixels, MIN_PIXELS, MAX_PIXELS)
        if len(self.keys) > _MAX_KEYS:
            raise UsageError(f"film: at most {_MAX_KEYS} keys; remove one first")

    @property
    def view(self) -> ViewSettings:
        """Return the layers to render."""
        region = self.picked.region if self.picked is not None else None
        return ViewSettings(self.look, self.map, self.map_opacity, self.wipe, region)

    @property
    def names_regions(self) -> bool:
        """True where some region is referred to by its number."""
        return self.picked is not None or any(look.rules for look in self._looks)

    @property
    def in_use(self) -> frozenset[Photograph]:
        """Photographs that some look needs."""
        return frozenset(photograph for look in self._looks for photograph, _ in look.mix)

    @property
    def photographs(self) -> frozenset[Photograph]:
        """Every photograph that can still be asked for."""
        return self.in_use | frozenset(self.shelf)

    @property
    def _looks(self) -> list[Look]:
        """The current look and all that can be restored."""
        looks = [self.look, *(look for _, look in self.saved), *(key.look for key in self.keys)]
        return looks + [look.towards for look in looks if look.towards is not None]


def add_photograph(state: State, photograph: Photograph) -> State:
    """With a new photograph on the shelf and in the look; the oldest one that no look needs makes room."""
    look = only(state.look, photograph) if state.drop_mode == "alone" or not state.look.mix else None
    shelf = (*state.shelf, photograph)
    if look is None:
        look = set_weight(state.look, photograph, 1.0, shelf)
    state = replace(state, shelf=shelf, look=replace(look, strength=look.strength or 1.0), picked=None)
    while len(state.shelf) > SHELF:
        spare = [each for each in state.shelf if each not in state.in_use]
        if not spare:
            state = remove_photograph(state, next(each for each in state.shelf if each is not photograph))
            continue
        state = replace(state, shelf=tuple(each for each in state.shelf if each is not spare[0]))
    return state


def remove_photograph(state: State, photograph: Photograph) -> State:
    """Without a photograph on the shelf and in the look; looks that were kept, and keys of the film, keep it."""
    shelf = tuple(each for each in state.shelf if each is not photograph)
    return replace(state, shelf=shelf, look=set_weight(state.look, photograph, 0.0, shelf))


def save_look(state: State, name: str) -> State:
    """With the current look kept under a name, instead of one of that name. Raises UsageError for an empty name."""
    name = " ".join(name.split())[:40]
    if not name:
        raise UsageError("keep look: give it a name")
    look = replace(state.look, towards=None, at=0.0)
    others = tuple(row for row in state.saved if row[0] != name)
    if len(others) >= _MAX_KEYS:
        raise UsageError(f"keep look: at most {_MAX_KEYS} are kept; remove one first")
    return replace(state, saved=(*others, (name, look)))


def renumber_regions(state: State, regions: Sequence[int]) -> State:
    """With region r as regions[r]: regions were measured again."""
    picked = None if state.picked is None else state.picked._replace(region=regions[state.picked.region])
    saved = tuple((name, _renumbered(look, regions)) for name, look in state.saved)
    keys = tuple(key._replace(look=_renumbered(key.look, regions)) for key in state.keys)
    return replace(state, look=_renumbered(state.look, regions), picked=picked, saved=saved, keys=keys)


def add_key(state: State, key: Key) -> State:
    """With a key behind the selected one, or at the end, and selected. Raises UsageError for too many."""
    at = len(state.keys) if state.selected_key is None else state.selected_key + 1
    return replace(state, keys=(*state.keys[:at], key, *state.keys[at:]), selected_key=at)


def replace_key(state: State, key: Key) -> State:
    """With another key in the place of the selected one."""
    at = _selected(state)
    return replace(state, keys=(*state.keys[:at], key, *state.keys[at + 1 :]))


def remove_key(state: State) -> State:
    """Without the selected key; the one before it is selected."""
    at = _selected(state)
    keys = (*state.keys[:at], *state.keys[at + 1 :])
    return replace(state, keys=keys, selected_key=max(0, at - 1) if keys else None)


def move_key(state: State, by: int) -> State:
    """With the selected key `by` places later; it stops at the ends."""
    at = _selected(state)
    to = min(len(state.keys) - 1, max(0, at + by))
    rest = (*state.keys[:at], *state.keys[at + 1 :])
    return replace(state, keys=(*rest[:to], state.keys[at], *rest[to:]), selected_key=to)


def select_key(state: State, at: int) -> State:
    """With a key selected by its place. Raises UsageError where there is none."""
    if not 0 <= at < len(state.keys):
        raise UsageError(f"film: key {at + 1} of {len(state.keys)}: there is none")
    return replace(state, selected_key=at)


def restore_key(state: State) -> State:
    """In the look of the selected key."""
    return replace(state, look=state.keys[_selected(state)].look)


def interpolate_looks(keys: tuple[Key, ...], at: float) -> Look:
    """The look at a place of the flight, counted in keys; it fades as in the film (a smoothstep).

    Where one of both looks lies between two looks itself, it holds for its half of the way: this is for previews.
    """
    last = len(keys) - 1
    at = min(float(last), max(0.0, at))
    first = min(int(at), max(0, last - 1))
    here, there, way = keys[first].look, keys[min(last, first + 1)].look, at - first
    if here == there or way == 0:
        return here
    if way == 1:
        return there
    if here.towards is not None or there.towards is not None:
        return here if way < 0.5 else there
    return replace(here, towards=there, at=way * way * (3 - 2 * way))


def _selected(state: State) -> int:
    if state.selected_key is None:
        raise UsageError("film: no key is chosen; click one, or add one")
    return state.selected_key
