"""What tests of the viewer share: views of a scene, films, a page that remembers what it is told, requests, and waiting."""

import asyncio
import json
import threading
import time
from collections.abc import Callable, Hashable, Sequence
from typing import Any

from fprf.interfaces import Scene
from fprf.training.loading import Trained
from fprf.viewer.cameras import CameraState, page_transform
from fprf.viewer.film import FilmPlan
from fprf.viewer.gaussian_renderer import Colours
from fprf.viewer.renderer import RenderedFrame
from fprf.viewer.routes import Request, Response, Routes
from fprf.viewer.session import Frontend, Viewed, view_of_run
from fprf.viewer.state import Key, Look, State


def viewed(trained: Trained) -> Viewed:
    return view_of_run(trained, trained.run, trained.known)


def camera_of(scene: Scene, view: int) -> CameraState:
    return page_transform(scene.cameras).camera_state(scene.cameras, view)


def plan_of(scene: Scene, looks: Sequence[Look], seconds: float = 0.1, fps: float = 30.0) -> FilmPlan:
    """A film with a key at each of the first views."""
    keys = tuple(Key(camera_of(scene, view), look) for view, look in enumerate(looks))
    return FilmPlan(keys, seconds, fps, (32, 24))


def ask(routes: Routes, method: str, path: str, body: bytes = b"", /, **query: object) -> Response:
    """The answer of a page's handler."""

    async def answered() -> Response:
        fields = {name: str(value) for name, value in query.items()}
        return await routes[(method, path)](Request(method, path, fields, {}, body))

    return asyncio.run(answered())


def post(routes: Routes, path: str, /, **asked: object) -> Any:
    return json.loads(ask(routes, "POST", path, json.dumps(asked).encode()).body)


def until(true: Callable[[], bool], act: Callable[[], object] = lambda: None) -> None:
    """Wait for something to hold, and act meanwhile; fail after two minutes."""
    end = time.monotonic() + 120
    while not true():
        assert time.monotonic() < end
        act()
        time.sleep(0.01)


class Listener(Frontend):
    """Remembers what it is told."""

    def __init__(self) -> None:
        self.frames: list[tuple[Hashable, RenderedFrame]] = []
        self.states: list[State] = []
        self.colours: list[Colours] = []
        self.scenes: list[Scene] = []
        self.said: list[str] = []
        self.news = threading.Condition()
        self.fails = False

    def show(self, client: Hashable, frame: RenderedFrame) -> None:
        if self.fails:
            raise RuntimeError("the client has gone")
        self._add(self.frames, (client, frame))

    def reload(self, scene: Scene) -> None:
        self._add(self.scenes, scene)

    def recolour(self, colours: Colours) -> None:
        self._add(self.colours, colours)

    def changed(self, before: State, now: State) -> None:
        self._add(self.states, now)

    def notify(self, text: str) -> None:
        self._add(self.said, text)

    def until(self, true: Callable[[], bool]) -> None:
        with self.news:
            assert self.news.wait_for(true, timeout=120)

    def until_said(self, part: str) -> None:
        self.until(lambda: any(part in text for text in self.said))

    def final(self) -> dict[Hashable, RenderedFrame]:
        """The sharpest pictures of the clients that have one."""
        return {client: frame for client, frame in self.frames if frame.final}

    def _add(self, heard: list[object], what: object) -> None:
        with self.news:
            heard.append(what)
            self.news.notify_all()
