"""Films: keyframes set on the page become an mp4 in the run's folder, and are played on a client's page before that.

A film's folder holds what `fprf render` takes: `path.json` (a camera path), `keys.json` (styles by frame) and the styles with
their photographs. The film is rendered from these very files, so the same command makes it again, at any size.
"""

import shutil
import threading
import time
from collections.abc import Callable, Hashable, Iterator
from dataclasses import replace
from pathlib import Path
from queue import Full, Queue
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import torch

from ..checks import between
from ..errors import FprfError, UsageError
from ..interfaces import Scene
from ..io.atomic import write_json
from ..io.images import Picture
from ..io.video import write_video
from ..plugins.stylizers.config import RegionToneConfig
from ..rendering.camera_path import read_camera_path, write_camera_path
from ..rendering.cameras import Cameras
from ..rendering.paths import interpolate
from ..style.files import StyleFile, write_style
from ..style.keyframes import keyed_looks, read_keyframes
from ..types import Origin
from .cameras import CameraState, PageTransform
from .render_worker import RenderWorker, Steps
from .renderer import RenderRequest, SceneRenderer
from .state import FilmProgress, Key, Look, interpolate_looks, simplified, style_config

if TYPE_CHECKING:
    from .session import Session

Frames: TypeAlias = Queue[Picture | Exception | None]
_MAX_SECONDS = 600.0
PREVIEW_FPS = 8.0
"""Pictures a second of a flight that is played: as many as a processor makes."""
_PREVIEW_TIMEOUT = 1.0
"""Seconds for one of them."""


class FilmPlan(NamedTuple):
    """Keyframes and timing of a film."""

    keys: tuple[Key, ...]
    seconds: float
    """Between keys."""
    fps: float
    size: tuple[int, int]
    """Width, height."""

    @property
    def gap(self) -> int:
        """Frames from one key to the next."""
        return max(1, round(self.seconds * self.fps))


def film_cameras(transform: PageTransform, plan: FilmPlan) -> Cameras:
    """A camera each frame; a single key is one frame. Raises UsageError for no keys or a film that is too long."""
    if not plan.keys:
        raise UsageError("film: no keys yet; fly somewhere and add one")
    between("fps", plan.fps, 1.0, 120.0)
    between("seconds", plan.seconds, 0.1, _MAX_SECONDS)
    seconds = plan.seconds * (len(plan.keys) - 1)
    if seconds > _MAX_SECONDS:
        raise UsageError(f"film: {seconds:.0f} s; at most {_MAX_SECONDS:.0f} s are filmed from the page")
    keys = transform.cameras([key.camera for key in plan.keys], plan.size)
    return interpolate(keys, torch.arange(len(plan.keys)), plan.gap - 1)


def new_folder(root: Path) -> Path:
    """Make a folder for the next film of a run: RUN/films/0001 and so on."""
    number = 1
    while True:
        folder = root / "films" / f"{number:04d}"
        try:
            folder.mkdir(parents=True)
            return folder
        except FileExistsError:
            number += 1


def write_film_files(
    folder: Path,
    transform: PageTransform,
    plan: FilmPlan,
    encoder: str,
    stylizer: RegionToneConfig | None = None,
    origin: Origin = (0.0, 0.0, 0.0),
) -> None:
    """Write path.json, keys.json, and a folder a look with style.json and its photographs.

    `encoder` is the identity of the scene's semantic encoder, `stylizer` what its looks are based on; None = the default.
    The path is in the capture's coordinates; `origin` is that of the scene.
    """
    write_camera_path(folder / "path.json", film_cameras(transform, plan), plan.fps, origin)
    looks: dict[Look, Path] = {}
    rows: list[dict[str, object]] = []
    for i, key in enumerate(plan.keys):
        if not simplified(key.look).plain and key.look not in looks:
            looks[key.look] = _write_look(folder / f"style-{len(looks) + 1}", key.look, encoder, stylizer)
        style = looks.get(key.look)
        rows.append({"frame": i * plan.gap, "style": None if style is None else str(style.relative_to(folder))})
    write_json(folder / "keys.json", {"format": 1, "keyframes": rows})


def film_frames(
    folder: Path,
    scene: Scene,
    renderer: SceneRenderer,
    out: Frames,
    progress: Callable[[int, int], None],
    abandoned: Callable[[], bool] = lambda: False,
) -> Steps:
    """Render the frames of a film's folder into a queue, step by step; `progress(done, total)` of each.

    At last comes None, or the error that it ends with. Ends early once nobody takes frames any more (`abandoned`).
    """
    end: Exception | None = None
    try:
        cameras, _ = read_camera_path(folder / "path.json", scene.origin)
        looks = keyed_looks(scene, read_keyframes(folder / "keys.json"))
        for frame in range(len(cameras)):
            picture = yield from renderer.frame(cameras, frame, looks(frame))
            while not _put(out, picture):
                if abandoned():
                    return
                yield
            progress(frame + 1, len(cameras))
    except Exception as error:
        end = error
        raise
    finally:
        while not _put(out, end):
            out.get()


def queued_frames(frames: Frames) -> Iterator[Picture]:
    """The frames of a queue, up to None. Raises the error in their place."""
    while (frame := frames.get()) is not None:
        if isinstance(frame, Exception):
            raise frame
        yield frame


class FilmRecorder:
    """Makes and plays the films of one session."""

    def __init__(self, session: "Session", worker: RenderWorker[RenderRequest]) -> None:
        self._session, self._worker = session, worker
        self._lock = threading.Lock()
        self._flights: dict[Hashable, threading.Event] = {}

    def record(self, plan: FilmPlan) -> None:
        """Make a film in the scene's folder while no client waits for a picture, one at a time."""
        session = self._session
        with self._lock:
            if session.state.film.busy:
                session.notify("film: one is being made; wait for it")
                return
            session.update(lambda state: replace(state, film=FilmProgress(0, 1)))
        threading.Thread(target=self._record, args=(plan,), name="fprf-film", daemon=True).start()

    def play(self, client: Hashable, plan: FilmPlan, move: Callable[[CameraState], None]) -> None:
        """Show a client the flight as the film will be, coarsely; a flight that is under way is ended.

        `move` moves its camera, whose own moves are ignored until the end.
        """
        self.stop(client)
        over = threading.Event()
        with self._lock:
            self._flights[client] = over
        threading.Thread(target=self._play, args=(client, plan, move, over), name="fprf-flight", daemon=True).start()

    def playing(self, client: Hashable) -> bool:
        """True while a flight is shown to a client."""
        return client in self._flights

    def stop(self, client: Hashable) -> None:
        """End a client's flight where it is."""
        with self._lock:
            over = self._flights.pop(client, None)
        if over is not None:
            over.set()

    def _play(self, client: Hashable, plan: FilmPlan, move: Callable[[CameraState], None], over: threading.Event) -> None:
        session = self._session
        try:
            path = film_cameras(session.transform, plan._replace(fps=PREVIEW_FPS))
            session.update(lambda state: replace(state, playing=True))
            last, start, frame = len(path) - 1, time.monotonic(), -1
            while frame < last and not over.is_set():
                frame = min(last, max(frame + 1, int((time.monotonic() - start) * PREVIEW_FPS)))
                camera = session.transform.camera_state(path, frame)
                before = session.picture(client)
                session.preview(client, camera, interpolate_looks(plan.keys, frame * (len(plan.keys) - 1) / max(1, last)))
                move(camera)
                # As fast as pictures come: where a newer camera replaced each older one, none would be seen.
                until = time.monotonic() + _PREVIEW_TIMEOUT
                while not over.wait(1 / PREVIEW_FPS) and session.picture(client) is before and time.monotonic() < until:
                    if session.in_browser:
                        break
        except FprfError as error:
            session.notify(str(error))
        finally:
            with self._lock:
                if self._flights.get(client) is over:
                    del self._flights[client]
                flying = bool(self._flights)
            session.refresh(client)
            session.update(lambda state: replace(state, playing=flying))

    def _record(self, plan: FilmPlan) -> None:
        session = self._session

        def progress(done: int, total: int) -> None:
            session.update(lambda state: replace(state, film=FilmProgress(done, total)))

        abandoned = threading.Event()
        try:
            if session.viewed.root is None:
                raise UsageError("this scene has no folder to put a film in")
            folder = new_folder(session.viewed.root)
            scene = session.viewed.scene
            write_film_files(folder, session.transform, plan, scene.semantic_encoder, session.viewed.stylizer, scene.origin)
            frames: Frames = Queue(2)
            rendered = film_frames(folder, session.viewed.scene, session.renderer, frames, progress, abandoned.is_set)
            self._worker.run_when_idle(rendered)
            write_video(folder / "film.mp4", queued_frames(frames), plan.fps)
        except Exception as error:  # whatever it is, the next film can be made
            abandoned.set()
            session.update(lambda state: replace(state, film=FilmProgress()))
            session.notify(f"film: {error}")
            return
        session.update(lambda state: replace(state, film=replace(state.film, path=folder / "film.mp4")))
        session.notify(f"film: {folder / 'film.mp4'}")


def _put(out: Frames, item: Picture | Exception | None) -> bool:
    try:
        out.put(item, timeout=0.05)
    except Full:
        return False
    return True


def _write_look(folder: Path, look: Look, encoder: str, stylizer: RegionToneConfig | None) -> Path:
    """Write the style file of a look, with that of what it goes towards in a folder of its own."""
    folder.mkdir(parents=True)
    look = simplified(look)
    style = style_config(look, stylizer)
    references = []
    for i, (photograph, _) in enumerate(look.mix):
        target = folder / f"{i + 1}-{_stem(photograph.name)}.png"
        shutil.copyfile(photograph.path, target)
        references.append(target)
    other = None
    if look.towards is not None:
        other = _write_look(folder / "towards", look.towards, encoder, stylizer)
    style = replace(style, references=tuple(references), between=other, at=look.at if other is not None else 0.5)
    path = folder / "style.json"
    write_style(path, StyleFile(style, {}, encoder))
    return path


def _stem(name: str) -> str:
    return "".join(c if c.isascii() and (c.isalnum() or c in "-_") else "_" for c in name.rsplit(".", 1)[0]) or "photograph"
