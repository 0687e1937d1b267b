"""The images of a scene: copied from a folder, or taken from a video where it is sharp."""

import hashlib
import re
import shutil
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import cv2

from ..datamanagers.image_header import IMAGE_SUFFIXES
from ..datamanagers.images import load_image
from ..errors import DataError, UsageError
from ..io.atomic import atomic_path, write_bytes
from .config import SfmConfig
from .exif import heic_exif, read_lens
from .place import Place, State, key_of
from .sharpness import choose
from .video import VIDEO_SUFFIXES, frame_name, frame_scores, save_frames

__all__ = ["gather", "in_order"]

_FEWEST = 3
"""Images that a scene needs at least."""
_FOREIGN = frozenset({".heic", ".heif", ".hif", ".avif"})
"""Endings of formats that COLMAP does not read."""

Progress = Callable[[int, int, str], None]


def gather(source: Path, place: Place, state: State, config: SfmConfig, progress: Progress) -> None:
    """Bring images into the folder, and describe them and what was dropped in `state`.

    Raises UsageError for a source that is neither a folder of images nor a video, or not the one that the folder was
    begun with; DataError for too few images.
    """
    here = str(source.resolve())
    if state.source not in ("", here):
        raise UsageError(f"--output {place.root}: was begun with {state.source}; go on with that, or name another folder")
    if source.is_dir():
        found = _from_folder(source, place, state, progress)
    elif source.is_file() and source.suffix.lower() in VIDEO_SUFFIXES:
        found = _from_video(source, place, state, config, progress)
    else:
        kinds = " ".join(sorted(VIDEO_SUFFIXES))
        raise UsageError(f"{source}: neither a folder of images nor a video ({kinds}); check the path")
    if len(found) < _FEWEST:
        why = next((f"{name}: {reason}" for name, reason in state.dropped.items()), _holds(source))
        raise DataError(f"{source}: {len(found)} usable images, at least {_FEWEST} are needed; {why}")
    for name in set(state.images) - set(found):
        if place.images.resolve() != source.resolve():
            (place.images / name).unlink(missing_ok=True)
    state.source, state.images = here, {name: found[name] for name in in_order(found)}
    state.save(place)


def in_order(names: Iterable[str]) -> list[str]:
    """Names as people number them: 2 before 10."""
    return sorted(names, key=lambda name: [_rank(part) for part in _PARTS.findall(name)])


_PARTS = re.compile(r"[0-9]+|[^0-9]+")


def _rank(part: str) -> tuple[bool, int, str]:
    """Numbers by their value, before words."""
    number = "0" <= part[0] <= "9"
    return not number, int(part) if number else 0, part


def _from_folder(source: Path, place: Place, state: State, progress: Progress) -> dict[str, dict[str, Any]]:
    """Every image below the folder that can be decoded, under its relative name without blanks.

    Formats that COLMAP does not read become JPEGs: IMG_1.heic is IMG_1.heic.jpg in the scene.
    """
    inplace = place.images.resolve() == source.resolve()
    files = sorted(path for path in source.rglob("*") if path.suffix.lower() in IMAGE_SUFFIXES and path.is_file())
    files = [path for path in files if not any(part.startswith(".") for part in path.relative_to(source).parts)]
    found: dict[str, dict[str, Any]] = {}
    state.dropped = {}
    for i, path in enumerate(files):
        progress(i, len(files), "reading images")
        given = path.relative_to(source).as_posix()
        name = re.sub(r"\s", "_", given)
        if name in found or (inplace and name != given):
            raise UsageError(f"{path}: COLMAP takes no blanks in names; rename the image, so that no other is called {name}")
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        foreign = path.suffix.lower() in _FOREIGN
        name = f"{name}.jpg" if foreign else name
        known = state.images.get(name, {})
        if known.get("sha256") != digest or not (place.images / name).is_file():
            try:
                if foreign and inplace:
                    raise DataError(f"{path}: COLMAP reads no {path.suffix} files: name another --output, where JPEGs are made")
                if foreign:
                    _write_jpeg(path, place.images / name)
                known = _described(place.images / name if foreign else path, digest)
            except DataError as fault:
                state.dropped[given] = str(fault).removeprefix(f"{path}: ").partition(";")[0]
                continue
            if not (inplace or foreign):
                with atomic_path(place.images / name) as temporary:
                    shutil.copyfile(path, temporary)
        found[name] = known
    progress(len(files), len(files), "reading images")
    return found


def _from_video(source: Path, place: Place, state: State, config: SfmConfig, progress: Progress) -> dict[str, dict[str, Any]]:
    """Sharp frames, evenly over time."""
    about = source.stat()
    key = key_of("frames", about.st_size, about.st_mtime_ns, config.frames, config.blurred)
    if state.done.get("frames") == key and all((place.images / name).is_file() for name in state.images):
        return state.images
    choice = choose(frame_scores(source, progress), config.frames, config.blurred)
    save_frames(source, choice.chosen, place.images, progress)
    state.dropped = {f"frame {frame}": reason for frame, reason in choice.dropped.items()}
    state.done["frames"] = key
    found = {}
    for frame in choice.chosen:
        path = place.images / frame_name(frame)
        found[path.name] = _described(path, hashlib.sha256(path.read_bytes()).hexdigest())
    return found


def _write_jpeg(path: Path, target: Path) -> None:
    """The image as JPEG, upright, with what the file says of its camera. Raises DataError where it cannot be decoded."""
    pixels = cv2.cvtColor(load_image(path, upright=True), cv2.COLOR_RGB2BGR)
    options = [cv2.IMWRITE_JPEG_QUALITY, 97, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    data, exif = cv2.imencode(".jpg", pixels, options)[1].tobytes(), heic_exif(path)
    if exif:
        data = data[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + data[2:]
    write_bytes(target, data)


def _holds(source: Path) -> str:
    """What a folder holds instead of images."""
    if not source.is_dir():
        return "the video holds no more"
    endings = sorted({path.suffix.lower() for path in source.rglob("*") if path.is_file() and path.suffix})
    there = f"it holds {' '.join(endings)} files" if endings else "it holds no files"
    return f"{there}, and what is read is {' '.join(sorted(IMAGE_SUFFIXES))}: convert the images to JPEG"


def _described(path: Path, digest: str) -> dict[str, Any]:
    """Size and lens of an image. Raises DataError where it cannot be decoded."""
    height, width = load_image(path).shape[:2]
    return {"sha256": digest, "width": width, "height": height, "lens": list(read_lens(path))}
