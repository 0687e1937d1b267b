"""What only viser can show, without a browser. Skipped where the extra `viewer` is not installed."""

import ipaddress
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from tiny_world import World

from fprf.errors import DataError
from fprf.viewer.page import Page
from fprf.viewer.session import Session
from fprf.viewer.state import State

viser = pytest.importorskip("viser", reason="the extra `viewer` is not installed")
msgspec = pytest.importorskip("msgspec")


@pytest.fixture
def served(world: World) -> Iterator[tuple[Session, Any]]:
    from fprf.viewer.frontend import Server

    with Session(world.load(), State(pixels=64)) as session:
        server = Server(session, Page(session, b"<html>"))
        yield session, server
        server.close()


def test_viser_listens_where_nobody_looks_and_shares_nothing(served: tuple[Session, Any]) -> None:
    _, server = served
    host, port = server.inner
    assert ipaddress.ip_address(host).is_loopback and port > 0
    assert server._viser.request_share_url() is None


@pytest.mark.parametrize("payload", [b"", b"\xff", b"x" * 100, b"\x81", b"\x93\x01\x02\x03"])
def test_bytes_that_are_no_message_are_refused(payload: bytes) -> None:
    from fprf.viewer.frontend import check_bytes

    with pytest.raises(DataError):
        check_bytes(payload)


def test_messages_of_the_page_pass(served: tuple[Session, Any]) -> None:
    from fprf.viewer.frontend import check_bytes

    camera = {"wxyz": [1, 0, 0, 0], "position": [0, 0, 0], "look_at": [0, 0, 1], "up_direction": [0, 0, 1]}
    numbers = {"fov": 1.0, "near": 0.1, "far": 10.0, "image_height": 48, "image_width": 64}
    check_bytes(msgspec.msgpack.encode({"type": "ViewerCameraMessage", **camera, **numbers}))
    with pytest.raises(DataError, match="none that this page sends"):
        check_bytes(msgspec.msgpack.encode({"type": "RunJavascriptMessage", "source": "x"}))


def test_the_page_of_a_scene_is_viser_s_with_ours_in_it() -> None:
    from fprf.viewer.frontend import built_index

    page = built_index("<town>")
    assert b"/fprf/page.js" in page and b"&lt;town&gt; - fprf" in page and len(page) > 10_000


def test_controls_lines_and_clicks_follow_the_state(served: tuple[Session, Any]) -> None:
    from dataclasses import replace

    session, server = served
    session.change(lambda state: replace(state, map="depth", picking=True))
    assert server.panel._map.value == "depth"
    session.change(lambda state: replace(state, picking=False))
    server.panel._cameras.value = True
    server._draw(server.panel)
    server.panel._blocks.value = True  # of a scene that has none
    server._draw(server.panel)
    server.say("a line")


def test_who_has_gone_is_shown_nothing(served: tuple[Session, Any]) -> None:
    session, server = served
    eye = session.stage.eye(session.trained.known.cameras, 0)
    frames: list[Any] = []
    session._sight._show = lambda client, frame: frames.append(frame)
    from fprf.viewer.renderer import Glance

    for _ in session._sight.look(9, Glance(eye, session.state.shown, 32)):
        pass
    server.show(9, frames[-1])
    server.show("no client", frames[-1])
    depth = server._page_depth(frames[-1])
    assert depth.shape == frames[-1].picture.shape[:2] and depth.dtype == np.float32 and (depth <= 160).all()
