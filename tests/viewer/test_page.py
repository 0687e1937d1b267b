import asyncio
import json
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from photographs import viewed
from tiny_world import World

from fprf.errors import DataError, UsageError

pytest.importorskip("uvicorn", reason="the extra `viewer` is not installed")
from fprf.viewer.cameras import CameraState
from fprf.viewer.page import Page, described
from fprf.viewer.server import Request, Response
from fprf.viewer.session import Session
from fprf.viewer.state import Key, Look, Photograph, RegionInfo, State, Thumbnail


@pytest.fixture
def page(world: World) -> Iterator[Page]:
    with Session(viewed(world.load()), State(pixels=64)) as session:
        yield Page(session, b"<html>")


def ask(page: Page, method: str, path: str, query: dict[str, str] | None = None, body: bytes = b"") -> Response:
    async def answered() -> Response:
        return await page.routes[(method, path)](Request(method, path, query or {}, {}, body))

    return asyncio.run(answered())


def post(page: Page, path: str, **asked: object) -> Any:
    return json.loads(ask(page, "POST", path, body=json.dumps(asked).encode()).body)


def add_photograph(page: Page, world: World, which: int = 0) -> Photograph:
    path = world.references[which]
    found = json.loads(ask(page, "POST", "/fprf/photograph", {"name": path.name}, path.read_bytes()).body)
    return next(card for card in page._session.state.shelf if card.number == found["card"])


@pytest.mark.parametrize(
    ("path", "kind", "some"), [("/fprf/page.js", "text/javascript", b"drop"), ("/fprf/page.css", "text/css", b".fprf")]
)
def test_script_and_sheet_are_served(page: Page, path: str, kind: str, some: bytes) -> None:
    answer = ask(page, "GET", path)
    assert answer.content_type.startswith(kind) and some in answer.body
    assert ask(page, "GET", "/").body == b"<html>"


def test_a_photograph_is_dropped_weighed_shown_and_removed(page: Page, world: World) -> None:
    one, two = add_photograph(page, world), add_photograph(page, world, 1)
    session = page._session
    assert session.state.look.mix == ((two, 1.0),)
    post(page, "/fprf/shelf", card=one.number, action="weight", weight=0.5)
    assert session.state.look.mix == ((one, 0.5), (two, 1.0))
    post(page, "/fprf/shelf", card=one.number, action="alone")
    assert session.state.look.mix == ((one, 1.0),)
    picture = cv2.imdecode(np.frombuffer(ask(page, "GET", "/fprf/card", {"card": str(one.number)}).body, np.uint8), 1)
    assert picture.shape == (40, 56, 3)
    post(page, "/fprf/shelf", card=one.number, action="remove")
    assert session.state.shelf == (two,) and session.state.look.plain


def test_regions_get_their_orders(page: Page, world: World) -> None:
    one, two = add_photograph(page, world), add_photograph(page, world, 1)
    session = page._session
    with pytest.raises(UsageError, match="none is picked"):
        post(page, "/fprf/region", verb="keep")
    session.update(lambda state: replace(state, picked=RegionInfo(1, 0.2, ())))
    post(page, "/fprf/region", verb="pin", card=one.number)  # it joins the mix
    assert session.state.look.mix == ((one, 1.0), (two, 1.0))
    assert {(o.region, o.action, o.photograph) for o in session.state.look.rules} == {(1, "pin", one)}
    row = described(session.state)["picked"]
    assert row["orders"] == [{"verb": "pin", "card": one.number}]
    post(page, "/fprf/region", verb="keep")
    assert [o.action for o in session.state.look.rules] == ["keep"]
    post(page, "/fprf/region", verb="free")
    assert session.state.look.rules == frozenset()


def test_the_wipe_moves_only_where_there_is_one(page: Page) -> None:
    post(page, "/fprf/wipe", at=0.2)
    assert page._session.state.wipe is None
    page._session.update(lambda state: replace(state, wipe=0.5))
    post(page, "/fprf/wipe", at=0.2)
    assert page._session.state.wipe == 0.2


@pytest.mark.parametrize(
    ("path", "body"),
    [
        ("/fprf/shelf", b"{"),
        ("/fprf/shelf", b"[]"),
        ("/fprf/shelf", b'{"card": 99, "action": "alone"}'),
        ("/fprf/shelf", b'{"card": "../x", "action": "alone"}'),
        ("/fprf/shelf", b"[" * 4000),
        ("/fprf/shelf", b'"' + b"x" * 5000 + b'"'),
        ("/fprf/region", b'{"verb": "explode"}'),
        ("/fprf/wipe", b'{"at": 2}'),
        ("/fprf/wipe", b'{"at": NaN}'),
        ("/fprf/wipe", b'{"at": true}'),
        ("/fprf/wipe", b"{}"),
        ("/fprf/photograph", b"not a photograph"),
        ("/fprf/shelf", b'{"card": CARD, "action": "explode"}'),
        ("/fprf/shelf", b'{"card": CARD, "action": "weight", "weight": -1}'),
        ("/fprf/shelf", b'{"card": CARD, "action": "weight", "weight": "x"}'),
        ("/fprf/keys", b'{"key": 9, "action": "remove"}'),
        ("/fprf/keys", b'{"key": 0, "action": "x"}'),
        ("/fprf/keys", b"{}"),
    ],
)
def test_nonsense_is_refused_and_changes_nothing(page: Page, world: World, path: str, body: bytes) -> None:
    card = add_photograph(page, world) if b"CARD" in body else None
    before = page._session.state
    with pytest.raises((UsageError, DataError)):
        ask(page, "POST", path, body=body if card is None else body.replace(b"CARD", str(card.number).encode()))
    assert page._session.state == before


def test_who_waits_is_answered_when_something_is_new(page: Page) -> None:
    async def wait() -> tuple[dict[str, Any], dict[str, Any]]:
        handler = page.routes[("GET", "/fprf/state")]
        first = json.loads((await handler(Request("GET", "/fprf/state", {}, {}))).body)
        waiting = asyncio.create_task(handler(Request("GET", "/fprf/state", {"after": str(first["version"])}, {})))
        await asyncio.sleep(0.05)
        assert not waiting.done()
        page.notify("a line to read")
        return first, json.loads((await asyncio.wait_for(waiting, 60)).body)

    first, second = asyncio.run(wait())
    assert first["said"] == [] and second["said"] == ["a line to read"] and second["version"] == first["version"] + 1
    assert first["shelf"] == [] and first["film"] == {"done": 0, "total": 0, "ready": False}
    with pytest.raises(UsageError):
        ask(page, "GET", "/fprf/state", {"after": "x"})


def test_keys_are_edited_by_their_places(page: Page) -> None:
    shot = Thumbnail(7, np.full((12, 16, 3), 200, np.uint8))
    keys = tuple(Key(CameraState((1, 0, 0, 0), (float(k), 0, 0), 1.0, 1.0), Look(), shot if k == 1 else None) for k in range(3))
    page._session.update(lambda state: replace(state, keys=keys))
    told = described(page._session.state)
    assert told["keys"] == [0, 7, 0] and told["chosen"] is None and not told["playing"]
    post(page, "/fprf/keys", key=1, action="earlier")
    assert [key.camera.position[0] for key in page._session.state.keys] == [1, 0, 2] and page._session.state.selected_key == 0
    post(page, "/fprf/keys", key=0, action="later")
    post(page, "/fprf/keys", key=2, action="remove")
    assert page._session.state.keys == keys[:2] and page._session.state.selected_key == 1
    answer = ask(page, "GET", "/fprf/key", {"key": "7"})
    picture = cv2.imdecode(np.frombuffer(answer.body, np.uint8), 1)
    assert answer.content_type == "image/jpeg" and picture.shape == (12, 16, 3) and abs(int(picture.mean()) - 200) < 3
    assert ask(page, "GET", "/fprf/key", {"key": "0"}).status == 404


def test_no_film_is_no_page(page: Page) -> None:
    assert ask(page, "GET", "/fprf/film").status == 404
