"""Films: keyframes set on the page become an mp4 in the run's folder.

A film's folder holds what `fprf render` takes: `path.json` (a camera path), `keys.json` (styles by frame) and the styles with
their photographs. The film is rendered from these very files, so the same command makes it again, at any size.
"""

import shutil
from collections.abc import Callable, Generator
from dataclasses import replace
from pathlib import Path
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
from .drawing import cameras_of
from .messages import Camera
from .restyler import Look, style_config

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
    # Keys with equal looks share a style, so that nothing is restyled between them.
    looks: dict[Look, Path] = {}
    rows: list[dict[str, object]] = []
    for i, key in enumerate(plan.keys):
        if not key.look.plain and key.look not in looks:
            path = folder / f"style-{len(looks) + 1}" / "style.json"
            path.parent.mkdir()
            # Copies of the photographs, for uploads go with the viewer; the style names them beside itself.
            references = []
            for k, (photograph, _) in enumerate(key.look.mix):
                stem = photograph.name.rsplit(".", 1)[0]
                plain = "".join(c if c.isascii() and (c.isalnum() or c in "-_") else "_" for c in stem)
                references.append(path.with_name(f"{k + 1}-{plain or 'photograph'}.png"))
                shutil.copyfile(photograph.path, references[-1])
            style_of_look = replace(style_config(key.look, stylizer), references=tuple(references))
            write_style(path, StyleFile(style_of_look, {}, encoder))
            looks[key.look] = path
        # A key without a look is the scene as captured.
        style = looks.get(key.look)
        rows.append({"frame": i * plan.gap, "style": None if style is None else str(style.relative_to(folder))})
    write_json(folder / "keys.json", {"format": 1, "keyframes": rows})


def film_frames(folder: Path, scene: Scene, frame: Frame) -> list[Generator[None, None, Picture]]:
    """The frames of a film's folder, each to be rendered step by step."""
    cameras, _ = read_camera_path(folder / "path.json", scene.origin)
    looks = keyed_looks(scene, read_keyframes(folder / "keys.json"))

    def rendered(number: int) -> Generator[None, None, Picture]:
        return (yield from frame(cameras, number, looks(number)))

    return [rendered(number) for number in range(len(cameras))]
