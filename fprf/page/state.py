"""State of the page as immutable values: the shelf of photographs, looks that are kept, keyframes; and the changes that
messages make.
"""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field, replace
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from ..errors import UsageError
from ..io.maps import palette
from ..plugins import slots
from ..plugins.slots import hints_of
from ..style.config import with_preset
from . import messages
from .looks import Look, MapKind, Photograph, Shown, sliders
from .messages import SHELF, Camera
from .writer import CAPTURED

NOW = "Now"
"""Name of the colours of the present look, beside those of looks that are kept."""
_MAX_KEPT_LOOKS = 64
"""Looks that are kept by name; by eye."""
_MAX_KEYFRAMES = 64
"""Keyframes of a film; by eye."""
_MAX_UNDONE = 50
"""Steps that can be undone; by eye."""
MAX_UNDONE_PHOTOGRAPHS = 6
"""Photographs that left the shelf and come back with what is undone: some 6 MB each; by eye."""


class RegionInfo(NamedTuple):
    """A region that was picked."""

    region: int
    share: float
    """Of the scene."""
    taken: tuple[tuple[str, float], ...]
    """Share that it takes from each photograph, the largest first; empty without a style."""


class PageKeyframe(NamedTuple):
    """A keyframe of a film."""

    camera: Camera
    look: Look


@dataclass(frozen=True, kw_only=True)
class Made:
    """Work of users on a scene: it can be undone, and is kept in the scene's folder."""

    shelf: tuple[Photograph, ...] = ()
    look: Look = field(default_factory=Look)
    kept: tuple[tuple[str, Look], ...] = ()
    keys: tuple[PageKeyframe, ...] = ()

    @property
    def looks(self) -> tuple[Look, ...]:
        """The look of now, those that were kept, and those of the film."""
        return (self.look, *(look for _, look in self.kept), *(key.look for key in self.keys))

    @property
    def in_use(self) -> frozenset[Photograph]:
        """Photographs that some look needs."""
        used: set[Photograph] = set()
        for look in self.looks:
            used.update(dict(look.mix))
        return frozenset(used)

    def renumbered(self, regions: Sequence[int]) -> "Made":
        """With region r as regions[r] in the rules of all looks: regions were measured again."""
        kept = tuple((name, look.renumbered(regions)) for name, look in self.kept)
        keys = tuple(key._replace(look=key.look.renumbered(regions)) for key in self.keys)
        return replace(self, look=self.look.renumbered(regions), kept=kept, keys=keys)

    def without_rules(self) -> "Made":
        """With no rules for regions in any look."""
        kept = tuple((name, replace(look, rules=frozenset())) for name, look in self.kept)
        keys = tuple(key._replace(look=replace(key.look, rules=frozenset())) for key in self.keys)
        return replace(self, look=replace(self.look, rules=frozenset()), kept=kept, keys=keys)


class History:
    """History of what was made: before each change, and undone. Changes of one control are one step."""

    def __init__(self) -> None:
        self.before: list[Made] = []
        self.after: list[Made] = []
        self._control: Hashable = None

    def note(self, before: Made, control: Hashable = None) -> None:
        """A change was made to what there was `before`, by a `control` where it is moved step by step."""
        if control is None or control != self._control or not self.before:
            self.before.append(before)
        self._control = control
        self.after.clear()
        del self.before[:-_MAX_UNDONE]
        while len(self.photographs) > MAX_UNDONE_PHOTOGRAPHS + len({*before.shelf} | before.in_use):
            del self.before[0]

    def undo(self, now: Made) -> Made:
        """Work before the last change. Raises UsageError where there was none."""
        return self._moved(self.before, self.after, now, "undo: nothing was changed")

    def redo(self, now: Made) -> Made:
        """Work that was undone last. Raises UsageError where nothing was."""
        return self._moved(self.after, self.before, now, "redo: nothing was undone")

    def _moved(self, source: list[Made], other: list[Made], now: Made, fault: str) -> Made:
        if not source:
            raise UsageError(fault)
        self._control = None
        other.append(now)
        return source.pop()

    @property
    def photographs(self) -> frozenset[Photograph]:
        """Photographs that something needs which can be undone or done again."""
        used: set[Photograph] = set()
        for made in (*self.before, *self.after):
            used |= {*made.shelf} | made.in_use
        return frozenset(used)

    @property
    def looks(self) -> tuple[Look, ...]:
        """All looks that can come back."""
        return tuple(look for made in (*self.before, *self.after) for look in made.looks)

    def renumber(self, regions: Sequence[int]) -> None:
        """Regions were measured again: r is regions[r]."""
        self.before = [made.renumbered(regions) for made in self.before]
        self.after = [made.renumbered(regions) for made in self.after]


@dataclass(frozen=True, kw_only=True)
class FilmProgress:
    """A film that is being made, or was made last."""

    done: int = 0
    """Frames that are rendered."""
    total: int = 0
    """Frames of all; 0 = no film was asked for."""
    path: Path | None = None
    """Its file, once it is finished."""


@dataclass(frozen=True, kw_only=True)
class SharedState(Made):
    """State that all clients share; each has a camera of its own."""

    together: bool = False
    """A photograph that is dropped joins the others; else it becomes the style alone."""
    map: MapKind = "none"
    picked: RegionInfo | None = None
    film: FilmProgress = FilmProgress()

    @property
    def shown(self) -> Shown:
        """The part of the state that is drawn."""
        return Shown(self.look, self.map, None if self.picked is None else self.picked.region)

    @property
    def made(self) -> Made:
        """The part that can be undone, and is kept."""
        return Made(shelf=self.shelf, look=self.look, kept=self.kept, keys=self.keys)

    def remade(self, made: Made) -> "SharedState":
        """With other things made; no region is picked."""
        return replace(self, shelf=made.shelf, look=made.look, kept=made.kept, keys=made.keys, picked=None)

    def renumbered(self, regions: Sequence[int]) -> "SharedState":
        """With region r as regions[r] in the rules of all looks; none is picked: regions were measured
        again.
        """
        return self.remade(self.made.renumbered(regions))

    def joined(self, saved: Made) -> "SharedState":
        """With what was kept of the scene before; what was made since stays, and its look where it has one."""
        shelf = [*saved.shelf]
        for each in self.shelf:
            if each not in shelf:
                shelf.append(each)
        look = saved.look if self.look.plain else self.look
        state = self.remade(
            Made(
                shelf=tuple(shelf),
                look=look,
                kept=tuple({**dict(saved.kept), **dict(self.kept)}.items()),
                keys=(*saved.keys, *self.keys),
            )
        )
        return state.bounded()

    def taken(self, look: Look) -> "SharedState":
        """In a look that was given, with its photographs on the shelf."""
        shelf = [*self.shelf]
        for photograph, _ in look.mix:
            if photograph not in shelf:
                shelf.append(photograph)
        return replace(self, shelf=tuple(shelf), look=look, picked=None).bounded()

    def bounded(self) -> "SharedState":
        """With no more photographs on the shelf than it holds: the oldest that no look needs make room."""
        state = self
        while len(state.shelf) > SHELF:
            spare = [each for each in state.shelf if each not in state.in_use] or [state.shelf[0]]
            state = state.removed(spare[0])
        return state

    def look_named(self, name: str) -> Look:
        """The look that a client sees under a name. Raises UsageError where there is none."""
        if name == NOW:
            return self.look
        if name == CAPTURED:
            return Look(style=self.look.unlit.style)
        kept = dict(self.kept)
        if name not in kept:
            raise UsageError(f"{name}: no look is called so")
        return kept[name]

    def photograph(self, number: int | None) -> Photograph:
        """A photograph of the shelf. Raises UsageError where it is not there."""
        for each in self.shelf:
            if each.number == number:
                return each
        raise UsageError(f"card {number}: none of the shelf")

    def unused_name(self, name: str) -> str:
        """The name, with a number where a photograph of the shelf has it already."""
        taken = set()
        for photograph in self.shelf:
            taken.add(photograph.name)
        return (
            name
            if name not in taken
            else next(each for n in count(2) if (each := f"{name} ({n})") not in taken)
        )

    def added(self, photograph: Photograph, join: bool = False) -> "SharedState":
        """With a new photograph on the shelf and in the look, in which it joins the others if it is to; the
        oldest one that no look needs makes room.
        """
        shelf = (*self.shelf, photograph)
        together = (self.together or join) and self.look.mix
        if together:
            look = self.look.weighted(photograph, 1.0, shelf)
        else:
            look = self.look.mixed([(photograph, 1.0)])
        look = replace(
            look, style=replace(look.style, strength=look.style.strength or 1.0)
        )  # else nothing is seen of it
        return replace(self, shelf=shelf, look=look, picked=None).bounded()

    def removed(self, photograph: Photograph) -> "SharedState":
        """Without a photograph on the shelf and in the look; looks that were kept, and keys of the film, keep
        it.
        """
        shelf = tuple(each for each in self.shelf if each is not photograph)
        return replace(self, shelf=shelf, look=self.look.weighted(photograph, 0.0, shelf))

    def changed(self, message: messages.Change) -> "SharedState":
        """State after a control of the page. Raises UsageError or ConfigError for what is not
        possible.
        """
        look = self.look
        match message:
            case messages.Set():
                if message.name not in sliders(look.style):
                    raise UsageError(f"{message.name}: the stylizer of this scene has no such field")
                # The page sends numbers; those of fields of whole numbers become whole.
                *slot, name = message.name.split(".")
                whole = hints_of(type(getattr(look.style, slot[0]) if slot else look.style))[name] is int
                value: Any = int(message.value) if whole else round(message.value, 4)
                return replace(self, look=replace(look, style=slots.replace(look.style, message.name, value)))
            case messages.Sun():
                strength = round(message.strength, 4)
                style = replace(
                    look.style, light=message.light, sun=message.sun, sun_from="north", sun_strength=strength
                )
                return replace(self, look=replace(look, style=style))
            case messages.Preset():
                return replace(self, look=replace(look, style=with_preset(look.style, message.name)))
            case messages.Map():
                return replace(self, map=message.map)
            case messages.Card():
                photograph = self.photograph(message.card)
                if message.action == "remove":
                    return self.removed(photograph)
                if message.action == "alone":
                    return replace(self, look=look.mixed([(photograph, 1.0)]))
                return replace(self, look=look.weighted(photograph, message.weight, self.shelf))
            case messages.Region():
                if message.action == "close":
                    return replace(self, picked=None)
                if self.picked is None:
                    raise UsageError("region: none is picked")
                # A photograph that a region is to take, or never to take, joins the mix.
                named = None
                if message.action in ("pin", "forbid"):
                    named = self.photograph(message.card)
                if named is not None and named not in dict(look.mix):
                    look = look.weighted(named, 1.0, self.shelf)
                action = None
                if message.action != "free":
                    action = message.action
                return replace(self, look=look.ruled(self.picked.region, action, named))
            case messages.Keep():
                return self._kept(message)
            case messages.Key(action="add"):
                if message.camera is None:
                    raise UsageError("key: a camera is needed")
                if len(self.keys) >= _MAX_KEYFRAMES:
                    raise UsageError(f"film: at most {_MAX_KEYFRAMES} keys; remove one first")
                key = PageKeyframe(message.camera, self.look_named(message.shown))
                return replace(self, keys=(*self.keys, key))
            case messages.Key():
                keys = list(self.keys)
                at = message.at
                if not at < len(keys):
                    raise UsageError(f"film: key {at + 1} of {len(keys)}: there is none")
                key = keys.pop(at)
                if message.action == "earlier":
                    keys.insert(max(0, at - 1), key)
                return replace(self, keys=tuple(keys))

    def _kept(self, message: messages.Keep) -> "SharedState":
        name = " ".join(message.name.split())[:40]
        kept = dict(self.kept)
        if message.action != "keep":
            if name not in kept:
                raise UsageError(f"look {name!r}: none is kept under this name")
            if message.action == "restore":
                return replace(self, look=kept[name])
            del kept[name]
            return replace(self, kept=tuple(kept.items()))
        if not name or name in (NOW, CAPTURED):
            raise UsageError("keep look: give it a name of its own")
        if name in kept and kept[name] != self.look and not message.replace:
            raise UsageError(f"keep look: {name!r} is there already; replace it, or choose another name")
        if len(kept.keys() - {name}) >= _MAX_KEPT_LOOKS:
            raise UsageError(f"keep look: at most {_MAX_KEPT_LOOKS} are kept")
        kept.pop(name, None)  # a look that takes the place of another comes last
        return replace(self, kept=(*kept.items(), (name, self.look)))

    def described(self) -> dict[str, Any]:
        """The state as the page reads it."""
        picked = self.picked
        weights = dict(self.look.mix)
        if self.map == "matches":
            hues = palette(len(weights)).mul(255).round().int().tolist()
        else:
            hues = []
        colours = {}
        for each, hue in zip(weights, hues, strict=False):
            colours[each] = "rgb({}, {}, {})".format(*hue)
        region = None
        if picked is not None:
            rules = []
            for rule in self.look.rules:
                if rule.region == picked.region:
                    rules.append(
                        {
                            "action": rule.action,
                            "card": None if rule.photograph is None else rule.photograph.number,
                        }
                    )
            taken = []
            for name, share in picked.taken:
                taken.append({"name": name, "share": share})
            region = {"region": picked.region, "share": picked.share, "taken": taken, "rules": rules}
        shelf = []
        for each in self.shelf:
            weight = weights.get(each, 0.0)
            card = {"card": each.number, "name": each.name, "weight": weight, "colour": colours.get(each)}
            shelf.append(card)
        film = self.film
        style = self.look.style
        return {
            "type": "state",
            "shelf": shelf,
            "look": sliders(self.look.style),
            "sun": {
                "light": style.light,
                "sun": style.sun,
                "from": style.sun_from,
                "strength": style.sun_strength,
            },
            "map": self.map,
            "picked": region,
            "kept": [name for name, _ in self.kept],
            "keys": [msgspec.to_builtins(key.camera) for key in self.keys],
            "film": {"done": film.done, "total": film.total, "ready": film.path is not None},
        }
