"""viser, kept behind the gate: the scene's picture behind its canvas, lines over it, cameras and clicks from it."""

import contextlib
import ipaddress
import os
import secrets
import socket
import sys
import threading
from collections.abc import Hashable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import torch
import viser

from ..errors import FprfError
from ..rendering.cameras import pixel_grid
from ..training.lay_out import load_boxes
from .cameras import Eye, checked_eye
from .film import path_of
from .lines import box_lines, camera_lines, path_lines
from .message_validation import check_message
from .page import Page, built_page
from .panel import Panel
from .renderer import Frame
from .session import Face, Session
from .state import State

__all__ = ["Server", "built_index", "check_bytes"]

_FRESH, _FINAL = 70, 92
"""JPEG qualities of pictures on the way and of those that stay."""


_ORBIT = 0.5
"""Page units from a camera to the point that a drag turns it about."""


class _Server(viser.ViserServer):  # type: ignore[misc]  # viser is not there where types are checked
    """Never asks a service elsewhere to share the scene, whatever a page says."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """No."""
        return None


class Server(Face):
    """Starts viser for a session and puts the page together."""

    def __init__(self, session: Session, page: Page) -> None:
        self._session, self._page = session, page
        with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):  # it prints an address that is not ours
            self._viser = _Server(host=_hidden_host(), port=0, verbose=False)
        self.inner = (self._viser.get_host(), self._viser.get_port())
        self._viser.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False, control_width="medium")
        self._viser.gui.set_panel_label(session.trained.known.name)
        self._viser.scene.set_up_direction(session.stage.up)
        self._viser.scene.world_axes.visible = False
        self._home = self._start_here()
        self._lock = threading.Lock()
        self.panel = Panel(self._viser.gui, session, self._fly, self._eye_of, self._draw)
        self._viser.on_client_connect(self._arrived)
        self._viser.on_client_disconnect(self._gone)
        session.meet(self)

    def close(self) -> None:
        """Hang up."""
        with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):
            self._viser.stop()

    def show(self, client: Hashable, frame: Frame) -> None:
        """Put a picture behind a client's canvas; with its depth, where lines are to disappear behind things."""
        handle = self._viser.get_clients().get(client) if isinstance(client, int) else None
        if handle is None:
            return
        lined = self.panel.cameras or self.panel.blocks or bool(self._session.state.keys)
        handle.scene.set_background_image(
            frame.picture,
            format="jpeg",
            jpeg_quality=_FINAL if frame.final else _FRESH,
            depth=self._page_depth(frame) if lined else None,
        )
        handle.flush()

    def changed(self, before: State, now: State) -> None:
        """Controls and page follow."""
        with self._lock:
            self.panel.follow(before, now)
            if now.picking != before.picking:
                self._clicks(now.picking)
        self._page.wake()

    def say(self, text: str, client: Hashable | None = None) -> None:
        """On all pages: a client's own mistake is nothing to hide."""
        self._page.say(text)

    async def _arrived(self, client: viser.ClientHandle) -> None:
        async def moved(camera: viser.CameraHandle) -> None:
            with contextlib.suppress(FprfError):  # a camera that is none shows nothing new
                self._session.see(client.client_id, self._eye_of(client))

        client.camera.on_update(moved)
        self._fly(client, self._home)
        self._session.see(client.client_id, self._home._replace(aspect=self._eye_of(client).aspect))

    async def _gone(self, client: viser.ClientHandle) -> None:
        self._session.leave(client.client_id)

    def _eye_of(self, client: viser.ClientHandle) -> Eye:
        camera = client.camera
        size = (camera.image_width, camera.image_height)
        return checked_eye(camera.wxyz.tolist(), camera.position.tolist(), camera.fov, *size)

    def _clicks(self, on: bool) -> None:
        scene = self._viser.scene
        if not on:
            scene.remove_click_callback()
            return

        def clicked(event: viser.SceneClickEvent) -> None:
            x, y = event.screen_pos
            self._session.pick(event.client_id, (float(x), float(y)))

        scene.on_click()(clicked)

    def _fly(self, client: viser.ClientHandle, eye: Eye) -> None:
        camera = self._session.stage.cameras([eye], (16, 16))
        ahead = -camera.pose[0, :, 2].numpy()
        with client.atomic():
            client.camera.position = np.asarray(eye.position)
            client.camera.look_at = np.asarray(eye.position) + _ORBIT * ahead
            client.camera.up_direction = np.asarray(self._session.stage.up)
            client.camera.fov = eye.fov
        client.flush()

    def _start_here(self) -> Eye:
        """New clients begin at a captured view, the middle one of those that training did not see."""
        known, stage = self._session.trained.known, self._session.stage
        views = known.test or known.train
        eye = stage.eye(known.cameras, views[len(views) // 2])
        camera = self._viser.initial_camera  # where "reset view" leads
        camera.position = np.asarray(eye.position)
        camera.look_at = np.asarray(eye.position) - known.cameras.pose[views[len(views) // 2], :, 2].numpy() * _ORBIT
        camera.up = np.asarray(stage.up)
        camera.fov = eye.fov
        return eye

    def _draw(self, panel: Panel) -> None:
        """Lines over the scene, as the controls say."""
        session = self._session
        known, stage = session.trained.known, session.stage
        cameras = known.cameras.select(torch.tensor(known.train)) if panel.cameras else None
        self._lines("cameras", None if cameras is None else camera_lines(stage, cameras, 0.04), (94, 161, 255))
        boxes = None
        if panel.blocks and known.facts.space.kind == "open":
            boxes = box_lines(stage, known.facts.space, load_boxes(session.trained.run.root))
        elif panel.blocks:
            self.say("this scene is not cut into blocks")
        self._lines("blocks", boxes, (255, 196, 80))
        keys = () if session.state.playing else session.state.keys  # in a flight they would be in the way
        path = path_lines(stage, path_of(stage, panel.plan)) if len(keys) > 1 else None
        self._lines("film", path, (255, 110, 150))
        places = camera_lines(stage, stage.cameras([key.eye for key in keys], (160, 90)), 0.08, behind=True) if keys else None
        self._lines("keys", places, (255, 110, 150))
        for client in self._viser.get_clients().values():  # depth is sent where there is something to hide, or no more
            with contextlib.suppress(FprfError):
                session.see(client.client_id, self._eye_of(client))

    def _lines(self, name: str, lines: Any, colour: tuple[int, int, int]) -> None:
        if lines is None or not len(lines):
            self._viser.scene.remove_by_name(f"/{name}")
            return
        self._viser.scene.add_line_segments(f"/{name}", lines, colour, thickness=2.0, thickness_units="screen")

    def _page_depth(self, frame: Frame) -> Any:
        """Depth along the view's axis in page units."""
        height, width = frame.layers.depth.shape
        cameras = self._session.stage.cameras([frame.eye], (width, height))
        plane = (pixel_grid(cameras, 0) - cameras.centre[0]) / cameras.focal[0]
        along = (1 + plane.square().sum(-1)).rsqrt().view(height, width)
        return (frame.layers.depth * along * self._session.stage.scale).clamp(max=160).float().numpy()


def built_index(name: str) -> bytes:
    """The page of a scene."""
    index = Path(viser.__file__).parent / "client" / "build" / "index.html"
    return built_page(index.read_text("utf-8"), f"{name} - fprf")


def check_bytes(payload: bytes) -> None:
    """`check_message` of a WebSocket message. Raises DataError."""
    try:
        message = msgspec.msgpack.decode(payload)
    except (msgspec.DecodeError, ValueError, RecursionError):
        message = None
    check_message(message)


def _hidden_host() -> str:
    """A loopback address that nobody can guess, so that only the gate leads to viser; 127.0.0.1 where there is but one.

    viser asks no one who they are. Another site's page in the same browser cannot try 2^24 addresses with all their ports.
    """
    host = str(ipaddress.IPv4Address((127 << 24) + secrets.randbelow((1 << 24) - 2) + 1))
    if not sys.platform.startswith("linux"):
        return "127.0.0.1"
    with contextlib.closing(socket.socket()) as probe:
        try:
            probe.bind((host, 0))
        except OSError:
            return "127.0.0.1"
    return host
