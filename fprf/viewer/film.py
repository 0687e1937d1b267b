"""A flight through the scene with looks along it: keys that are set on the page, and the film that is made of them.

A film's folder holds what `fprf render` takes: `path.json` (a camera path), `keys.json` (styles by frame) and the styles with
their photographs. The film is rendered from these very files, so the same command makes it again, at any size.
"""

import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from queue import Full, Queue
from typing import NamedTuple

import torch

from ..checks import between
from ..cli.keyframes import keyed_looks, read_keyframes
from ..errors import UsageError
from ..io.atomic import write_json
from ..io.images import Picture, to_uint8
from ..rendering.camera_path import read_camera_path, write_camera_path
from ..rendering.cameras import Cameras
from ..rendering.paths import interpolate
from ..style.files import StyleFile, write_style
from ..training.cached_view import view_parts
from ..training.loading import Trained
from .cameras import Eye, Stage
from .looks import Look, settled, style_of
from .renderer import CHUNK

__all__ = ["FilmPlan", "Key", "Thumbnail", "frames_of_film", "lay_film", "new_folder", "path_of", "taken"]

LONGEST = 600.0
"""Seconds of a film."""


@dataclass(frozen=True, eq=False)
class Thumbnail:
    """A picture that is compared by what it is, not by its pixels."""

    number: int
    """What the page calls it by."""
    picture: Picture


class Key(NamedTuple):
    """A place on the flight, and how the scene looks there."""

    eye: Eye
    look: Look
    thumbnail: Thumbnail | None = None
    """What was seen there."""


class FilmPlan(NamedTuple):
    """What a film is to be."""

    keys: tuple[Key, ...]
    seconds: float
    """Between keys."""
    fps: float
    size: tuple[int, int]
    """Width, height."""


def path_of(stage: Stage, plan: FilmPlan) -> Cameras:
    """The frames' cameras; a key alone is one frame. Raises UsageError for no keys or a film that is too long."""
    if not plan.keys:
        raise UsageError("film: no keys yet; fly somewhere and add one")
    between("fps", plan.fps, 1.0, 120.0)
    between("seconds", plan.seconds, 0.1, LONGEST)
    if plan.seconds * (len(plan.keys) - 1) > LONGEST:
        raise UsageError(f"film: {plan.seconds * (len(plan.keys) - 1):.0f} s; at most {LONGEST:.0f} s are filmed from the page")
    keys = stage.cameras([key.eye for key in plan.keys], plan.size)
    return interpolate(keys, torch.arange(len(plan.keys)), gap_of(plan) - 1)


def gap_of(plan: FilmPlan) -> int:
    """Frames from one key to the next."""
    return max(1, round(plan.seconds * plan.fps))


def new_folder(root: Path) -> Path:
    """A folder for the next film of a run, made now: RUN/films/0001 and so on."""
    number = 1
    while True:
        folder = root / "films" / f"{number:04d}"
        try:
            folder.mkdir(parents=True)
            return folder
        except FileExistsError:
            number += 1


def lay_film(folder: Path, stage: Stage, plan: FilmPlan, encoder: str) -> None:
    """Write path.json, keys.json, and a folder a look with style.json and its photographs. `encoder` is the identity of the
    scene's semantic encoder.
    """
    write_camera_path(folder / "path.json", path_of(stage, plan), plan.fps)
    looks: dict[Look, Path] = {}
    rows: list[dict[str, object]] = []
    for i, key in enumerate(plan.keys):
        if not settled(key.look).plain and key.look not in looks:
            looks[key.look] = _write_look(folder / f"style-{len(looks) + 1}", key.look, encoder)
        style = looks.get(key.look)
        rows.append({"frame": i * gap_of(plan), "style": None if style is None else str(style.relative_to(folder))})
    write_json(folder / "keys.json", {"format": 1, "keyframes": rows})


def frames_of_film(
    folder: Path, trained: Trained, out: "Queue[Picture | None]", told: Callable[[int, int], None]
) -> Iterator[None]:
    """Work for the desk: render the frames of a film's folder into a queue, at last None. `told(done, total)` of each."""
    try:
        cameras, _ = read_camera_path(folder / "path.json")
        looks = keyed_looks(trained, read_keyframes(folder / "keys.json"))
        config = replace(trained.config.render, chunk=min(CHUNK, trained.config.render.chunk))
        for frame in range(len(cameras)):
            look, rows = looks(frame), []
            for part in view_parts(trained.model, trained.known.facts, cameras, frame, config):
                rows.append(part.colour(trained.model.decoder, look))
                yield
            width, height = (int(v) for v in cameras.size[frame])
            picture = to_uint8(torch.cat(rows).view(height, width, 3))
            while not _put(out, picture):
                yield
            told(frame + 1, len(cameras))
    finally:
        while not _put(out, None):
            out.get()


def taken(frames: "Queue[Picture | None]") -> Iterator[Picture]:
    """The frames of a queue, up to None."""
    while (frame := frames.get()) is not None:
        yield frame


def _put(out: "Queue[Picture | None]", picture: Picture | None) -> bool:
    try:
        out.put(picture, timeout=0.05)
    except Full:
        return False
    return True


def _write_look(folder: Path, look: Look, encoder: str) -> Path:
    """The style file of a look, with that of what it goes towards beside it."""
    folder.mkdir(parents=True)
    look = settled(look)
    style = style_of(look)
    here = []
    for i, (card, _) in enumerate(look.mix):
        target = folder / f"{i + 1}-{_stem(card.name)}.png"
        shutil.copyfile(card.path, target)
        here.append(target)
    other = None
    if look.towards is not None:
        other = _write_look(folder / "towards", look.towards, encoder)
    style = replace(style, references=tuple(here), between=other, at=look.at if other is not None else 0.5)
    path = folder / "style.json"
    write_style(path, StyleFile(style, {}, encoder))
    return path


def _stem(name: str) -> str:
    return "".join(c if c.isascii() and (c.isalnum() or c in "-_") else "_" for c in name.rsplit(".", 1)[0]) or "photograph"
