"""Films: keyframes that were set on the page become an mp4 in the run's folder.

A film's folder holds what `fprf render` takes: `path.json` (a camera path), `keys.json` (styles by frame) and
the styles with their photographs. The film is rendered from these very files, so the same command makes it
again, at any size.
"""

import threading
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Protocol

import torch

from ..errors import UsageError
from ..io.atomic import write_json
from ..io.images import Picture, to_uint8
from ..io.video import write_video
from ..rendering.cameras import Cameras
from ..rendering.paths import interpolate, read_camera_path, write_camera_path
from ..scenes import Scene
from ..splats.scene import SplatScene
from ..style.files import StyleFile, read_keyframes
from ..style.restyle import keyed_looks
from .downloads import write_style_of
from .drawing import cameras_of, strips_of
from .looks import Look
from .messages import Film
from .render_worker import RenderWorker, Steps
from .state import FilmProgress, PageKeyframe

_MAX_FILM_SECONDS = 600.0
"""Length of a film that is made from the page, at most: `fprf render` makes longer ones."""


class Notify(Protocol):
    """Shows a line of text to all clients, as `Session.notify`."""

    def __call__(self, text: str, *, bad: bool = False) -> None: ...


def film_gap(film: Film) -> int:
    """Frames from one key to the next."""
    return max(1, round(film.seconds * film.fps))


def film_cameras(keys: Sequence[PageKeyframe], film: Film) -> Cameras:
    """A camera each frame, of even sizes in the shape of the first key's canvas; a single key is one frame.

    Raises UsageError for no keys or a film that is too long.
    """
    if not keys:
        raise UsageError("film: no keys yet; go somewhere and add one")
    length = film.seconds * (len(keys) - 1)
    if length > _MAX_FILM_SECONDS:
        raise UsageError(f"film: {length:.0f} s; at most {_MAX_FILM_SECONDS:.0f} s are filmed from the page")
    width, height = keys[0].camera.size
    by = film.side / max(width, height) / 2
    size = (max(2, 2 * round(width * by)), max(2, 2 * round(height * by)))
    cameras = cameras_of([key.camera for key in keys], size)
    return interpolate(cameras, torch.arange(len(keys)), film_gap(film) - 1)


def write_film_files(folder: Path, keys: Sequence[PageKeyframe], film: Film, scene: Scene) -> None:
    """Write path.json, keys.json, and a folder a look with style.json and its photographs; the folder is
    made.

    The path is in the capture's coordinates.
    """
    cameras = film_cameras(keys, film)  # refused before there is a folder
    folder.mkdir(parents=True, exist_ok=True)
    write_camera_path(folder / "path.json", cameras, film.fps, scene.origin)
    # Keys with equal looks share a style, so that nothing is restyled between them.
    looks: dict[Look, Path] = {}
    rows: list[dict[str, object]] = []
    for i, key in enumerate(keys):
        if not key.look.plain and key.look not in looks:
            path = folder / f"style-{len(looks) + 1}" / "style.json"
            write_style_of(path, key.look, StyleFile(key.look.config(), {}, scene.semantic_encoder))
            looks[key.look] = path
        # A key without a look is the scene as captured.
        style = looks.get(key.look)
        rows.append(
            {
                "frame": i * film_gap(film),
                "style": None if style is None else str(style.relative_to(folder)),
            }
        )
    write_json(folder / "keys.json", {"format": 1, "keyframes": rows})


def film_frames(folder: Path, scene: Scene) -> list[Steps[Picture]]:
    """The frames of a film's folder, each to be rendered step by step."""
    cameras, _ = read_camera_path(folder / "path.json", scene.origin)
    looks = keyed_looks(scene, read_keyframes(folder / "keys.json"))
    restyled = lru_cache(maxsize=1)(scene.restyled)  # while a look is held Gaussians are recoloured once

    def rendered(number: int) -> Steps[Picture]:
        look = looks(number)
        yield
        if isinstance(scene, SplatScene):
            return to_uint8(restyled(look).render(cameras, number).rgb)
        # A scene that is rendered here may take its time: after each strip a client may come first.
        rows = []
        for strip in strips_of(scene, cameras.select(torch.tensor([number]))):
            rows.append(strip.restyled(look).rgb)
            yield
        return to_uint8(torch.cat(rows))

    return [rendered(number) for number in range(len(cameras))]


def start_film(
    folder: Path,
    scene: Scene,
    fps: float,
    worker: RenderWorker,
    progress: Callable[[FilmProgress], None],
    notify: Notify,
) -> None:
    """Make film.mp4 of a film's folder in a thread of its own, while no client waits for a picture; `progress`
    and `notify` hear of it.
    """
    path = folder / "film.mp4"

    def rendered(frames: list[Steps[Picture]]) -> Iterator[Picture]:
        for done, frame in enumerate(frames, 1):
            yield worker.result_when_idle(frame)
            progress(FilmProgress(done=done, total=len(frames)))

    def work() -> None:
        try:
            # Frames are rendered one at a time, as the encoder asks for them.
            frames = worker.result(lambda: film_frames(folder, scene))
            write_video(path, rendered(frames), fps)
        except Exception as error:  # whatever it is, the next film can be made
            progress(FilmProgress())
            notify(f"film: {error}", bad=True)
            return
        progress(FilmProgress(done=len(frames), total=len(frames), path=path))
        notify(f"film: {path}")

    threading.Thread(target=work, name="fprf-film", daemon=True).start()
