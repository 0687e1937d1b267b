"""What only viser can show, without a browser. Skipped where the extra `viewer` is not installed."""

import ipaddress
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from session_helpers import camera_of

pytest.importorskip("viser", reason="the extra `viewer` is not installed")

from fprf.viewer.frontend import ViserFrontend, page_of
from fprf.viewer.page import Page
from fprf.viewer.renderer import RenderRequest
from fprf.viewer.session import Session
from fprf.viewer.state import Key, Look


@pytest.fixture
def frontend(session: Session) -> Iterator[ViserFrontend]:
    frontend = ViserFrontend(session, Page(session, b"<html>"))
    yield frontend
    frontend.close()


def test_viser_listens_on_this_machine_and_shares_nothing(frontend: ViserFrontend) -> None:
    host, port = frontend.address
    assert ipaddress.ip_address(host).is_loopback and port > 0
    assert frontend._viser.request_share_url() is None


def test_the_page_of_a_scene_is_viser_s_with_ours_in_it() -> None:
    page = page_of("<town>")
    assert page.index(b"/fprf/page.js") < page.index(b"</head>") and b"&lt;town&gt; - fprf" in page and len(page) > 10_000


def test_controls_lines_and_clicks_follow_the_state(session: Session, frontend: ViserFrontend) -> None:
    session.update(lambda state: replace(state, map="depth", picking=True))
    controls = {control.label: control.value for control, _ in frontend.panel._bound}
    assert controls["map"] == "depth" and controls["pick a region"]
    session.update(lambda state: replace(state, picking=False))
    frontend.panel._cameras.value = frontend.panel._blocks.value = True  # the scene has no blocks
    frontend.draw_lines()
    frontend.notify("a line")


def test_a_flight_that_is_too_long_is_told_and_draws_no_path(session: Session, frontend: ViserFrontend) -> None:
    keys = tuple(Key(camera_of(session.viewed.scene, view % 5), Look()) for view in range(12))
    frontend.panel._seconds.value = 60.0
    assert session.update(lambda state: replace(state, keys=keys, map="depth"))
    assert next(control.value for control, _ in frontend.panel._bound if control.label == "map") == "depth"


def test_a_client_that_has_gone_is_shown_nothing(session: Session, frontend: ViserFrontend) -> None:
    camera = camera_of(session.viewed.scene, 0)
    frames: list[Any] = []
    session.renderer._show = lambda client, frame: frames.append(frame)
    for _ in session.renderer.render(9, RenderRequest(camera, session.state.view, 32)):
        pass
    frontend.show(9, frames[-1])
    frontend.show("no client", frames[-1])
    depth = frontend._page_depth(frames[-1])
    assert depth.shape == frames[-1].picture.shape[:2] and depth.dtype == np.float32 and (depth <= 160).all()
