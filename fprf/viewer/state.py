"""All that the page shows and its controls hold, as one value that is replaced and never changed."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, TypeAlias

from ..checks import between
from ..errors import UsageError
from .film import Key
from .looks import Card, Look, moved, only, weighed
from .painter import MAPS, Map, Shown
from .restyler import Picked
from .training import Training

__all__ = ["LEAST", "MOST", "SHELF", "Film", "Landing", "State", "dropped", "kept", "removed", "renumbered"]

Landing: TypeAlias = Literal["alone", "in the mix"]
"""What becomes of a photograph that is dropped: it is the style, or joins the others."""

SHELF = 12
"""Photographs on the shelf; the oldest that is not in use makes room."""
LEAST, MOST = 64, 2048
"""Longest side of the sharpest picture, in pixels."""
_KEYS = 64


@dataclass(frozen=True)
class Film:
    """How the making of a film goes."""

    done: int = 0
    total: int = 0
    path: Path | None = None
    """The film, when it is finished."""

    @property
    def busy(self) -> bool:
        """It is being made."""
        return self.total > 0 and self.path is None


@dataclass(frozen=True, kw_only=True)
class State:
    """What is shown, to all clients alike but for their cameras."""

    shelf: tuple[Card, ...] = ()
    look: Look = Look()
    landing: Landing = "alone"
    map: Map = "none"
    cover: float = 0.85
    wipe: float | None = None
    picking: bool = False
    """A click on the scene picks a region."""
    picked: Picked | None = None
    saved: tuple[tuple[str, Look], ...] = ()
    """Looks that were kept, by name."""
    keys: tuple[Key, ...] = ()
    chosen: int | None = None
    """Place of the key that is edited."""
    playing: bool = False
    """A flight is shown to somebody."""
    film: Film = Film()
    pixels: int = 640
    """Longest side of the sharpest picture."""
    training: Training | None = None
    """How it goes, where the scene is being trained."""

    def __post_init__(self) -> None:
        if self.map not in MAPS:
            raise UsageError(f"map: {self.map!r} is none of {', '.join(MAPS)}")
        between("cover", self.cover, 0.0, 1.0)
        if self.wipe is not None:
            between("wipe", self.wipe, 0.0, 1.0)
        between("pixels", self.pixels, LEAST, MOST)
        if len(self.keys) > _KEYS:
            raise UsageError(f"film: at most {_KEYS} keys; remove one first")

    @property
    def shown(self) -> Shown:
        """What is to be painted."""
        region = self.picked.region if self.picked is not None else None
        return Shown(self.look, self.map, self.cover, self.wipe, region)

    @property
    def needs_regions(self) -> bool:
        """Whether some region is spoken of by its number."""
        return self.picked is not None or any(look.orders for look in self._looks)

    @property
    def in_use(self) -> frozenset[Card]:
        """Photographs that some look needs."""
        return frozenset(card for look in self._looks for card, _ in look.mix)

    @property
    def all_cards(self) -> frozenset[Card]:
        """Every photograph that can still be asked for."""
        return self.in_use | frozenset(self.shelf)

    @property
    def _looks(self) -> list[Look]:
        """All that somebody may return to."""
        looks = [self.look, *(look for _, look in self.saved), *(key.look for key in self.keys)]
        return looks + [look.towards for look in looks if look.towards is not None]


def dropped(state: State, card: Card) -> State:
    """A new photograph: on the shelf, and the style, or part of it. The oldest one that nobody needs makes room."""
    look = only(state.look, card) if state.landing == "alone" or not state.look.mix else None
    shelf = (*state.shelf, card)
    if look is None:
        look = weighed(state.look, card, 1.0, shelf)
    state = replace(state, shelf=shelf, look=replace(look, strength=look.strength or 1.0), picked=None)
    while len(state.shelf) > SHELF:
        spare = [each for each in state.shelf if each not in state.in_use]
        if not spare:
            oldest = next(each for each in state.shelf if each is not card)
            state = removed(state, oldest)
            continue
        state = replace(state, shelf=tuple(each for each in state.shelf if each is not spare[0]))
    return state


def removed(state: State, card: Card) -> State:
    """Without a photograph. Looks that were kept, and keys of the film, keep it."""
    shelf = tuple(each for each in state.shelf if each is not card)
    return replace(state, shelf=shelf, look=weighed(state.look, card, 0.0, shelf))


def kept(state: State, name: str) -> State:
    """With the look of now kept under a name, instead of one of that name. Raises UsageError for an empty name."""
    name = " ".join(name.split())[:40]
    if not name:
        raise UsageError("keep look: give it a name")
    look = replace(state.look, towards=None, at=0.0)
    others = tuple(row for row in state.saved if row[0] != name)
    if len(others) >= _KEYS:
        raise UsageError(f"keep look: at most {_KEYS} are kept; remove one first")
    return replace(state, saved=(*others, (name, look)))


def renumbered(state: State, regions: Sequence[int]) -> State:
    """With every region by its new number: regions were found anew."""
    picked = None if state.picked is None else state.picked._replace(region=regions[state.picked.region])
    saved = tuple((name, moved(look, regions)) for name, look in state.saved)
    keys = tuple(key._replace(look=moved(key.look, regions)) for key in state.keys)
    return replace(state, look=moved(state.look, regions), picked=picked, saved=saved, keys=keys)
