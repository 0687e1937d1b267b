"""The page's own part over viser's: dropping photographs, the shelf, the wipe, rules of a region. HTTP, no viser.

`Page` answers the requests of `page.js`, which learns of changes by asking `/fprf/state?after=N`: the answer comes when there
is something newer than N, or after some seconds.
"""

import asyncio
import threading
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from typing import Any

from ..errors import UsageError
from ..io.images import encode
from ..io.maps import palette
from .routes import Handler, Request, Response, asset, integer, json_body, json_response, number, text_response
from .session import Session
from .state import (
    Photograph,
    RegionAction,
    State,
    move_key,
    only,
    remove_key,
    remove_photograph,
    select_key,
    set_rule,
    set_weight,
)

_WAIT = 20.0
"""Seconds until a request for changes is answered without any."""
_MESSAGES = 20
_IMAGE = {"cache-control": "private, max-age=3600"}
_EDITS: Mapping[str, Callable[[State], State]] = {
    "choose": lambda state: state,
    "earlier": lambda state: move_key(state, -1),
    "later": lambda state: move_key(state, 1),
    "remove": remove_key,
}
_ACTIONS: Mapping[str, RegionAction | None] = {"pin": "pin", "forbid": "forbid", "keep": "keep", "free": None}


class Page:
    """Handlers of one session. `index` is what `/` shows; with `start` there is a start page to go back to."""

    def __init__(self, session: Session, index: bytes, *, start: bool = False) -> None:
        self._session, self._first, self._start = session, index, start
        self._version = 0
        self._messages: deque[tuple[int, str]] = deque(maxlen=_MESSAGES)
        self._lock = threading.Lock()
        self._waiting: set[tuple[asyncio.AbstractEventLoop, asyncio.Event]] = set()

    @property
    def routes(self) -> dict[tuple[str, str], Handler]:
        return {
            ("GET", "/"): self._index,
            ("GET", "/fprf/page.js"): asset("page.js"),
            ("GET", "/fprf/page.css"): asset("page.css"),
            ("GET", "/fprf/state"): self._state,
            ("GET", "/fprf/card"): self._thumbnail,
            ("GET", "/fprf/film"): self._film,
            ("GET", "/fprf/picture"): self._picture,
            ("GET", "/fprf/gaussians"): self._gaussians,
            ("GET", "/fprf/key"): self._key,
            ("POST", "/fprf/keys"): self._edit_key,
            ("POST", "/fprf/photograph"): self._upload,
            ("POST", "/fprf/shelf"): self._edit_shelf,
            ("POST", "/fprf/region"): self._edit_region,
            ("POST", "/fprf/wipe"): self._move_wipe,
        }

    def wake(self) -> None:
        """Answer those who wait for something new."""
        with self._lock:
            self._version += 1
            waiting, self._waiting = self._waiting, set()
        for loop, event in waiting:
            loop.call_soon_threadsafe(event.set)

    def notify(self, text: str) -> None:
        """Show a line on all pages for a while."""
        with self._lock:
            self._messages.append((self._version + 1, text[:400]))
        self.wake()

    async def _index(self, request: Request) -> Response:
        return Response(200, "text/html; charset=utf-8", self._first)

    async def _state(self, request: Request) -> Response:
        after = integer({"after": -1, **request.query}, "after", -1)
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
        with self._lock:
            version, said = self._version, [text for at, text in self._messages if at > after >= 0]
        scene = {"start": self._start, "gaussians": self._session.in_browser}
        return json_response({"version": version, "said": said, **scene, **described(self._session.state)})

    async def _thumbnail(self, request: Request) -> Response:
        photograph = _photograph(self._session.state, request.query)
        return Response(200, "image/jpeg", encode(photograph.thumbnail, "jpg"), _IMAGE)

    async def _film(self, request: Request) -> Response:
        path = self._session.state.film.path
        if path is None or not path.is_file():
            return text_response(404, "no film yet")
        return self._download("video/mp4", path.read_bytes(), f"{path.parent.name}.mp4")

    async def _picture(self, request: Request) -> Response:
        pictures, number = self._session.state.pictures, integer(request.query, "number")
        if not 0 <= number < len(pictures):
            return text_response(404, "no such picture")
        return self._download("image/png", pictures[number].read_bytes(), pictures[number].name)

    async def _gaussians(self, request: Request) -> Response:
        data = await asyncio.to_thread(self._session.gaussians)
        return self._download("application/octet-stream", data, "restyled.ply")

    def _download(self, content_type: str, data: bytes, name: str) -> Response:
        """A file to be saved under the scene's name and its own."""
        whole = f"{self._session.viewed.name}-{name}"
        plain = "".join(c if c.isascii() and (c.isalnum() or c in "-_.") else "_" for c in whole)
        return Response(200, content_type, data, {"content-disposition": f'attachment; filename="{plain}"'})

    async def _key(self, request: Request) -> Response:
        wanted = integer(request.query, "key")
        for key in self._session.state.keys:
            if key.thumbnail is not None and key.thumbnail.number == wanted:
                return Response(200, "image/jpeg", encode(key.thumbnail.picture, "jpg"), _IMAGE)
        return text_response(404, "no picture of this key")

    async def _edit_key(self, request: Request) -> Response:
        asked = json_body(request)
        at, edit = integer(asked, "key"), _EDITS.get(str(asked.get("action")))
        if edit is None:
            raise UsageError(f"keys: the action is none of {', '.join(_EDITS)}")
        return self._update(lambda state: edit(select_key(state, at)))

    async def _upload(self, request: Request) -> Response:
        name = request.query.get("name", "photograph")
        photograph = await asyncio.to_thread(self._session.upload, request.body, name)
        return json_response({"card": photograph.number, "name": photograph.name})

    async def _edit_shelf(self, request: Request) -> Response:
        asked = json_body(request)
        action = asked.get("action")

        def change(state: State) -> State:
            photograph = _photograph(state, asked)
            if action == "remove":
                return remove_photograph(state, photograph)
            if action == "alone":
                return replace(state, look=only(state.look, photograph))
            if action == "weight":
                look = set_weight(state.look, photograph, number(asked, "weight", 0, 4), state.shelf)
                return replace(state, look=look)
            raise UsageError("shelf: the action is none of alone, weight, remove")

        return self._update(change)

    async def _edit_region(self, request: Request) -> Response:
        asked = json_body(request)
        text = str(asked.get("verb"))
        if text == "close":
            self._session.select_region(None)
            return json_response({})
        if text not in _ACTIONS:
            raise UsageError(f"region: the verb is none of {', '.join(_ACTIONS)}, close")
        action = _ACTIONS[text]

        def change(state: State) -> State:
            if state.picked is None:
                raise UsageError("region: none is picked")
            look = state.look
            photograph = _photograph(state, asked) if action in ("pin", "forbid") else None
            if photograph is not None and photograph not in dict(look.mix):
                look = set_weight(look, photograph, 1.0, state.shelf)
            return replace(state, look=set_rule(look, state.picked.region, action, photograph))

        return self._update(change)

    async def _move_wipe(self, request: Request) -> Response:
        at = number(json_body(request), "at", 0, 1)
        return self._update(lambda state: replace(state, wipe=at) if state.wipe is not None else state)

    def _update(self, change: Callable[[State], State]) -> Response:
        """Change the session's state. Raises what `change` raises, which then is told to this client alone."""
        self._session.apply(change)
        return json_response({})


def described(state: State) -> dict[str, Any]:
    """The state as `page.js` reads it."""
    weights = dict(state.look.mix)
    picked = state.picked
    hues = palette(len(weights)).mul(255).round().int().tolist() if state.map == "matches" else []
    colours = {each: "rgb({}, {}, {})".format(*hue) for each, hue in zip(weights, hues, strict=False)}
    return {
        "shelf": [
            {"card": each.number, "name": each.name, "weight": weights.get(each, 0.0), "colour": colours.get(each)}
            for each in state.shelf
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
                {"verb": rule.action, "card": None if rule.photograph is None else rule.photograph.number}
                for rule in sorted(state.look.rules, key=lambda each: each.photograph.number if each.photograph else 0)
                if rule.region == picked.region
            ],
        },
        "map": state.map,
        "training": None if state.training is None else asdict(state.training),
        "keys": [0 if key.thumbnail is None else key.thumbnail.number for key in state.keys],
        "chosen": state.selected_key,
        "playing": state.playing,
        "pictures": len(state.pictures),
        "film": {"done": state.film.done, "total": state.film.total, "ready": state.film.path is not None},
    }


def _photograph(state: State, asked: Mapping[str, Any]) -> Photograph:
    wanted = integer(asked, "card")
    for photograph in state.shelf:
        if photograph.number == wanted:
            return photograph
    raise UsageError(f"card {wanted}: none of the shelf")
