"""The page made with viser: pictures behind its canvas, lines over it, controls, cameras and clicks from it."""

import contextlib
import io
import ipaddress
import secrets
import socket
import sys
import threading
from collections.abc import Hashable
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import torch
import viser
from numpy.typing import NDArray

from ..errors import FprfError, UsageError
from ..interfaces import Scene
from ..io.images import to_uint8
from ..rendering.cameras import pixel_grid
from ..splats.scene import SplatScene
from ..training.blocks import load_blocks
from .cameras import CameraState, Segments, box_edges, camera_frustums, checked_camera, path_segments
from .film import film_cameras
from .gaussian_renderer import Colours, page_gaussians
from .page import Page
from .panel import Panel
from .renderer import RenderedFrame
from .session import Frontend, Session
from .state import State

_COARSE_QUALITY, _FINAL_QUALITY = 70, 92
"""JPEG qualities of pictures on the way and of those that stay."""
_ORBIT = 0.5
"""Page units from a camera to the point that a drag turns it about."""
_BLUE, _YELLOW, _PINK = (94, 161, 255), (255, 196, 80), (255, 110, 150)
_FAR = 160.0
"""Page units beyond which nothing hides lines."""


class _ViserServer(viser.ViserServer):  # type: ignore[misc]  # viser is not there where types are checked
    """viser that never asks a service elsewhere to share the scene, whatever a page requests."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        return None


class ViserFrontend(Frontend):
    """Starts viser for a session; `address` is its own host and port, which nobody else is told."""

    def __init__(self, session: Session, page: Page) -> None:
        self._session, self._page = session, page
        with contextlib.redirect_stdout(io.StringIO()):  # it prints an address that is not ours
            self._viser = _ViserServer(host=_random_loopback(), port=0, verbose=False)
        self.address = (self._viser.get_host(), self._viser.get_port())
        self._viser.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False, control_width="medium")
        self._viser.gui.set_panel_label(session.viewed.name)
        self._viser.scene.set_up_direction(session.transform.up)
        self._viser.scene.world_axes.visible = False
        self._home = self._set_home()
        self._splats = self._add_gaussians(session.viewed.scene)
        self._lock = threading.Lock()
        self.panel = Panel(self._viser.gui, session, self._move_camera, self._camera_of, self.draw_lines)
        self._viser.on_client_connect(self._connected)
        self._viser.on_client_disconnect(self._disconnected)
        session.attach(self)

    def close(self) -> None:
        with contextlib.redirect_stdout(io.StringIO()):
            self._viser.stop()

    def show(self, client: Hashable, frame: RenderedFrame) -> None:
        """Put a picture behind a client's canvas; with its depth, where lines are to disappear behind things."""
        handle = self._viser.get_clients().get(client)
        if handle is None:
            return
        lined = self.panel.cameras or self.panel.blocks or bool(self._session.state.keys)
        handle.scene.set_background_image(
            frame.picture,
            format="jpeg",
            jpeg_quality=_FINAL_QUALITY if frame.final else _COARSE_QUALITY,
            depth=self._page_depth(frame) if lined else None,
        )
        handle.flush()

    def reload(self, scene: Scene) -> None:
        self._splats = self._add_gaussians(scene)
        self._viser.flush()

    def recolour(self, colours: Colours) -> None:
        if self._splats is not None:
            packed = self._splats.buffer.copy()
            rgba = packed[:, 7:].view(np.uint8)  # red, green, blue, opacity
            rgba[:, :3] = colours
            self._splats.buffer = packed
            self._viser.flush()

    def changed(self, before: State, now: State) -> None:
        with self._lock:
            self.panel.follow(before, now)
            if now.picking != before.picking:
                self._enable_clicks(now.picking)
        self._page.wake()

    def notify(self, text: str) -> None:
        self._page.notify(text)

    async def _connected(self, client: viser.ClientHandle) -> None:
        async def moved(camera: viser.CameraHandle) -> None:
            with contextlib.suppress(FprfError):  # a camera that is none shows nothing new
                self._session.move_camera(client.client_id, self._camera_of(client))

        client.camera.on_update(moved)
        home = self._home.for_aspect(self._camera_of(client).aspect)
        self._move_camera(client, home)
        self._session.move_camera(client.client_id, home)

    async def _disconnected(self, client: viser.ClientHandle) -> None:
        self._session.disconnect(client.client_id)

    def _camera_of(self, client: viser.ClientHandle) -> CameraState:
        camera = client.camera
        size = (camera.image_width, camera.image_height)
        return checked_camera(camera.wxyz.tolist(), camera.position.tolist(), camera.fov, *size)

    def _enable_clicks(self, on: bool) -> None:
        scene = self._viser.scene
        if not on:
            scene.remove_click_callback()
            return

        def clicked(event: viser.SceneClickEvent) -> None:
            x, y = event.screen_pos
            self._session.pick(event.client_id, (float(x), float(y)))

        scene.on_click()(clicked)

    def _move_camera(self, client: viser.ClientHandle, state: CameraState) -> None:
        with client.atomic():
            client.camera.position = np.asarray(state.position)
            client.camera.look_at = self._look_at(state)
            client.camera.up_direction = np.asarray(self._session.transform.up)
            client.camera.fov = state.fov
        client.flush()

    def _set_home(self) -> CameraState:
        """Let new clients begin at a captured view."""
        viewed, transform = self._session.viewed, self._session.transform
        state = transform.camera_state(viewed.scene.cameras, viewed.home)
        camera = self._viser.initial_camera  # where "reset view" leads
        camera.position, camera.look_at = np.asarray(state.position), self._look_at(state)
        camera.up, camera.fov = np.asarray(transform.up), state.fov
        return state

    def _add_gaussians(self, scene: Scene) -> Any:
        """Let browsers draw Gaussians over the scene's background, in the place of those before; None for a scene of others."""
        if not isinstance(scene, SplatScene):
            return None
        background = np.array(scene.background, np.float32)
        self._viser.scene.set_background_image(to_uint8(torch.tensor(background)[None, None]), format="png")
        gaussians = scene.seen.gaussians(scene.gaussians)
        means, covariances = page_gaussians(gaussians, self._session.transform)
        return self._viser.scene.add_gaussian_splats(
            "/gaussians",
            means.numpy(),
            covariances.numpy(),
            gaussians.colours.clamp(0, 1).numpy(),
            gaussians.opacities[:, None].numpy(),
        )

    def _look_at(self, state: CameraState) -> NDArray[np.float64]:
        pose = self._session.transform.cameras([state], (16, 16)).pose[0]
        return np.asarray(state.position) - _ORBIT * pose[:, 2].numpy()

    def draw_lines(self) -> None:
        """Draw the lines over the scene that the controls ask for."""
        session, panel = self._session, self.panel
        viewed, transform = session.viewed, session.transform
        cameras = viewed.scene.cameras.select(torch.tensor(viewed.captured)) if panel.cameras and viewed.captured else None
        self._lines("cameras", None if cameras is None else camera_frustums(transform, cameras, 0.04), _BLUE)
        boxes = None
        if panel.blocks and viewed.root is not None and viewed.space is not None and viewed.space.kind == "open":
            boxes = box_edges(transform, viewed.space, load_blocks(viewed.root))
        elif panel.blocks:
            self.notify("this scene is not cut into blocks")
        self._lines("blocks", boxes, _YELLOW)
        keys = () if session.state.playing else session.state.keys  # in a flight they would be in the way
        path = None
        if len(keys) > 1:
            try:
                path = path_segments(transform, film_cameras(transform, panel.plan))
            except UsageError as error:  # the flight is too long
                self.notify(str(error))
        self._lines("film", path, _PINK)
        places = transform.cameras([key.camera for key in keys], (160, 90)) if keys else None
        self._lines("keys", None if places is None else camera_frustums(transform, places, 0.08, behind=True), _PINK)
        for client in self._viser.get_clients().values():  # depth is sent where there is something to hide, or no more
            with contextlib.suppress(FprfError):
                session.move_camera(client.client_id, self._camera_of(client))

    def _lines(self, name: str, lines: Segments | None, colour: tuple[int, int, int]) -> None:
        if lines is None or not len(lines):
            self._viser.scene.remove_by_name(f"/{name}")
            return
        self._viser.scene.add_line_segments(f"/{name}", lines, colour, thickness=2.0, thickness_units="screen")

    def _page_depth(self, frame: RenderedFrame) -> NDArray[np.float32]:
        """Depth along the view's axis in page units."""
        height, width = frame.layers.depth.shape
        cameras = self._session.transform.cameras([frame.camera], (width, height))
        plane = (pixel_grid(cameras, 0) - cameras.centre[0]) / cameras.focal[0]
        along = (1 + plane.square().sum(-1)).rsqrt().view(height, width)
        depth: NDArray[np.float32] = (
            (frame.layers.depth * along * self._session.transform.scale).clamp(max=_FAR).float().numpy()
        )
        return depth


def page_of(name: str) -> bytes:
    """viser's page of a scene with our script and style sheet in it. Raises ValueError where it has no head."""
    page = (Path(viser.__file__).parent / "client" / "build" / "index.html").read_text("utf-8")
    head = page.index("</head>")
    ours = '<link rel="stylesheet" href="/fprf/page.css"><script defer src="/fprf/page.js"></script>'
    return f"{page[:head]}{ours}<title>{escape(name)} - fprf</title>{page[head:]}".encode()


def _random_loopback() -> str:
    """A loopback address that nobody can guess; 127.0.0.1 on systems that have but one.

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
