import asyncio
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from session_helpers import ask, post
from tiny_world import World

from fprf.errors import DataError, UsageError
from fprf.viewer.cameras import CameraState
from fprf.viewer.page import Page, described
from fprf.viewer.routes import Request, Response
from fprf.viewer.session import Session
from fprf.viewer.state import FilmProgress, Key, Look, Photograph, RegionInfo, Thumbnail


@pytest.fixture
def page(session: Session) -> Page:
    return Page(session, b"<html>")


def picture_of(response: Response) -> Any:
    return cv2.imdecode(np.frombuffer(response.body, np.uint8), 1)


def add_photographs(page: Page, world: World) -> list[Photograph]:
    for path in world.references:
        row = json.loads(ask(page.routes, "POST", "/fprf/photograph", path.read_bytes(), name=path.name).body)
        assert row == {"card": page._session.state.shelf[-1].number, "name": path.name}
    return list(page._session.state.shelf)


def test_script_and_sheet_are_served(page: Page) -> None:
    for name, kind, part in (("page.js", "javascript", b"drop"), ("page.css", "css", b".fprf")):
        answer = ask(page.routes, "GET", f"/fprf/{name}")
        assert answer.content_type == f"text/{kind}; charset=utf-8" and part in answer.body
    assert ask(page.routes, "GET", "/").body == b"<html>"


def test_a_photograph_is_dropped_weighed_shown_and_removed(page: Page, session: Session, world: World) -> None:
    one, two = add_photographs(page, world)
    assert session.state.look.mix == ((two, 1.0),)
    post(page.routes, "/fprf/shelf", card=one.number, action="weight", weight=0.5)
    assert session.state.look.mix == ((one, 0.5), (two, 1.0))
    session.update(lambda state: replace(state, map="matches"))
    shelf = described(session.state)["shelf"]
    assert [row["weight"] for row in shelf] == [0.5, 1.0] and len({row["colour"] for row in shelf} - {None}) == 2
    post(page.routes, "/fprf/shelf", card=one.number, action="alone")
    assert session.state.look.mix == ((one, 1.0),)
    assert picture_of(ask(page.routes, "GET", "/fprf/card", card=one.number)).shape == (40, 56, 3)
    post(page.routes, "/fprf/shelf", card=one.number, action="remove")
    assert session.state.shelf == (two,) and session.state.look.plain


def test_a_region_gets_its_rules(page: Page, session: Session, world: World) -> None:
    one, two = add_photographs(page, world)
    with pytest.raises(UsageError, match="none is picked"):
        post(page.routes, "/fprf/region", verb="keep")
    session.update(lambda state: replace(state, picked=RegionInfo(1, 0.2, ())))
    post(page.routes, "/fprf/region", verb="pin", card=one.number)  # it joins the mix
    assert session.state.look.mix == ((one, 1.0), (two, 1.0)) and {*session.state.look.rules} == {(1, "pin", one)}
    assert described(session.state)["picked"]["orders"] == [{"verb": "pin", "card": one.number}]
    post(page.routes, "/fprf/region", verb="keep")
    assert [rule.action for rule in session.state.look.rules] == ["keep"]
    post(page.routes, "/fprf/region", verb="free")
    assert session.state.look.rules == frozenset()


def test_the_wipe_moves_only_where_there_is_one(page: Page, session: Session) -> None:
    post(page.routes, "/fprf/wipe", at=0.2)
    assert session.state.wipe is None
    session.update(lambda state: replace(state, wipe=0.5))
    post(page.routes, "/fprf/wipe", at=0.2)
    assert session.state.wipe == 0.2


WRONG = {
    "shelf": (
        b"{", b"[]", b"[" * 4000, b'"' + b"x" * 5000 + b'"', b'{"card": 99, "action": "alone"}',
        b'{"card": "../x", "action": "alone"}', b'{"card": CARD, "action": "explode"}',
        b'{"card": CARD, "action": "weight", "weight": -1}', b'{"card": CARD, "action": "weight", "weight": "x"}',
    ),
    "region": (b'{"verb": "explode"}',),
    "wipe": (b'{"at": 2}', b'{"at": NaN}', b'{"at": true}', b"{}"),
    "photograph": (b"not a photograph",),
    "keys": (b'{"key": 9, "action": "remove"}', b'{"key": 0, "action": "x"}', b"{}"),
}  # fmt: skip


def test_nonsense_is_refused_and_changes_nothing(page: Page, session: Session, world: World) -> None:
    card, _ = add_photographs(page, world)
    before = session.state
    for path, bodies in WRONG.items():
        for body in bodies:
            with pytest.raises((UsageError, DataError)):
                ask(page.routes, "POST", f"/fprf/{path}", body.replace(b"CARD", str(card.number).encode()))
    for text in ("x", "-2", "²", "1" * 13):
        with pytest.raises(UsageError, match="after"):
            ask(page.routes, "GET", "/fprf/state", after=text)
    assert session.state == before


def test_a_waiting_page_is_answered_when_something_is_new(page: Page) -> None:
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


def test_keys_are_edited_by_their_places(page: Page, session: Session) -> None:
    shot = Thumbnail(7, np.full((12, 16, 3), 200, np.uint8))
    keys = tuple(Key(CameraState((1, 0, 0, 0), (float(k), 0, 0), 1.0, 1.0), Look(), shot if k == 1 else None) for k in range(3))
    session.update(lambda state: replace(state, keys=keys))
    told = described(session.state)
    assert told["keys"] == [0, 7, 0] and told["chosen"] is None and not told["playing"]
    post(page.routes, "/fprf/keys", key=1, action="earlier")
    assert [key.camera.position[0] for key in session.state.keys] == [1, 0, 2] and session.state.selected_key == 0
    post(page.routes, "/fprf/keys", key=0, action="later")
    post(page.routes, "/fprf/keys", key=2, action="remove")
    assert session.state.keys == keys[:2] and session.state.selected_key == 1
    answer = ask(page.routes, "GET", "/fprf/key", key=7)
    picture = picture_of(answer)
    assert answer.content_type == "image/jpeg" and picture.shape == (12, 16, 3) and abs(int(picture.mean()) - 200) < 3
    assert ask(page.routes, "GET", "/fprf/key", key=0).status == 404


def test_films_and_pictures_are_downloads_when_they_are_there(page: Page, session: Session, tmp_path: Path) -> None:
    assert ask(page.routes, "GET", "/fprf/film").status == ask(page.routes, "GET", "/fprf/picture", number=0).status == 404
    folder = tmp_path / "0001"
    folder.mkdir()
    for name in ("film.mp4", "0001.png"):
        (folder / name).write_bytes(name.encode())
    session.viewed = replace(session.viewed, name='the "town"')
    film = FilmProgress(2, 2, folder / "film.mp4")
    session.update(lambda state: replace(state, film=film, pictures=(folder / "0001.png",)))
    for path, kind, data in (("film", "video/mp4", b"film.mp4"), ("picture", "image/png", b"0001.png")):
        answer = ask(page.routes, "GET", f"/fprf/{path}", number=0)
        ending = data[-4:].decode()
        header = {"content-disposition": f'attachment; filename="the__town_-0001{ending}"'}
        assert (answer.content_type, answer.body, answer.headers) == (kind, data, header)
    with pytest.raises(UsageError, match="no Gaussians"):
        ask(page.routes, "GET", "/fprf/gaussians")
