"""The scene that is viewed: its state, its clients' cameras, and everything that changes either. Knows no page.

Calls come from any thread. What touches the model runs on the render worker; the `Frontend` learns of the results.
"""

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable
from concurrent.futures import Future
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import TypeVar

import numpy as np

from ..errors import FprfError, UsageError
from ..interfaces import Scene
from ..io.images import Picture, encode, shrink, write_image
from ..plugins.stylizers.config import RegionToneConfig
from ..rendering.space import Space
from ..splats.files import Capture, write_capture, write_gaussians
from ..splats.scene import SplatScene
from ..training.loading import Trained
from ..training.run import Known, Run
from .cameras import CameraState, PageTransform, page_transform
from .film import FilmRecorder
from .gaussian_renderer import Colours, GaussianRenderer
from .render_worker import RenderWorker, Steps
from .renderer import ProgressiveRenderer, RenderedFrame, RenderRequest, SceneRenderer, first_speeds
from .restyler import OpenEncoders, Restyler, matching_regions
from .state import Look, Photograph, State, Thumbnail, ViewSettings, add_photograph, only, renumber_regions
from .uploads import Uploads, shown_name

T = TypeVar("T")

_POLL = 0.5
"""Seconds between looks whether the worker is closed."""
_THUMBNAIL = 192
"""Longest side of a key's picture."""


@dataclass(frozen=True)
class Viewed:
    """A scene with what the page says of it."""

    scene: Scene
    name: str
    home: int
    """View at which clients begin."""
    captured: tuple[int, ...] = ()
    """Views from which it was trained."""
    root: Path | None = None
    """Folder for films and pictures: that of a run; None = there is none."""
    capture: Capture | None = None
    """The file of Gaussians that it was read from; None = it is a run."""
    space: Space | None = None
    """Of fields, in which blocks lie."""
    stylizer: RegionToneConfig | None = None
    """Style that a look starts from; None = the default."""


def view_of_run(scene: Scene, run: Run, known: Known) -> Viewed:
    """A run, beginning at the middle one of the views that training did not see."""
    views = known.test or known.train
    return Viewed(scene, known.name, views[len(views) // 2], tuple(known.train), run.root, space=known.facts.space)


class Frontend(ABC):
    """The page, as a session talks to it. Called from several threads; a call that fails harms nothing."""

    @abstractmethod
    def show(self, client: Hashable, frame: RenderedFrame) -> None:
        """Show a picture to a client."""

    @abstractmethod
    def reload(self, scene: Scene) -> None:
        """Show another state of the scene to all clients, where their browsers draw it."""

    @abstractmethod
    def recolour(self, colours: Colours) -> None:
        """Show Gaussians in other colours to all clients."""

    @abstractmethod
    def changed(self, before: State, now: State) -> None:
        """Follow a change of the state."""

    @abstractmethod
    def notify(self, text: str) -> None:
        """Show a line of text to all clients: one's mistake is nothing to hide."""


class Session:
    """Use as a context manager, which ends its threads and processes."""

    def __init__(self, viewed: Viewed, state: State, open_encoders: OpenEncoders | None = None) -> None:
        self.viewed = viewed
        self.transform: PageTransform = page_transform(viewed.scene.cameras)
        self.restyler = Restyler(viewed.scene, open_encoders, viewed.stylizer)
        self.state = state
        self._frontend: Frontend | None = None
        self._cameras: dict[Hashable, CameraState] = {}
        self._photographs: frozenset[Photograph] = frozenset()
        self._lock = threading.RLock()
        self._speeds = first_speeds()
        self.renderer = self._make_renderer()
        self._worker: RenderWorker[RenderRequest] = RenderWorker(
            lambda client, request: self.renderer.render(client, request), self._on_error
        )
        self.films = FilmRecorder(self, self._worker)
        self._pictures: dict[Hashable, Picture] = {}
        self._thumbnails = count(1)
        self.uploads = Uploads()

    def __enter__(self) -> "Session":
        self._worker.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._worker.close()  # a film that is being made is left unfinished
        self.uploads.close()

    def attach(self, frontend: Frontend) -> None:
        """Set who is told of pictures, changes and messages."""
        self._frontend = frontend

    def warm_up(self) -> None:
        """Prepare what the first photograph needs while nobody waits: decoder, encoders, kernels, a style."""
        threading.Thread(target=self.uploads.start_decoder, name="fprf-warm-up", daemon=True).start()

        def work() -> Steps:
            self.restyler.encoders  # noqa: B018  they are opened by asking for them
            yield
            path = self.uploads.folder / "warm-up.png"
            ramp = np.linspace(0, 255, 96 * 128 * 3).reshape(96, 128, 3).astype(np.uint8)
            path.write_bytes(encode(ramp, "png"))
            photograph = self.restyler.encode(path, "warm-up")
            yield
            look = only(State().look, photograph)
            self.restyler.styled(look)
            yield
            camera = self.transform.camera_state(self.viewed.scene.cameras, 0)
            yield from self.renderer.render(None, RenderRequest(camera, replace(State(), look=look).view, 32))
            self.renderer.forget(None)
            self.restyler.retain(self.state.photographs)

        self._worker.run_when_idle(work())

    def move_camera(self, client: Hashable, camera: CameraState) -> None:
        """Render what a client's camera sees now."""
        with self._lock:
            if not self.films.playing(client):
                self._cameras[client] = camera
                self.refresh(client)

    def disconnect(self, client: Hashable) -> None:
        """Drop everything of a client."""
        with self._lock:
            self._cameras.pop(client, None)
            self._pictures.pop(client, None)
        self.films.stop(client)
        self._worker.forget(client)
        self._worker.run(("forget", client), lambda: self.renderer.forget(client))

    @property
    def has_clients(self) -> bool:
        """True while anybody is connected."""
        return bool(self._cameras)

    @property
    def in_browser(self) -> bool:
        """True where the clients' browsers draw the scene, not this machine."""
        return isinstance(self.viewed.scene, SplatScene)

    @property
    def idle(self) -> bool:
        """True when all clients have their sharpest picture."""
        return self._worker.idle

    def reload(self, load: Callable[[], Viewed], open_encoders: OpenEncoders | None = None) -> None:
        """Replace the scene by another state of its training, between two steps of the worker."""

        def job() -> None:
            self.viewed = load()
            before = self.restyler.reload(self.viewed.scene, open_encoders)
            self.renderer = self._make_renderer()
            if self._frontend is not None:
                self._frontend.reload(self.viewed.scene)
            if before is not None and self.state.names_regions:
                regions = matching_regions(before, self.restyler.encoders.scene).tolist()
                self.update(lambda state: renumber_regions(state, regions))
            self._request_all()
            if self.state.picked is not None:
                self.select_region(self.state.picked.region)

        self._worker.run("reload", job)

    def notify(self, text: str) -> None:
        if self._frontend is not None:
            self._frontend.notify(text)

    def update(self, change: Callable[[State], State]) -> bool:
        """Replace the state for all clients; return False and say why where that is not possible."""
        try:
            self.apply(change)
        except FprfError as error:
            self.notify(str(error))
            return False
        return True

    def apply(self, change: Callable[[State], State]) -> None:
        """Replace the state for all clients. Raises what `change` raises."""
        with self._lock:
            before, self.state = self.state, change(self.state)
            now = self.state
            if (before.view, before.pixels) != (now.view, now.pixels):
                self._request_all()
        if now.picked is not None and now.look != before.look:
            self.select_region(now.picked.region)  # what it takes has changed
        if now != before and self._frontend is not None:
            self._frontend.changed(before, now)

    def upload(self, data: bytes, name: str) -> Photograph:
        """Decode and encode a photograph and restyle the scene with it. Raises DataError for what is none."""
        path = self.uploads.store(data)

        def add() -> Photograph:
            photograph = self.restyler.encode(path, _unused_name(shown_name(name), self.state))
            self.update(lambda state: add_photograph(state, photograph))
            self._delete_unused(photograph)
            return photograph

        return self._result(("add", path), add)

    def gaussians(self) -> bytes:
        """The Gaussians in the look of now, as a .ply file. Raises UsageError for a scene without any."""
        viewed, scene = self.viewed, self.viewed.scene
        if not isinstance(scene, SplatScene):
            raise UsageError(f"{viewed.name}: no Gaussians; `fprf export` makes some of a field")

        def written() -> bytes:
            path = self.uploads.folder / "restyled.ply"
            shown = scene.restyled(self.restyler.restyle(self.state.look)).shown
            if viewed.capture is None:
                write_gaussians(path, shown, antialiased=scene.antialiased, views=scene.views, plain=True, origin=scene.origin)
            else:
                write_capture(path, viewed.capture, shown.harmonics)
            return path.read_bytes()

        return self._result("gaussians", written)

    def save_picture(self, camera: CameraState, size: tuple[int, int]) -> None:
        """Render what a camera sees, at a width and height, into the scene's folder while no client waits for a picture."""
        cameras, root = self.transform.cameras([camera], size), self.viewed.root or self.uploads.folder

        def work() -> Steps:
            try:
                picture = yield from self.renderer.frame(cameras, 0, self.restyler.restyle(self.state.look))
                folder = root / "pictures"
                path = next(each for n in count(1) if not (each := folder / f"{n:04d}.png").exists())
                folder.mkdir(parents=True, exist_ok=True)
                write_image(path, picture)
            except FprfError as error:
                self.notify(f"picture: {error}")
            else:
                self.update(lambda state: replace(state, pictures=(*state.pictures, path)))

        self._worker.run_when_idle(work())

    def pick(self, client: Hashable, place: tuple[float, float]) -> None:
        """Select the region at a click, given as shares of the client's width and height; none where there is nothing."""

        def job() -> None:
            camera = self._cameras.get(client)
            if camera is None:
                return
            side = 1000
            cameras = self.transform.cameras([camera], (round(side * camera.aspect), side))
            width, height = cameras.size[0].tolist()
            self._select(self.restyler.region_at(cameras, (place[0] * width, place[1] * height)))

        self._worker.run(("pick", client), job)

    def select_region(self, region: int | None) -> None:
        """Select a region by number, or none."""
        self._worker.run("select", lambda: self._select(region))

    def preview(self, client: Hashable, camera: CameraState, look: Look) -> None:
        """Show one client another look than that of all."""
        with self._lock:
            if client in self._cameras and not self.in_browser:  # there all clients have one look
                self._cameras[client] = camera = camera._replace(aspect=self._cameras[client].aspect)
                self._worker.request(client, RenderRequest(camera, ViewSettings(look), self.state.pixels))

    def refresh(self, client: Hashable) -> None:
        """Show one client what its camera sees, in the look of all."""
        with self._lock:
            if client in self._cameras:
                self._worker.request(client, RenderRequest(self._cameras[client], self.state.view, self.state.pixels))

    def picture(self, client: Hashable) -> Picture | None:
        """The last picture that a client was shown."""
        return self._pictures.get(client)

    def thumbnail(self, client: Hashable) -> Thumbnail | None:
        """The last picture that a client was shown, small."""
        picture = self._pictures.get(client)
        if picture is None:
            return None
        return Thumbnail(next(self._thumbnails), shrink(picture, _THUMBNAIL))

    def _result(self, name: Hashable, call: Callable[[], T]) -> T:
        """Run a call on the worker and return its result. Raises what it raises."""
        done: Future[T] = Future()

        def job() -> None:
            try:
                done.set_result(call())
            except Exception as error:
                done.set_exception(error)

        self._worker.run(name, job)
        while True:  # waiting for ever would keep the process from ending
            try:
                return done.result(_POLL)
            except TimeoutError:
                if self._worker.closed and not done.done():
                    raise UsageError("the viewer is ending") from None

    def _make_renderer(self) -> SceneRenderer:
        scene = self.viewed.scene
        if isinstance(scene, SplatScene):
            return GaussianRenderer(scene, self.restyler, self._recolour)
        if isinstance(scene, Trained):
            return ProgressiveRenderer(scene, self.restyler, self.transform, self._show, self._speeds)
        raise UsageError(f"{self.viewed.name}: the viewer shows runs of fields and Gaussians, not {type(scene).__name__}")

    def _delete_unused(self, added: Photograph) -> None:
        """Delete photographs that left the shelf and that no look needs, with what was made of them: some 6 MB each."""
        used = self.state.photographs
        for gone in {*self._photographs, added} - used:
            if gone.path.parent == self.uploads.folder:
                gone.path.unlink(missing_ok=True)
        self._photographs = used
        self.restyler.retain(used)

    def _select(self, region: int | None) -> None:
        regions = self.restyler.regions
        if region is not None and not 0 <= region < regions:
            raise UsageError(f"region {region}: regions go from 0 to {regions - 1}")
        picked = None if region is None else self.restyler.region_info(self.state.look, region)
        self.update(lambda state: replace(state, picked=picked))

    def _request_all(self) -> None:
        with self._lock:
            for client in self._cameras:
                self.refresh(client)

    def _show(self, client: Hashable, frame: RenderedFrame) -> None:
        if self._frontend is not None and client is not None:  # the warm-up has no client
            self._pictures[client] = frame.picture
            self._frontend.show(client, frame)

    def _recolour(self, colours: Colours) -> None:
        if self._frontend is not None:
            self._frontend.recolour(colours)

    def _on_error(self, error: Exception) -> None:
        expected = isinstance(error, FprfError)
        self.notify(str(error) if expected else f"this should not have happened: {type(error).__name__}: {error}")


def _unused_name(name: str, state: State) -> str:
    """The name, with a number where a photograph on the shelf has it already."""
    taken = {photograph.name for photograph in state.shelf}
    return name if name not in taken else next(each for n in count(2) if (each := f"{name} ({n})") not in taken)
