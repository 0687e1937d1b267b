"""The scene that is viewed: its state (`state.py`), its clients' requests, its photographs, films and
training.

Calls come from any thread. What touches the model runs on the render worker; clients learn of the results by
messages, of which a newer one of the same kind takes the place of one that was not sent yet. The run folder
is the only channel to a training: its newest checkpoint is shown, and as long as somebody looks the folder
says so (`training.driver.watch`), for which training saves more often.
"""

import secrets
import threading
from collections.abc import Callable, Hashable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from ..errors import FprfError, UsageError
from ..io.images import Picture, encode
from ..io.video import write_video
from ..scenes import Scene
from ..splats.files import Capture, write_capture, write_gaussians
from ..splats.scene import SplatScene
from ..style.config import StyleConfig
from ..training.driver import watch
from ..training.loading import LoadedRun
from . import messages
from .drawing import (
    FPS,
    Restyler,
    ScenePainter,
    cameras_of,
    film_frames,
    gaussian_colours,
    matching_regions,
    write_film_files,
)
from .pack import colour_header, colour_section, container
from .render_worker import RenderWorker, Steps
from .state import NOW, FilmProgress, Look, Photograph, SharedState, Shown
from .uploads import Uploads, newest_step, shown_name, training_progress
from .writer import about, packed_scene

if TYPE_CHECKING:
    from .server import ViewerServer

Post: TypeAlias = Callable[[Hashable | None, str, "Mapping[str, Any] | bytes"], None]
"""Sends a client, or all (None), a message under the name of its kind."""
_PREVIEW_JPEG_QUALITY = 72
"""Quality of a preview, which is soon replaced; by eye."""
_FINAL_JPEG_QUALITY = 90
"""Quality of the whole picture; by eye."""


@dataclass(frozen=True)
class Viewed:
    """A scene with what the page says of it."""

    scene: Scene
    name: str
    home: int
    """View at which clients begin."""
    root: Path | None = None
    """Folder for films: that of a run; None = there is none."""
    capture: Capture | None = None
    """The file of Gaussians that it was read from; None = it is a run."""
    style: StyleConfig = StyleConfig()
    """Style that looks start from."""
    step: int = 0
    """Step of the checkpoint that it was read from."""
    references: tuple[Path, ...] = ()
    """Photographs that are on the shelf at the beginning; several are mixed, and those that come later join
    them.
    """
    pixels: int = 640
    """Longest side of the sharpest picture."""


def view_of_run(opened: LoadedRun[Scene]) -> Viewed:
    """A run, beginning at the middle one of the views that training did not see."""
    views = opened.known.test or opened.known.train
    return Viewed(opened.scene, opened.known.name, views[len(views) // 2], opened.run.root, step=opened.step)


class Session:
    """Use as a context manager, which ends its threads and processes."""

    def __init__(self, viewed: Viewed, post: Post) -> None:
        self.viewed = viewed
        self._post = post
        self._key = secrets.token_hex(8)
        """Tells pages that a server's scene is another one, also after the server was started anew."""
        self.restyler = Restyler(viewed.scene)
        self.state = SharedState(look=Look(style=viewed.style), together=len(viewed.references) > 1)
        self.uploads = Uploads()
        self._lock = threading.RLock()
        self._requests: dict[Hashable, messages.ViewRequest] = {}
        self._photographs: frozenset[Photograph] = frozenset()
        self._painter: ScenePainter | None = None
        self._worker = RenderWorker(self._on_error)
        self._version = count(1)
        self._colours: dict[str, tuple[int, bytes]] = {}
        self._progress: dict[str, Any] | None = None
        self._load()

    def __enter__(self) -> "Session":
        self._worker.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._worker.close()  # a film that is being made is left unfinished
        self.uploads.close()

    def _load(self) -> None:
        """Prepare what browsers are sent of Gaussians, or the painter of any other scene."""
        scene = self.viewed.scene
        home = self.viewed.home
        if isinstance(scene, SplatScene):
            # Shapes and captured colours go to browsers once.
            self.packed, head, parts = packed_scene(scene, [scene.gaussians.harmonics], home, level=1)
            self.geometry = container(head, parts)
        else:
            self._painter = ScenePainter(scene, self.restyler, self._show, self.viewed.pixels)
            # A camera turns about a point as far away as most cameras are from their middle.
            place = scene.cameras.pose[:, :, 3]
            spread = float((place - place.median(dim=0).values).norm(dim=1).quantile(0.9)) or 1.0
            self.geometry = container(about(scene.cameras, home, lambda view: 1.5 * spread), {})

    def hello(self) -> list[tuple[str, dict[str, Any]]]:
        """What a new client has to know."""
        drawn_there = isinstance(self.viewed.scene, SplatScene)
        viewed = self.viewed
        scene = {
            "type": "scene",
            "key": self._key,
            "name": viewed.name,
            "gaussians": drawn_there,
            "step": viewed.step,
        }
        coloured = [*self._colours.items()]  # the worker goes on changing them
        ready = []
        for name, (version, _) in coloured:
            ready.append((f"colours {name}", _colours_message(name, version)))
        if self._progress is None:
            training = []
        else:
            training = [("training", self._progress)]
        return [("scene", scene), ("state", self.state.described()), *ready, *training]

    def handle(self, client: Hashable, message: messages.AnyMessage) -> None:
        """Do what a client asks for. Raises FprfError with what is wrong with it."""
        match message:
            case messages.ViewRequest():
                # Browsers draw Gaussians themselves; all else is drawn here.
                if self._painter is not None:
                    cameras_of([message.camera])  # refused where it is none
                    with self._lock:
                        self._requests[client] = message
                    self._worker.draw(client, self._painter.render(client, message, self.state.shown))
            case messages.Pick():
                # The place is a share of the canvas; its right and lower edges belong to the last pixels.
                cameras = cameras_of([message.camera], longest=1000)
                width, height = cameras.size[0].tolist()
                at = (min(message.x * width, width - 1e-3), min(message.y * height, height - 1e-3))
                self._worker.run("pick", lambda: self._select(self.restyler.region_at(cameras, at)))
            case messages.Film():
                self._record(message.seconds)
            case messages.Keep(action="keep") if isinstance(self.viewed.scene, SplatScene):
                # A look of Gaussians that is kept becomes a style of the page, with colours of its own.
                self.apply(lambda state: state.changed(message))
                name, look = self.state.kept[-1]
                self._worker.run(("kept", name), lambda: self._colour(name, Shown(look)))
            case _:
                if isinstance(message, messages.Key) and message.camera is not None:
                    cameras_of([message.camera])  # refused where it is none
                self.apply(lambda state: state.changed(message))

    def disconnect(self, client: Hashable) -> None:
        """Drop everything of a client."""
        with self._lock:
            self._requests.pop(client, None)
        self._worker.forget(client)
        if (painter := self._painter) is not None:
            self._worker.run(("forget", client), lambda: painter.forget(client))

    def notify(self, text: str, *, bad: bool = False) -> None:
        """Show a line of text to all clients."""
        self._post(None, f"said {next(self._version)}", {"type": "said", "text": text[:400], "bad": bad})

    def apply(self, change: Callable[[SharedState], SharedState]) -> None:
        """Replace the state for all clients. Raises what `change` raises."""
        # Clients change the state one after the other, each what the one before it left.
        with self._lock:
            before = self.state
            self.state = change(self.state)
            now = self.state
        if now.picked is not None and now.look != before.look:
            region = now.picked.region  # what it takes has changed
            self._worker.run("select", lambda: self._select(region))
        # What is seen is drawn again only where it is another; names and lists of the page cost a message
        # alone.
        if now.shown != before.shown:
            self._refresh()
        if now != before:
            self._post(None, "state", self.state.described())

    def upload(self, data: bytes, name: str) -> Photograph:
        """Decode and encode a photograph and restyle the scene with it. Raises DataError for what is none."""
        path = self.uploads.store(data)

        def add() -> Photograph:
            photograph = self.restyler.encode(path, self.state.unused_name(shown_name(name)))
            self.apply(lambda state: state.added(photograph))
            # Photographs that left the shelf and that no look needs go, with what was made of them: some 6 MB
            # each.
            used = self.state.in_use | frozenset(self.state.shelf)
            for gone in {*self._photographs, photograph} - used:
                gone.path.unlink(missing_ok=True)
            self._photographs = used
            self.restyler.retain(used)
            return photograph

        return self._worker.result(add)

    def warm_up(self) -> None:
        """Prepare what the first photograph needs while nobody waits: decoder, encoders, kernels, a style."""
        threading.Thread(target=self.uploads.start_decoder, name="fprf-warm-up", daemon=True).start()

        def work() -> Steps[None]:
            self.restyler.encoders  # noqa: B018  they are opened by asking for them
            yield
            # A gradient in the place of a photograph: all that a drop runs is loaded and compiled by it.
            path = self.uploads.folder / "warm-up.png"
            path.write_bytes(
                encode(np.linspace(0, 255, 96 * 128 * 3).reshape(96, 128, 3).astype(np.uint8), "png")
            )
            photograph = self.restyler.encode(path, "warm-up")
            yield
            styled = self.restyler.styled(Look(style=self.viewed.style).mixed([(photograph, 1.0)]))
            yield
            if styled is not None and isinstance(self.viewed.scene, SplatScene):
                self.packed.colours(self.viewed.scene.restyled(styled.restyle).shown.harmonics, rounds=1)
            self.restyler.retain(self._photographs)

        self._worker.run_when_idle(work())

    def reload(self, viewed: Viewed) -> None:
        """Show another state of the scene, from the next step of the worker on."""

        def job() -> None:
            self.viewed = viewed
            before = self.restyler.reload(viewed.scene)
            self._load()
            # Clients fetch shapes and colours anew: Gaussians of this state are others. What had colours is
            # coloured again.
            coloured = [*self._colours]
            self._colours.clear()
            for kind, message in self.hello():
                self._post(None, kind, message)
            # Regions are measured anew, in any order: what is pinned is found again among them.
            picked = self.state.picked
            if before is not None and (picked is not None or any(look.rules for look in self.state.looks)):
                regions = matching_regions(before, self.restyler.encoders.scene_style).tolist()
                self.apply(lambda state: state.renumbered(regions))
                if picked is not None:
                    self._select(regions[picked.region])
            for name, look in self.state.kept:
                if name in coloured:
                    self._worker.run(("kept", name), partial(self._colour, name, Shown(look)))
            if NOW in coloured or not self.state.look.plain:
                self._refresh()

        self._worker.run("reload", job)

    def trained(self, progress: Mapping[str, Any]) -> None:
        """Tell all clients how far the scene's training is."""
        self._progress = {"type": "training", **progress}
        self._post(None, "training", self._progress)

    def colours(self, name: str) -> bytes:
        """Colours of the present look or of a kept one, for a browser. Raises UsageError where there are
        none.
        """
        if (found := self._colours.get(name)) is None:
            raise UsageError(f"{name}: no such colours")
        return found[1]

    def gaussians(self) -> Path:
        """The Gaussians in the look of now, as a .ply file. Raises UsageError for a scene without any."""
        viewed = self.viewed
        scene = self.viewed.scene
        if not isinstance(scene, SplatScene):
            raise UsageError(f"{viewed.name}: no Gaussians; `fprf export` makes some of a field")

        def written() -> Path:
            # Under a name of its own: another page may still be reading the one before, which its open file
            # keeps.
            for before in self.uploads.folder.glob("restyled-*.ply"):
                before.unlink()
            path = self.uploads.folder / f"restyled-{next(self._version)}.ply"
            shown = scene.restyled(self.restyler.restyle(self.state.look)).shown
            # Of a capture all but the colours stays as it was in its file.
            if viewed.capture is None:
                write_gaussians(
                    path,
                    shown,
                    antialiased=scene.antialiased,
                    views=scene.views,
                    plain=True,
                    origin=scene.origin,
                )
            else:
                write_capture(path, viewed.capture, shown.harmonics)
            return path

        return self._worker.result(written)

    def _refresh(self) -> None:
        """Show all clients what is shown now."""
        with self._lock:
            for client, request in self._requests.items():
                assert self._painter is not None  # Gaussians are drawn by browsers, which request nothing
                self._worker.draw(client, self._painter.render(client, request, self.state.shown))
        if isinstance(self.viewed.scene, SplatScene):
            self._worker.run("colours", lambda: self._colour(NOW, self.state.shown))

    def _show(self, client: Hashable, kind: str, picture: Picture, final: bool) -> None:
        """A picture as one byte for its kind, and a JPEG."""
        import cv2

        if final:
            quality = _FINAL_JPEG_QUALITY
        else:
            quality = _PREVIEW_JPEG_QUALITY
        done, data = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
        assert done
        self._post(client, kind, (b"\1" if kind == "captured" else b"\0") + data.tobytes())

    def _colour(self, name: str, shown: Shown) -> None:
        """Make colours for browsers, of what is shown now or of a look that is kept."""
        scene = self.viewed.scene
        assert isinstance(scene, SplatScene)
        colours = gaussian_colours(scene, self.packed, self.restyler, shown)
        version = next(self._version)
        self._colours[name] = (
            version,
            container(colour_header(colours), {"rows": colour_section(colours, 1)}),
        )
        self._post(None, f"colours {name}", _colours_message(name, version))

    def _select(self, region: int | None) -> None:
        picked = None
        if region is not None:
            picked = self.restyler.region_info(self.state.look, region)
        self.apply(lambda state: replace(state, picked=picked))

    def _record(self, seconds: float) -> None:
        """Make a film in the scene's folder while no client waits for a picture, one at a time."""
        with self._lock:
            if self.state.film.total and self.state.film.path is None:
                raise UsageError("film: one is being made; wait for it")
            if self.viewed.root is None:
                raise UsageError("this scene has no folder to put a film in")
            films = self.viewed.root / "films"
            scene = self.viewed.scene
            folder = next(each for number in count(1) if not (each := films / f"{number:04d}").exists())
            write_film_files(folder, self.state.keys, seconds, scene)
            self.apply(lambda state: replace(state, film=FilmProgress(total=1)))
        path = folder / "film.mp4"

        def progress(film: FilmProgress) -> None:
            self.apply(lambda state: replace(state, film=film))

        def rendered(frames: list[Steps[Picture]]) -> Iterator[Picture]:
            for done, frame in enumerate(frames, 1):
                yield self._worker.result_when_idle(frame)
                progress(FilmProgress(done=done, total=len(frames)))

        def work() -> None:
            try:
                # Frames are rendered one at a time, as the encoder asks for them.
                frames = self._worker.result(lambda: film_frames(folder, scene))
                write_video(path, rendered(frames), FPS)
            except Exception as error:  # whatever it is, the next film can be made
                progress(FilmProgress())
                self.notify(f"film: {error}", bad=True)
                return
            progress(replace(self.state.film, path=path))
            self.notify(f"film: {path}")

        threading.Thread(target=work, name="fprf-film", daemon=True).start()

    def _on_error(self, error: Exception) -> None:
        expected = isinstance(error, FprfError)
        if expected:
            text = str(error)
        else:
            text = f"this should not have happened: {type(error).__name__}: {error}"
        self.notify(text, bad=True)


def _colours_message(name: str, version: int) -> dict[str, Any]:
    return {"type": "colours", "name": name, "version": version}


_POLL_SECONDS = 0.5
"""Seconds between looks at a run folder."""


class TrainingFollower:
    """Keeps the scene that a server shows at the newest checkpoint of a run.

    `load` opens the run, and `opened` is the session where it is open already; without, it is opened at the
    first checkpoint.
    """

    def __init__(
        self, server: "ViewerServer", root: Path, load: Callable[[], Viewed], opened: Session | None = None
    ) -> None:
        self._server = server
        self._root = root
        self._load = load
        self.session = opened
        self._shown = -1 if opened is None else opened.viewed.step

    def run(self, ended: threading.Event) -> None:
        """Follow until the event is set."""
        while not ended.wait(_POLL_SECONDS):
            try:
                self.tick()
            except (FprfError, OSError) as error:  # the page says so; the next checkpoint may be better
                self._server.notify(str(error))

    def tick(self) -> None:
        """Say that somebody looks, and show what is new."""
        if self._server.pages:
            watch(self._root)
        newest = newest_step(self._root)
        if newest <= self._shown:
            return
        self._shown = newest
        if self.session is None:
            self.session = self._server.open(self._load, warm=False)
        else:
            self.session.reload(self._load())
        if (progress := training_progress(self._root)) is not None:
            self.session.trained(progress)
