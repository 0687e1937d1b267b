"""The page's own part over viser's: dropping photographs, the shelf, the wipe, what to do with a region. HTTP, no viser.

`Page` answers the requests of `page.js`. It learns of changes by asking `/fprf/state?after=N`, which is answered when there
is something newer than N, or after some seconds.
"""

import asyncio
import json
import threading
from collections import deque
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import asdict, replace
from html import escape
from importlib.resources import files
from typing import Any

from ..errors import UsageError
from ..io.images import encode
from ..io.maps import palette
from .keys import chosen, shifted, without
from .looks import Card, Verb, only, ordered, weighed
from .server import Answer, Request
from .session import Session
from .state import State, removed

__all__ = ["Page", "built_page"]

_WAIT = 20.0
_SAID = 20
_JSON, _PLAIN = "application/json", "text/plain; charset=utf-8"
_EDITS: Mapping[str, Callable[[State], State]] = {
    "choose": lambda state: state,
    "earlier": lambda state: shifted(state, -1),
    "later": lambda state: shifted(state, 1),
    "remove": without,
}
_VERBS: Mapping[str, Verb | None] = {"pin": "pin", "forbid": "forbid", "keep": "keep", "free": None}


class Page:
    """Of one session. `index` is what `/` shows."""

    def __init__(self, session: Session, index: bytes) -> None:
        self._session, self._first = session, index
        self._version = 0
        self._said: deque[tuple[int, str]] = deque(maxlen=_SAID)
        self._lock = threading.Lock()
        self._waiting: set[tuple[asyncio.AbstractEventLoop, asyncio.Event]] = set()

    @property
    def routes(self) -> dict[tuple[str, str], Callable[[Request], Awaitable[Answer]]]:
        """For the gate."""
        return {
            ("GET", "/"): self._index,
            ("GET", "/fprf/page.js"): self._asset("page.js", "text/javascript; charset=utf-8"),
            ("GET", "/fprf/page.css"): self._asset("page.css", "text/css; charset=utf-8"),
            ("GET", "/fprf/state"): self._state,
            ("GET", "/fprf/card"): self._card,
            ("GET", "/fprf/film"): self._film,
            ("GET", "/fprf/key"): self._key,
            ("POST", "/fprf/keys"): self._keys,
            ("POST", "/fprf/photograph"): self._photograph,
            ("POST", "/fprf/shelf"): self._shelf,
            ("POST", "/fprf/region"): self._region,
            ("POST", "/fprf/wipe"): self._wipe,
        }

    def wake(self) -> None:
        """Something is new: answer those who wait."""
        with self._lock:
            self._version += 1
            waiting, self._waiting = self._waiting, set()
        for loop, event in waiting:
            loop.call_soon_threadsafe(event.set)

    def say(self, text: str) -> None:
        """A line for all pages to show for a while."""
        with self._lock:
            self._said.append((self._version + 1, text[:400]))
        self.wake()

    async def _index(self, request: Request) -> Answer:
        return Answer(200, "text/html; charset=utf-8", self._first)

    def _asset(self, name: str, kind: str) -> Callable[[Request], Awaitable[Answer]]:
        async def asset(request: Request) -> Answer:
            return Answer(200, kind, (files(__package__) / name).read_bytes())

        return asset

    async def _state(self, request: Request) -> Answer:
        after = _number(request.query.get("after", "-1"))
        event = asyncio.Event()
        with self._lock:
            fresh = self._version != after
            if not fresh:
                entry = (asyncio.get_running_loop(), event)
                self._waiting.add(entry)
        if not fresh:
            try:
                await asyncio.wait_for(event.wait(), _WAIT)
            except TimeoutError:
                with self._lock:
                    self._waiting.discard(entry)
        session = self._session
        with self._lock:
            version, said = self._version, [text for at, text in self._said if at > after >= 0]
        return _json({"version": version, "said": said, **described(session.state)})

    async def _card(self, request: Request) -> Answer:
        card = _found(self._session.state, request.query)
        return Answer(200, "image/jpeg", encode(card.picture, "jpg"), {"cache-control": "private, max-age=3600"})

    async def _film(self, request: Request) -> Answer:
        path = self._session.state.film.path
        if path is None or not path.is_file():
            return Answer(404, _PLAIN, b"no film yet\n")
        name = f"{path.parent.parent.parent.name}-{path.parent.name}.mp4"
        plain = "".join(c if c.isascii() and (c.isalnum() or c in "-_.") else "_" for c in name)
        return Answer(200, "video/mp4", path.read_bytes(), {"content-disposition": f'attachment; filename="{plain}"'})

    async def _key(self, request: Request) -> Answer:
        number = _number(request.query.get("key", ""))
        shots = (key.thumbnail for key in self._session.state.keys)
        thumbnail = next((each for each in shots if each is not None and each.number == number), None)
        if thumbnail is None:
            return Answer(404, _PLAIN, b"no picture of this key\n")
        return Answer(200, "image/jpeg", encode(thumbnail.picture, "jpg"), {"cache-control": "private, max-age=3600"})

    async def _keys(self, request: Request) -> Answer:
        asked = _asked(request)
        at, edit = _number(str(asked.get("key"))), _EDITS.get(str(asked.get("action")))
        if edit is None:
            raise UsageError(f"keys: the action is none of {', '.join(_EDITS)}")
        return self._done(self._session, lambda state: edit(chosen(state, at)))

    async def _photograph(self, request: Request) -> Answer:
        session, name = self._session, request.query.get("name", "photograph")
        card = await asyncio.to_thread(session.drop, request.body, name)
        return _json({"card": card.number, "name": card.name})

    async def _shelf(self, request: Request) -> Answer:
        session, asked = self._session, _asked(request)
        number, action = {"card": str(asked.get("card"))}, asked.get("action")

        def to(state: State) -> State:
            card = _found(state, number)
            if action == "remove":
                return removed(state, card)
            if action == "alone":
                return replace(state, look=only(state.look, card))
            if action == "weight":
                return replace(state, look=weighed(state.look, card, _share(asked, "weight", 4.0), state.shelf))
            raise UsageError("shelf: the action is none of alone, weight, remove")

        return self._done(session, to)

    async def _region(self, request: Request) -> Answer:
        session, asked = self._session, _asked(request)
        text = str(asked.get("verb"))
        if text == "close":
            session.choose(None)
            return _json({})
        if text not in _VERBS:
            raise UsageError(f"region: the verb is none of {', '.join(_VERBS)}, close")
        verb = _VERBS[text]

        def to(state: State) -> State:
            if state.picked is None:
                raise UsageError("region: none is picked")
            card = _found(state, {"card": str(asked.get("card"))}) if verb in ("pin", "forbid") else None
            look = state.look
            if card is not None and card not in dict(look.mix):
                look = weighed(look, card, 1.0, state.shelf)
            return replace(state, look=ordered(look, state.picked.region, verb, card))

        return self._done(session, to)

    async def _wipe(self, request: Request) -> Answer:
        at = _share(_asked(request), "at", 1.0)
        return self._done(self._session, lambda state: replace(state, wipe=at) if state.wipe is not None else state)

    def _done(self, session: Session, to: Callable[[State], State]) -> Answer:
        faults: list[UsageError] = []

        def guarded(state: State) -> State:
            try:
                return to(state)
            except UsageError as fault:
                faults.append(fault)
                return state

        session.change(guarded)
        if faults:
            raise faults[0]
        return _json({})


def described(state: State) -> dict[str, Any]:
    """The state as the page needs it."""
    weights = dict(state.look.mix)
    picked = state.picked
    hues = palette(len(weights)).mul(255).round().int().tolist() if state.map == "matches" else []
    colours = {card: "rgb({}, {}, {})".format(*hue) for card, hue in zip(weights, hues, strict=False)}
    return {
        "shelf": [
            {"card": card.number, "name": card.name, "weight": weights.get(card, 0.0), "colour": colours.get(card)}
            for card in state.shelf
        ],
        "wipe": state.wipe,
        "picking": state.picking,
        "picked": None
        if picked is None
        else {
            "region": picked.region,
            "share": picked.share,
            "taken": [{"name": name, "share": share} for name, share in picked.taken],
            "orders": [
                {"verb": order.verb, "card": None if order.card is None else order.card.number}
                for order in sorted(state.look.orders, key=lambda each: each.card.number if each.card else 0)
                if order.region == picked.region
            ],
        },
        "map": state.map,
        "training": None if state.training is None else asdict(state.training),
        "keys": [0 if key.thumbnail is None else key.thumbnail.number for key in state.keys],
        "chosen": state.chosen,
        "playing": state.playing,
        "film": {"done": state.film.done, "total": state.film.total, "ready": state.film.path is not None},
    }


def built_page(page: str, title: str) -> bytes:
    """viser's page with ours in it. Raises ValueError where that page is not as it used to be."""
    head = page.index("</head>")
    ours = '<link rel="stylesheet" href="/fprf/page.css"><script defer src="/fprf/page.js"></script>'
    return f"{page[:head]}{ours}<title>{escape(title)}</title>{page[head:]}".encode()


def _found(state: State, query: Mapping[str, str]) -> Card:
    number = _number(query.get("card", ""))
    for card in state.shelf:
        if card.number == number:
            return card
    raise UsageError(f"card {number}: none of the shelf")


def _number(text: str) -> int:
    if not (text.removeprefix("-").isdigit() and text.isascii() and len(text) <= 12):
        raise UsageError(f"{text[:20]!r} is no number")
    return int(text)


def _share(asked: Mapping[str, Any], name: str, most: float) -> float:
    value = asked.get(name)
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value <= most:
        raise UsageError(f"{name}: must be a number from 0 to {most:g}")
    return float(value)


def _asked(request: Request) -> dict[str, Any]:
    if len(request.body) > 4096:
        raise UsageError("request: too long")
    try:
        asked = json.loads(request.body)
    except (ValueError, RecursionError):
        raise UsageError("request: not JSON") from None
    if not isinstance(asked, dict):
        raise UsageError("request: not an object")
    return asked


def _json(value: dict[str, Any]) -> Answer:
    return Answer(200, _JSON, json.dumps(value).encode())
