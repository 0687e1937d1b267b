"""Sessions without a network: what they post is kept here."""

import threading
import time
from collections.abc import Callable, Hashable, Iterable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from fprf.page.looks import Look, Photograph
from fprf.page.messages import Camera
from fprf.page.state import PageKeyframe
from fprf.scenes import Scene
from fprf.splats.pinholes import camera_of as pinhole_of
from fprf.style.dictionary import Reference


def camera_of(scene: Scene, view: int) -> Camera:
    """A captured camera as a client's."""
    camera = pinhole_of(scene.cameras, view)
    pose = camera.world_to_camera
    lens = camera.intrinsics
    axes = tuple(tuple(row) for row in pose[:3, :3].tolist())
    place = tuple((-pose[:3, :3].T @ pose[:3, 3]).tolist())
    numbers = tuple(float(lens[k]) for k in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return Camera(place=place, axes=axes, lens=numbers, size=(float(camera.width), float(camera.height)))


def keys_of(scene: Scene, looks: Iterable[Look]) -> tuple[PageKeyframe, ...]:
    """Keyframes at captured views."""
    return tuple(PageKeyframe(camera_of(scene, view), look) for view, look in enumerate(looks))


def until(true: Callable[[], bool], act: Callable[[], object] = lambda: None) -> None:
    """Wait for something to hold, and act meanwhile; fail after two minutes."""
    end = time.monotonic() + 120
    while not true():
        assert time.monotonic() < end
        act()
        time.sleep(0.01)


class Listener:
    """Remembers what clients are sent."""

    def __init__(self) -> None:
        self.sent: list[tuple[Hashable | None, str, Any]] = []
        self.news = threading.Condition()
        self.fails = False

    def post(self, client: Hashable | None, kind: str, message: Mapping[str, Any] | bytes) -> None:
        if self.fails and isinstance(message, bytes):
            raise RuntimeError("the client has gone")
        with self.news:
            self.sent.append((client, kind, message))
            self.news.notify_all()

    @property
    def said(self) -> list[str]:
        return [message["text"] for _, kind, message in self.sent if kind.startswith("said")]

    def pictures(self, client: Hashable, kind: str = "look") -> list[np.ndarray]:
        """Pictures of fields that a client was sent."""
        mine = [message for who, what, message in self.sent if who == client and what == kind]
        return [cv2.imdecode(np.frombuffer(each[1:], np.uint8), 1) for each in mine]

    def until(self, true: Callable[[], bool]) -> None:
        with self.news:
            assert self.news.wait_for(true, timeout=120)

    def until_said(self, part: str) -> None:
        self.until(lambda: any(part in text for text in self.said))


def card(number: int) -> Photograph:
    """A photograph on the shelf, of no content."""
    empty = Reference(f"{number}", torch.zeros(0, 2), torch.zeros(0, 2))
    return Photograph(
        number, f"{number}.png", Path(f"/tmp/{number}.png"), np.zeros((1, 1, 3), np.uint8), empty
    )
