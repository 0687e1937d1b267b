"""The images of a scene: copied from a folder, or taken from a video where it is sharp, with what their EXIF
says of the lens.

The sharpness of an image is the variance of its Laplacian on grey levels in [0, 255]: blur takes the fine
edges first. It depends on what is shown, so frames are compared with their neighbours only.
"""

import hashlib
import math
import re
from collections.abc import Iterable, Sequence
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import PIL.Image
from PIL.ExifTags import IFD
from PIL.ExifTags import Base as Tag

from ..datamanagers.images import IMAGE_SUFFIXES, exif_of, load_image, open_image, read_header
from ..datamanagers.photograph_files import (
    COPIES,
    digest_of_pixels,
    find_photographs,
    original_first,
    shown_name,
)
from ..errors import DataError, UsageError
from ..io.atomic import write_bytes
from ..io.video_reader import VIDEO_SUFFIXES, Grey, read_video
from .config import SfmConfig
from .scene_folder import Progress, SceneFolder, State, step_key

_SHARPNESS_SIDE_PIXELS = 960
"""Longest side at which sharpness is measured: finer detail is mostly noise, and larger images take long."""
_WINDOWS_AROUND = 2
"""Windows on each side that a window's best frame is compared with. By eye."""
_FRAME_NAME = "frame_{:06d}.jpg"
"""File of a frame, by its number among those that can be decoded."""
_FRAME_QUALITY = 95
"""Quality of a frame as JPEG: what a phone saves photographs with."""
_MIN_IMAGES = 3
"""Images that a scene needs: COLMAP keeps no smaller models (`worker.py`)."""
_UNREAD_BY_COLMAP = frozenset({"WebP", "AVIF", "HEIC", "raw"})
"""Formats that COLMAP does not read, as it is packaged. It tells formats by their content, as we do."""
_MAX_EXIF_BYTES = (1 << 16) - 16
"""Bytes of an EXIF block that a JPEG takes: a segment has 16 bits of length, and its own head."""
_MAX_NAMED_FILES = 3
"""Files, or reasons, that a sentence names."""


def sharpness(grey: Grey) -> float:
    """Variance of the Laplacian of a grey image; 0 for an even one."""
    scale = _SHARPNESS_SIDE_PIXELS / max(grey.shape)
    if scale < 1:
        grey = np.asarray(
            cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), dtype=np.uint8
        )
    return float(cv2.Laplacian(grey, cv2.CV_64F).var())


def choose_frames(scores: Sequence[float], count: int, least: float) -> tuple[list[int], dict[int, str]]:
    """The sharpest frame of each of `count` windows of equal length, and the other frames with the reason.

    The first of equally sharp frames is taken.
    A window whose best frame has less than `least` times the median sharpness of the windows around it gives
    none: all of it is blurred, as in a quick turn. `least` lies in [0, 1). With `count` frames or fewer every
    frame is a window.
    """
    # Windows of equal length, but for rounding, and the sharpest frame of each.
    windows = min(count, len(scores))
    if windows:
        edges = []
        for k in range(windows + 1):
            edges.append(round(k * len(scores) / windows))
    else:
        edges = [0]
    best = [max(range(low, high), key=lambda i: (scores[i], -i)) for low, high in pairwise(edges)]
    dropped = {}
    for (low, high), top in zip(pairwise(edges), best, strict=True):
        for frame in range(low, high):
            if frame != top:
                dropped[frame] = f"less sharp than frame {top} ({scores[frame]:.0f} < {scores[top]:.0f})"
    # The best frames of the windows around say how sharp images are there.
    chosen = []
    for k, top in enumerate(best):
        around = []
        for j in range(max(0, k - _WINDOWS_AROUND), min(windows, k + _WINDOWS_AROUND + 1)):
            if j != k:
                around.append(scores[best[j]])
        usual = float(np.median(around)) if around else 0.0
        if scores[top] < least * usual:
            dropped[top] = (
                f"blurred, like all frames around it (sharpness {scores[top]:.0f}, usual there is {usual:.0f})"
            )
        else:
            chosen.append(top)
    return chosen, dict(sorted(dropped.items()))


def save_frames(
    video: Path, frames: Sequence[int], place: SceneFolder, state: State, progress: Progress
) -> list[str]:
    """Write some of the frames, at least one, as JPEG (95). Returns what was decided about the video."""
    wanted = set(frames)
    last = max(frames)
    done = 0
    log, found = read_video(video)
    for index, frame in enumerate(found):
        if index in wanted:
            bgr = cv2.cvtColor(frame.picture(), cv2.COLOR_RGB2BGR)
            coded, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _FRAME_QUALITY])
            assert coded
            _write_image(place, state, _FRAME_NAME.format(index), data.tobytes())
            done += 1
            progress(done, len(wanted), "writing frames")
        if index == last:
            return log.notes
    raise DataError(
        f"{video}: frame {last} was there before and is not now; keep the video as it is while it is processed"
    )


class Lens(NamedTuple):
    """Two photographs of equal size and equal lens are taken with one camera."""

    model: str = ""
    focal: float = 0.0
    """Millimetres; 0 where the file does not say."""
    focal_35: int = 0
    """Focal length on 35 mm film of the same angle."""


def read_lens(path: Path) -> Lens:
    """The lens of a photograph by its EXIF block; an empty one where that says nothing, or nothing that can
    be understood.
    """
    exif = _exif(path)
    try:
        inner = exif.get_ifd(IFD.Exif)
        focal = float(inner.get(Tag.FocalLength, 0))
        focal_35 = float(inner.get(Tag.FocalLengthIn35mmFilm, 0))
        model = str(exif.get(Tag.Model, "")).split("\0")[0].strip()
    except Exception:  # values of other types, and whatever Pillow raises over a damaged block
        return Lens()
    return Lens(
        model, focal if 0 < focal < math.inf else 0.0, int(focal_35) if 0 < focal_35 < math.inf else 0
    )


def read_encoder(path: Path) -> str:
    """A hash of how a JPEG was encoded: quantisation tables, sampling of colours, progressive or not. Empty for
    other images.

    Phones and messengers have their own; photographs of one phone share them, or nearly.
    """
    try:
        with path.open("rb") as file:
            image = open_image(file, path)[1]
            tables = sorted(getattr(image, "quantization", {}).items())
            sampling = []
            for layer in getattr(image, "layer", []):
                sampling.append(layer[1:3])
            progressive = bool(image.info.get("progressive"))
    except Exception:  # whatever is wrong with it, it is not needed
        return ""
    if tables:
        return step_key(tables, sampling, progressive)
    return ""


def _exif(path: Path) -> PIL.Image.Exif:
    """The EXIF block of an image file; an empty one where there is none, it cannot be understood, or the file
    is none.
    """
    try:
        with path.open("rb") as file:
            return exif_of(file, path)
    except Exception:  # whatever is wrong with it, it is not needed
        return PIL.Image.Exif()


def gather_images(
    source: Path, place: SceneFolder, state: State, config: SfmConfig, progress: Progress
) -> None:
    """Bring images into the folder, and describe them and what was dropped in `state`.

    Raises UsageError for a source that is neither a folder of images nor a video, or not the one that the
    folder was begun with; DataError for too few images.
    """
    here = str(source.resolve())
    if state.source not in ("", here):
        raise UsageError(
            f"--output {place.root}: was begun with {state.source}; go on with that, or name another folder"
        )
    if source.resolve() == place.root.resolve():
        raise UsageError(
            f"{source}: is the scene folder itself; give {place.images}, or name another --output"
        )
    if source.is_dir():
        state.notes.pop("frames", None)
        gathered = _from_folder(source, place, state, progress)
    elif source.is_file() and source.suffix.lower() in VIDEO_SUFFIXES:
        gathered = _from_video(source, place, state, config, progress)
    else:
        kinds = " ".join(sorted(VIDEO_SUFFIXES))
        raise UsageError(f"{source}: neither a folder of images nor a video ({kinds}); check the path")
    if len(gathered) < _MIN_IMAGES:
        state.images = gathered
        why = lost_files(state) or "; ".join(state.notes.get("frames", [])) or "the video holds no more"
        if source.is_dir() and not state.dropped:
            endings = sorted(
                {path.suffix.lower() for path in source.rglob("*") if path.is_file() and path.suffix}
            )
            if endings:
                there = f"it holds {' '.join(endings)} files"
            else:
                there = "it holds no files"
            left_out = "".join(f"{note}; " for note in state.notes.get("left out", []))
            why = f"{left_out}{there}, and what is read is {' '.join(sorted(IMAGE_SUFFIXES))}: convert the images to JPEG"
        raise DataError(f"{source}: {why}; {len(gathered)} usable images, at least {_MIN_IMAGES} are needed")
    # Images that are no longer used go, but never from the source itself.
    for name in set(state.images) - set(gathered):
        if place.images.resolve() != source.resolve():
            (place.images / name).unlink(missing_ok=True)
    state.source = here
    state.images = {name: gathered[name] for name in natural_order(gathered)}
    state.save(place)


def lost_files(state: State) -> str:
    """The files of a folder that could not be decoded, in one clause; empty where all could be, and of a
    video.
    """
    if not state.dropped or "frames" in state.done:
        return ""
    # Files with the same reason are named together.
    alike: dict[str, list[str]] = {}
    for name, reason in state.dropped.items():
        alike.setdefault(reason, []).append(name)
    told = []
    for reason, names in alike.items():
        told.append(f"{_some(names)} ({reason})")
    total = len(state.dropped) + len(state.images)
    return f"{len(state.dropped)} of {total} files could not be decoded: {_some(told)}"


def _some(words: list[str]) -> str:
    """The first ones of a list, and how many there are beside."""
    if len(words) > _MAX_NAMED_FILES:
        beside = [f"{len(words) - _MAX_NAMED_FILES} more"]
    else:
        beside = []
    return ", ".join(words[:_MAX_NAMED_FILES] + beside)


def natural_order(names: Iterable[str]) -> list[str]:
    """Names as people number them: 2 before 10, and numbers before words."""

    def rank(name: str) -> list[tuple[bool, int, str]]:
        numbers = []
        for part in re.findall(r"[0-9]+|[^0-9]+", name):
            numbers.append(("0" <= part[0] <= "9", part))
        found: list[tuple[bool, int, str]] = []
        for number, part in numbers:
            found.append((not number, int(part) if number else 0, part))
        return found

    return sorted(names, key=rank)


def _from_folder(
    source: Path, place: SceneFolder, state: State, progress: Progress
) -> dict[str, dict[str, Any]]:
    """Every image below the folder that can be decoded, under its relative name without blanks and a leading
    #.

    Formats that COLMAP does not read become JPEGs, whatever the name says: IMG_1.heic is IMG_1.heic.jpg in
    the scene. All others are copied: COLMAP and `load_image` see the same pixels in them.
    """
    # Images may lie in the scene already. A scene inside of the source is left out.
    inplace = place.images.resolve() == source.resolve()
    scene = place.root.resolve()
    inner = None
    if source.resolve() in scene.parents:
        inner = source / scene.relative_to(source.resolve())
    found = find_photographs(source, without=inner)
    files = original_first(found.files)
    entries: dict[str, dict[str, Any]] = {}
    # Names of the pictures so far, by the hashes of their files and of their pixels.
    pictures: dict[str, str] = {}
    copies: list[str] = []
    state.dropped = {}
    for i, path in enumerate(files):
        progress(i, len(files), "reading images")
        given = path.relative_to(source).as_posix()
        name = re.sub(
            r"\s|^#", "_", given
        )  # in COLMAP's lists of pairs a blank ends a name, and # begins a comment
        data = path.read_bytes()
        digest = hashlib.sha256(data).hexdigest()
        shown = shown_name(path.relative_to(source))
        if digest in pictures and shown == given:
            copies.append(f"{given}, which is {pictures[digest]}")
            continue
        if name in entries or (inplace and name != given):
            raise UsageError(
                f"{path}: COLMAP takes no blanks or leading # in names; rename it so that none else is {name}"
            )
        # What was gathered before, and has not changed, is not read again.
        try:
            if shown != given:
                raise DataError("its name is not UTF-8: rename it")
            kind = read_header(path).kind
            foreign = kind in _UNREAD_BY_COLMAP
            name = f"{name}.jpg" if foreign else name
            known = state.images.get(name, {})
            fresh = known.get("sha256") != digest or not (place.images / name).is_file()
            if foreign and inplace:
                raise DataError(
                    f"{path}: COLMAP reads no {kind}: name another --output, where JPEGs are made"
                )
            if fresh and foreign:
                _write_image(place, state, name, _jpeg(path))
            if fresh:
                known = _described(place.images / name if foreign else path, digest)
            pixels = known.get("pixels", digest)  # which scenes of before do not tell
            if pixels in pictures:
                copies.append(f"{given}, which is {pictures[pixels]}")
                if fresh and foreign:
                    (place.images / name).unlink()
                continue
            if fresh and not (inplace or foreign):
                _write_image(place, state, name, data)
            pictures |= {digest: given, pixels: given}
        except DataError as fault:
            state.dropped[shown] = str(fault).removeprefix(f"{path}: ").partition(";")[0]
            continue
        entries[name] = known
    progress(len(files), len(files), "reading images")
    order = []
    for path in found.files:
        order.append(shown_name(path.relative_to(source)))
    state.dropped = {name: state.dropped[name] for name in order if name in state.dropped}
    if copies:
        found.left_out[COPIES] = copies
    state.notes["left out"] = found.notes()
    return entries


def _from_video(
    source: Path, place: SceneFolder, state: State, config: SfmConfig, progress: Progress
) -> dict[str, dict[str, Any]]:
    """Sharp frames, evenly over time. Raises DataError where the file holds no frames."""
    # A video is told by its size and time: hashing gigabytes takes longer than is worth it.
    about = source.stat()
    key = step_key("frames", about.st_size, about.st_mtime_ns, config.frames, config.blurred)
    if state.done.get("frames") == key and all((place.images / name).is_file() for name in state.images):
        return state.images
    # How sharp every frame is, before any is chosen: blur is told by the frames around.
    scores: list[float] = []
    log, found = read_video(source)
    for frame in found:
        progress(len(scores), max(log.expected, len(scores) + 1), "looking for sharp frames")
        scores.append(sharpness(frame.grey()))
    if not scores:
        raise DataError(
            f"{source}: no frame can be decoded; convert it to H.264 in an .mp4, or give a folder of images"
        )
    progress(len(scores), len(scores), "looking for sharp frames")
    chosen, dropped = choose_frames(scores, config.frames, config.blurred)
    decided = save_frames(source, chosen, place, state, progress)
    state.notes["frames"] = [log.sentence(), *dict.fromkeys([*log.notes, *decided])]
    state.dropped = {f"frame {frame}": reason for frame, reason in dropped.items()}
    state.done["frames"] = key
    frames = {}
    for number in chosen:
        path = place.images / _FRAME_NAME.format(number)
        frames[path.name] = _described(path, hashlib.sha256(path.read_bytes()).hexdigest())
    return frames


def _write_image(place: SceneFolder, state: State, name: str, data: bytes) -> None:
    """Write an image, whole or not at all. Raises UsageError where another picture lies that no earlier run
    has brought.
    """
    path = place.images / name
    there = path.read_bytes() if path.is_file() else None  # a run that was cut off left the same bytes
    if there is not None and there != data and name not in state.images:
        raise UsageError(
            f"--output {place.root}: images/{name} is another picture; name a folder that is new or empty"
        )
    if there != data:
        write_bytes(path, data)


def _jpeg(path: Path) -> bytes:
    """The image as JPEG, upright, with what the file says of its camera. Raises DataError where it cannot be
    decoded.
    """
    # The pixels are turned here, so that nothing may turn them again.
    pixels = load_image(path, upright=True)
    exif = _exif(path)
    data = BytesIO()
    exif.pop(Tag.Orientation, None)
    try:
        block = exif.tobytes()
    except Exception:  # values that Pillow read and cannot write
        block = b""
    block = block if len(block) < _MAX_EXIF_BYTES else b""
    PIL.Image.fromarray(pixels).save(data, "JPEG", quality=97, subsampling=0, exif=block)
    return data.getvalue()


def _described(path: Path, digest: str) -> dict[str, Any]:
    """Size, pixels and lens of an image. Raises DataError where it cannot be decoded."""
    image = load_image(path)
    height, width = image.shape[:2]
    return {
        "sha256": digest,
        "pixels": digest_of_pixels(image),
        "width": width,
        "height": height,
        "lens": list(read_lens(path)),
        "encoder": read_encoder(path),
    }
