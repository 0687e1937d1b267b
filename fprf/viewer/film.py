"""Films: keyframes set on the page become an mp4 in the run's folder.

A film's folder holds what `fprf render` takes: `path.json` (a camera path), `keys.json` (styles by frame) and the styles with
their photographs. The film is rendered from these very files, so the same command makes it again, at any size.
"""

import shutil
from collections.abc import Callable, Generator, Iterator
from dataclasses import replace
from pathlib import Path
from queue import Full, Queue
from typing import NamedTuple, TypeAlias

import torch

from ..checks import between
from ..errors import UsageError
from ..interfaces import Scene
from ..io.atomic import write_json
from ..io.images import Picture
from ..plugins.stylizers.config import RegionToneConfig
from ..rendering.camera_path import read_camera_path, write_camera_path
from ..rendering.cameras import Cameras
from ..rendering.paths import interpolate
from ..style.files import StyleFile, read_keyframes, write_style
from ..style.look import Restyle
from ..style.restyle import keyed_looks
from ..types import Origin
from .look import Look, style_config
from .messages import Camera, cameras_of
from .render_worker import Steps

Frames: TypeAlias = Queue[Picture | Exception | None]
Frame: TypeAlias = Callable[[Cameras, int, Restyle | None], Generator[None, None, Picture]]
"""Renders one frame, step by step."""
_MAX_SECONDS = 600.0


class Key(NamedTuple):
    """A keyframe of a film."""

    camera: Camera
    look: Look


class FilmPlan(NamedTuple):
    """Keyframes and timing of a film."""

    keys: tuple[Key, ...]
    seconds: float
    """Between keys."""
    fps: float
    side: int
    """Longest side, in pixels."""

    @property
    def gap(self) -> int:
        """Frames from one key to the next."""
        return max(1, round(self.seconds * self.fps))

    @property
    def size(self) -> tuple[int, int]:
        """Even width and height, in the shape of the first key's canvas."""
        width, height = self.keys[0].camera.size
        by = self.side / max(width, height) / 2
        return max(2, 2 * round(width * by)), max(2, 2 * round(height * by))


def film_cameras(plan: FilmPlan) -> Cameras:
    """A camera each frame; a single key is one frame. Raises UsageError for no keys or a film that is too long."""
    if not plan.keys:
        raise UsageError("film: no keys yet; go somewhere and add one")
    between("fps", plan.fps, 1.0, 120.0)
    between("seconds", plan.seconds, 0.1, _MAX_SECONDS)
    seconds = plan.seconds * (len(plan.keys) - 1)
    if seconds > _MAX_SECONDS:
        raise UsageError(f"film: {seconds:.0f} s; at most {_MAX_SECONDS:.0f} s are filmed from the page")
    keys = cameras_of([key.camera for key in plan.keys], plan.size)
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
    plan: FilmPlan,
    encoder: str,
    stylizer: RegionToneConfig | None = None,
    origin: Origin = (0.0, 0.0, 0.0),
) -> None:
    """Write path.json, keys.json, and a folder a look with style.json and its photographs.

    `encoder` is the identity of the scene's semantic encoder, `stylizer` what its looks are based on; None = the default.
    The path is in the capture's coordinates; `origin` is that of the scene.
    """
    write_camera_path(folder / "path.json", film_cameras(plan), plan.fps, origin)
    looks: dict[Look, Path] = {}
    rows: list[dict[str, object]] = []
    for i, key in enumerate(plan.keys):
        if not key.look.plain and key.look not in looks:
            looks[key.look] = _write_look(folder / f"style-{len(looks) + 1}", key.look, encoder, stylizer)
        style = looks.get(key.look)
        rows.append({"frame": i * plan.gap, "style": None if style is None else str(style.relative_to(folder))})
    write_json(folder / "keys.json", {"format": 1, "keyframes": rows})


def film_frames(
    folder: Path,
    scene: Scene,
    frame: Frame,
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
        for number in range(len(cameras)):
            picture = yield from frame(cameras, number, looks(number))
            while not _put(out, picture):
                if abandoned():
                    return
                yield
            progress(number + 1, len(cameras))
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


def _put(out: Frames, item: Picture | Exception | None) -> bool:
    try:
        out.put(item, timeout=0.05)
    except Full:
        return False
    return True


def _write_look(folder: Path, look: Look, encoder: str, stylizer: RegionToneConfig | None) -> Path:
    """Write the style file of a look, with copies of its photographs beside it."""
    folder.mkdir(parents=True)
    references = []
    for i, (photograph, _) in enumerate(look.mix):
        stem = "".join(c if c.isascii() and (c.isalnum() or c in "-_") else "_" for c in photograph.name.rsplit(".", 1)[0])
        references.append(folder / f"{i + 1}-{stem or 'photograph'}.png")
        shutil.copyfile(photograph.path, references[-1])
    style = replace(style_config(look, stylizer), references=tuple(references))
    path = folder / "style.json"
    write_style(path, StyleFile(style, {}, encoder))
    return path
