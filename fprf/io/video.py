"""Frames to a film or to numbered pictures, one frame in memory at a time; to an animated picture, all of
them.
"""

import importlib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from fractions import Fraction
from io import BytesIO
from itertools import chain, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import cv2
import numpy as np
import PIL.Image

from ..errors import DataError, UsageError
from .atomic import atomic_path, unwritable, write_bytes, write_json
from .images import Picture, checked
from .strict_json import parse_json

if TYPE_CHECKING:
    from types import ModuleType


Codec = Literal["h264", "mp4v", "gif", "webp", "apng"]
_ANIMATED_FORMATS: dict[str, tuple[Codec, str, list[int]]] = {
    ".gif": ("gif", ".gif", [cv2.IMWRITE_GIF_QUALITY, 8, cv2.IMWRITE_GIF_DITHER, 1]),
    ".webp": ("webp", ".webp", []),
    ".apng": ("apng", ".png", []),
}
"""Animated pictures by ending: their format, the ending that OpenCV knows it by, and its options."""
_WEBP_QUALITY = 84
"""Of 100, as of single pictures (`fprf.io.images`)."""
FILMS = (".mp4", *_ANIMATED_FORMATS)
"""Endings of the films that can be written."""
_X264_OPTIONS = {"crf": "17", "preset": "medium"}
"""Quality of H.264: what the eye takes for the frames themselves."""
_MAX_RATE_DENOMINATOR = 1001
"""Denominator of a film's rate: that of 29.97 frames a second."""
MAX_FPS = 1000
"""Frames per second of a film, at most: animated pictures count whole milliseconds."""


def _alike(frames: Iterable[Picture], path: Path) -> Iterator[Picture]:
    """The frames, even-sized; DataError at the first whose size differs from that of the first of all."""
    shape: tuple[int, ...] | None = None
    for index, frame in enumerate(frames):
        if shape is None:
            shape = checked(frame).shape
        if frame.shape != shape:
            raise DataError(
                f"{path}: frame {index} is {frame.shape[1]}x{frame.shape[0]}, the first was {shape[1]}x{shape[0]}; "
                "render all views of a film at one size, or write a folder of pictures"
            )
        # 4:2:0 colour needs even sizes: the last row and column are repeated.
        bottom = frame.shape[0] % 2
        right = frame.shape[1] % 2
        if bottom or right:
            yield np.pad(checked(frame), ((0, bottom), (0, right), (0, 0)), mode="edge")
        else:
            yield checked(frame)


def _with_av(
    av: "ModuleType", path: Path, frames: Iterator[Picture], size: tuple[int, int], fps: Fraction
) -> None:
    """Write H.264 by PyAV."""
    with av.open(str(path.absolute()), "w", options={"movflags": "+faststart"}) as container:
        stream = container.add_stream("libx264", rate=fps, options=_X264_OPTIONS)
        stream.width, stream.height = size
        stream.pix_fmt = "yuv420p"
        # Players take untagged films of more than 576 lines for BT.709 and smaller ones for BT.601: say which
        # it is.
        context = stream.codec_context
        context.color_range = 1
        context.colorspace = 1
        context.color_primaries = 1
        context.color_trc = 1
        for frame in frames:
            picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")
            container.mux(stream.encode(picture.reformat(format="yuv420p", dst_colorspace="ITU709")))
        container.mux(stream.encode(None))


def write_video(path: Path, frames: Iterable[Picture], fps: float, *, h264: bool = True) -> Codec:
    """Write an .mp4, whole or not at all: H.264 where PyAV is installed (extra `video`), MPEG-4 part 2
    elsewhere.

    .gif (256 colours a frame, in steps of 10 ms), .webp and .apng (lossless) become animated pictures that
    start over. Odd sizes gain a repeated row or column. Returns the codec that was used; browsers play all
    but "mp4v". `h264=False` asks for the fallback. Raises UsageError for another ending, DataError for no
    frames or frames of several sizes.
    """
    if path.suffix.lower() not in FILMS:
        raise UsageError(
            f"{path}: films end in {' '.join(FILMS)}; give such a name, or a folder for single pictures"
        )
    if not 0 < fps <= MAX_FPS:
        raise UsageError(f"{path}: {fps} frames a second; must lie in (0, {MAX_FPS}]")
    rate = Fraction(fps).limit_denominator(_MAX_RATE_DENOMINATOR)
    even = _alike(frames, path)
    first = next(even, None)
    if first is None:
        raise DataError(f"{path}: no frames to write; the camera path is empty")
    size = (first.shape[1], first.shape[0])
    if path.suffix.lower() in _ANIMATED_FORMATS:
        return _animated(path, [first, *even], fps)
    # PyAV, unless it is absent or was built without x264, as some distributions do; else OpenCV.
    av = None
    if h264:
        with suppress(ImportError):
            av = importlib.import_module("av")
    with atomic_path(path) as temporary:
        if av is not None and "libx264" in av.codecs_available:
            _with_av(av, temporary, chain([first], even), size, rate)
            return "h264"
        _with_opencv(path, temporary, chain([first], even), size, rate)
        return "mp4v"


def _with_opencv(
    path: Path, temporary: Path, frames: Iterator[Picture], size: tuple[int, int], fps: Fraction
) -> None:
    """Write MPEG-4 part 2 by OpenCV to `temporary`. Raises DataError, which begins with `path`, without an
    encoder and on a full disk.
    """
    writer = cv2.VideoWriter(str(temporary.absolute()), cv2.VideoWriter.fourcc(*"mp4v"), float(fps), size)
    if not writer.isOpened():
        raise DataError(
            f"{path}: no video encoder here; install one with pip install 'fprf[video]', or write a folder"
        )
    count = 0
    try:
        for frame in frames:
            writer.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
            count += 1
    finally:
        writer.release()
    # The writer says nothing of a full disk, which leaves a film without its index.
    found = max(0, int(cv2.VideoCapture(str(temporary.absolute())).get(cv2.CAP_PROP_FRAME_COUNT)))
    if found < count:
        raise unwritable(path, OSError(f"{found} of {count} frames are in it"))


def _animated(path: Path, frames: list[Picture], fps: float) -> Codec:
    """Write an animated picture that starts over at its end."""
    kind, ending, options = _ANIMATED_FORMATS[path.suffix.lower()]
    film = cv2.Animation()
    film.frames = [cv2.cvtColor(frame, cv2.COLOR_RGB2BGR) for frame in frames]
    # Each duration is a whole number of milliseconds, and of GIF's hundredths: rounded so that no error adds
    # up.
    unit = 10 if kind == "gif" else 1
    ends = []
    for k in range(len(frames)):
        ends.append(round(1000 * (k + 1) / fps / unit) * unit)
    film.durations = [end - start for start, end in pairwise([0, *ends])]
    if kind == "webp":
        write_bytes(path, _webp(frames, film.durations))
        return kind
    done, data = cv2.imencodeanimation(ending, film, options)
    if not done:
        raise DataError(f"{path}: OpenCV cannot write it here; write an .mp4, or a folder")
    write_bytes(path, data.tobytes())
    return kind


def _webp(frames: list[Picture], milliseconds: Sequence[int]) -> bytes:
    """An animated picture that starts over at its end, of frames that are whole.

    OpenCV leaves out the blocks of a frame that differ little from the frame before, each time: in a sky that changes
    slowly squares of long ago are left.
    """
    first, *others = [PIL.Image.fromarray(frame) for frame in frames]
    file = BytesIO()
    first.save(
        file,
        "WEBP",
        save_all=True,
        append_images=others,
        duration=list(milliseconds),
        loop=0,
        quality=_WEBP_QUALITY,
        kmin=0,
        kmax=1,
    )
    return file.getvalue()


_FRAMES_RECORD = ".render.json"
"""File that says what a folder of frames was rendered from, and their names."""


def missing_frames(folder: Path, key: str, paths: Sequence[Path]) -> list[Path]:
    """Frames that are not there yet; all, where the folder was rendered from something else than `key` says.

    The key is written down at once, with the names of the frames, so that what is rendered from now on
    counts, and can be told from a stranger's files. Frames are whole or absent. Raises DataError where the
    system refuses to write there.
    """
    # What the folder was rendered from, if that can be read, and the frames of it.
    record = folder / _FRAMES_RECORD
    try:
        content = parse_json(record.read_text("utf-8"))
        known = content.get("key")
        old = []
        for name in content.get("frames", []):
            old.append(Path(name).name)
    except (OSError, ValueError, AttributeError, TypeError):
        known = None
        old = []
    if known == key:
        found: list[Path] = []
        for path in paths:
            if not path.is_file():
                found.append(path)
        return found
    try:
        for name in {*old, *(path.name for path in paths)} - {"", ".."}:  # which are folders
            (folder / name).unlink(missing_ok=True)
    except OSError as error:
        raise unwritable(folder, error) from error
    write_json(record, {"key": key, "frames": [path.name for path in paths]})
    return list(paths)
