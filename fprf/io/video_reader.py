"""Frames of a video as sRGB pictures, upright, with square pixels; one frame in memory at a time.

PyAV (extra `video`) reads them where it is installed, OpenCV elsewhere. What the file says of itself is obeyed:
the matrix and range of its YCbCr, its primaries and curve (HLG and PQ become sRGB by `fprf/io/transfer.py`, from
16 bits a channel), its rotation by quarters, the shape of its pixels. OpenCV tells no primaries or curve, so that
without PyAV videos of more than 8 bits are refused.

A frame that cannot be decoded is left out, and reading goes on behind it. Decoders repair what refers to a lost
frame as well as they can: until the next key frame such frames may be smeared, or missing too.
"""

import importlib
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import DataError
from .images import Picture, resized
from .transfer import SRGB, UNSPECIFIED, ColourSpace, colour_space, picture_of

Grey: TypeAlias = Annotated[NDArray[np.uint8], "H W"]

VIDEO_SUFFIXES = frozenset(
    {".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mts", ".m2ts", ".m2t", ".mpg", ".mpeg", ".3gp"}
)
"""Suffixes of videos, in lower case."""

_SDR_PRIMARIES = frozenset({1, 2, 5, 6, 7})
"""Code points (H.273) of primaries that players show as BT.709's, among them both of BT.601: they differ by less
than displays do."""
_SDR_CURVES = frozenset({1, 2, 4, 5, 6, 7, 11, 12, 13, 14, 15})
"""Code points of curves that players show as sRGB's; old cameras say 4 and 5, and mean BT.601."""
_KNOWN_MATRICES = frozenset({0, 1, 4, 5, 6, 7, 9})
"""Code points of the matrices that ffmpeg's scaler has; 0 is RGB."""
_BT709_NUMBER = 1
"""Code point of the matrix of high definition."""
_BT601_NUMBER = 6
"""Code point of the matrix of standard definition."""
_BT2020_NUMBER = 9
"""Code point of primaries and matrix of ultra-high definition."""
_MAX_SD_LINES = 576
"""Lines up to which an untagged video counts as standard definition, as players have it."""
_MIN_HD_COLUMNS = 1280
"""Columns from which on an untagged video counts as high definition, as players have it."""
_MAX_PIXEL_RATIO = 4
"""Pixels that are more times as wide as high, or as high as wide, are a mistake of the file. By eye: two-to-one
anamorphic lenses on 4:3 pixels reach 2.7."""
_MIN_READ_SHARE = 0.98
"""Share of the frames that a duration promises, below which some count as missing: rates are rounded."""
_MAX_LOST_GRABS = 60
"""Frames in a row that OpenCV may fail to read before the video counts as ended: it does not say which it is. By
eye, two seconds."""
_DEEP_BITS = (b"\x0a", b"\x0c", b"\x10")
"""Last byte of ffmpeg's tags of YCbCr formats with 10, 12 and 16 bits; the first is a Y."""


@dataclass
class VideoLog:
    """Description of a video by its file, and counts of what has been read so far."""

    path: Path
    expected: int = 0
    """Frames by the count in the container, or by duration and rate; 0 where it says nothing."""
    exact: bool = False
    """The container counts its frames."""
    read: int = 0
    """Frames that were decoded."""
    damaged: int = 0
    """Frames that could not be decoded."""
    skipped: int = 0
    """Frames that the container itself leaves out, as after a cut in a phone."""
    notes: list[str] = field(default_factory=list)
    """Decisions: colours, shape of pixels, interlacing."""

    @property
    def missing(self) -> int:
        """Frames that were promised and not read."""
        promised = self.expected - self.skipped
        if not self.exact and self.read >= _MIN_READ_SHARE * promised:
            return self.damaged
        return max(self.damaged, promised - self.read)

    def sentence(self) -> str:
        """Expected and read frames, in one line."""
        if not self.missing:
            return f"{self.path.name}: all of its {self.read} frames were read"
        about = "" if self.exact else "about "
        total = f"{about}{max(self.expected - self.skipped, self.read + self.damaged)}"
        reasons = []
        if self.damaged:
            reasons.append(
                f"{self.damaged} cannot be decoded; up to the next key frame others may be smeared"
            )
        if self.missing > self.damaged:
            reasons.append(f"{self.missing - self.damaged} are missing: the file is cut off or damaged")
        return f"{self.path.name}: {self.read} of {total} frames were read; {'; '.join(reasons)}"

    def note(self, text: str) -> None:
        """Remember a decision, once."""
        line = f"{self.path.name}: {text}"
        if line not in self.notes:
            self.notes.append(line)


class VideoFrame(ABC):
    """One frame, converted when it is asked for."""

    @abstractmethod
    def grey(self) -> Grey:
        """Its luminance as it is stored: not turned, not tone-mapped."""

    @abstractmethod
    def picture(self) -> Picture:
        """The frame in sRGB, upright, with square pixels."""


def read_video(path: Path) -> tuple[VideoLog, Iterator[VideoFrame]]:
    """Description of a video and its frames; the log is complete when these have been gone through.

    Raises DataError where the file is empty, cannot be opened, or holds no video, here or at the first frame.
    """
    if path.stat().st_size == 0:
        raise DataError(f"{path}: the file is empty; copy it from the camera again")
    log = VideoLog(path)
    with suppress(ImportError):
        return log, _read_with_av(importlib.import_module("av"), log)
    return log, _read_with_opencv(log)


def _unopened(path: Path) -> DataError:
    """Error for a file that no reader opens."""
    cut = _without_index(path)
    if cut:
        return DataError(
            f"{path}: no video that can be opened: its index (moov) is missing, so it was cut off while it was recorded or "
            "copied; copy it again, or have it repaired, for example by untrunc"
        )
    return DataError(
        f"{path}: no video that can be opened; convert it to H.264 in an .mp4, or give a folder of images"
    )


def _without_index(path: Path) -> bool:
    """True for an MP4 or MOV whose boxes end without the index."""
    size = path.stat().st_size
    found = set()
    with path.open("rb") as file:
        at = 0
        while at + 8 <= size:
            file.seek(at)
            head = file.read(16)
            length = int.from_bytes(head[:4], "big")
            found.add(head[4:8])
            if length == 1:  # 64 bits of length follow
                length = int.from_bytes(head[8:16], "big")
            if length < 8:  # 0: up to the end of the file
                break
            at += length
    return b"mdat" in found and b"moov" not in found


def square_size(width: int, height: int, ratio: Fraction) -> tuple[int, int]:
    """Size of a picture whose pixels are `ratio` times as wide as high, after they are made square by enlarging
    the shorter of their sides.
    """
    if ratio >= 1:
        return round(width * ratio), height
    return width, round(height / ratio)


def _shape_of_pixels(log: VideoLog, given: Fraction | None, width: int, height: int) -> Fraction:
    """Width of pixels over their height; 1 where the file says nothing, or what cannot be."""
    if given is None or given <= 0 or given == 1:
        return Fraction(1)
    if not Fraction(1, _MAX_PIXEL_RATIO) <= given <= _MAX_PIXEL_RATIO:
        log.note(f"pixels of shape {given.numerator}:{given.denominator} are a mistake; taken for square")
        return Fraction(1)
    wide, high = square_size(width, height, given)
    if (wide, high) != (width, height):
        log.note(
            f"pixels are not square ({given.numerator}:{given.denominator}): frames become {wide}x{high} from {width}x{height}"
        )
    return given


def _read_with_av(av: ModuleType, log: VideoLog) -> Iterator[VideoFrame]:
    """Frames by PyAV, packet by packet, so that a damaged one does not end the reading."""
    with suppress(AttributeError):  # ffmpeg's own words on damaged frames; the log has ours
        av.logging.set_level(None)
    try:
        # An absolute path: ffmpeg takes what stands before a colon for a protocol.
        container = av.open(str(log.path.absolute()))
    except (av.error.FFmpegError, OSError) as error:
        raise _unopened(log.path) from error
    with container:
        stream = container.streams.best("video")
        if stream is None:
            raise DataError(
                f"{log.path}: holds no video, only sound or data; give a video or a folder of images"
            )
        stream.thread_type = "AUTO"
        _expect(av, log, container, stream)
        for packet in _packets(av, log, container, stream):
            try:
                frames = packet.decode()
            except av.error.FFmpegError:
                log.damaged += 1
                continue
            for frame in frames:
                if frame.is_corrupt:
                    log.damaged += 1
                    continue
                log.read += 1
                yield _AvFrame(log, frame, stream)


def _expect(av: ModuleType, log: VideoLog, container: Any, stream: Any) -> None:
    """Write down how many frames the container promises."""
    log.expected = max(0, int(stream.frames))
    log.exact = log.expected > 0
    if log.exact or not stream.average_rate:
        return
    seconds = 0.0
    if stream.duration is not None:
        seconds = float(stream.duration * stream.time_base)
    elif container.duration is not None:
        seconds = container.duration / av.time_base
    log.expected = max(0, round(seconds * float(stream.average_rate)))


def _packets(av: ModuleType, log: VideoLog, container: Any, stream: Any) -> Iterator[Any]:
    """Packets of a stream, as far as the container can be read."""
    packets = container.demux(stream)
    while True:
        try:
            packet = next(packets)
        except StopIteration:
            return
        except av.error.FFmpegError:  # what is missing then is told by the count
            return
        if packet.is_discard:
            log.skipped += 1
        yield packet


class _AvFrame(VideoFrame):
    """A frame of PyAV."""

    def __init__(self, log: VideoLog, frame: Any, stream: Any) -> None:
        self._log = log
        self._frame = frame
        self._stream = stream
        if frame.interlaced_frame:
            log.note(
                "is interlaced: moving edges are combed; deinterlace it, for example by ffmpeg -vf bwdif"
            )

    def grey(self) -> Grey:
        return np.asarray(self._frame.to_ndarray(format="gray"), dtype=np.uint8)

    def picture(self) -> Picture:
        frame = self._frame
        space = self._space()
        form = "rgb24" if space == SRGB else "rgb48le"
        converted = frame.reformat(format=form, src_colorspace=self._matrix(), interpolation="BICUBIC")
        levels = converted.to_ndarray()
        if space == SRGB:
            picture = np.asarray(levels, dtype=np.uint8)
        else:
            picture = picture_of(levels, space, largest=65535)
        ratio = _shape_of_pixels(self._log, self._stream.sample_aspect_ratio, frame.width, frame.height)
        size = square_size(frame.width, frame.height, ratio)
        if size != (frame.width, frame.height):
            picture = resized(picture, *size)
        return np.ascontiguousarray(np.rot90(picture, round(frame.rotation / 90)))

    def _matrix(self) -> int:
        """Code point of the matrix: the frame's, or what players take for untagged ones."""
        frame = self._frame
        matrix = int(frame.colorspace)
        if matrix in _KNOWN_MATRICES:
            return matrix
        if matrix != UNSPECIFIED:
            self._log.note(f"its colour matrix (H.273 number {matrix}) is not known here; colours may be off")
        if int(self._stream.codec_context.color_primaries) == _BT2020_NUMBER:
            return _BT2020_NUMBER
        if frame.height > _MAX_SD_LINES or frame.width >= _MIN_HD_COLUMNS:
            return _BT709_NUMBER
        return _BT601_NUMBER

    def _space(self) -> ColourSpace:
        """Meaning of the frame's RGB signals."""
        context = self._stream.codec_context
        primaries = int(context.color_primaries)
        curve = int(context.color_trc)
        numbers = f"H.273 numbers {primaries} and {curve}"
        if primaries in _SDR_PRIMARIES:
            primaries = UNSPECIFIED
        if curve in _SDR_CURVES:
            curve = UNSPECIFIED
        space = colour_space(primaries, curve)
        if space is None:
            self._log.note(
                f"its colours ({numbers}) are not known here, and taken for sRGB: export it as BT.709"
            )
            return SRGB
        if space.high_dynamic_range:
            self._log.note(f"{space.curve.upper()} is tone-mapped to sRGB ({numbers})")
        elif space != SRGB:
            self._log.note(f"its colours become sRGB ({numbers})")
        return space


def _read_with_opencv(log: VideoLog) -> Iterator[VideoFrame]:
    """Frames by OpenCV, which tells less of a video."""
    reader = cv2.VideoCapture(str(log.path.absolute()), cv2.CAP_FFMPEG)
    try:
        if not reader.isOpened():
            raise _unopened(log.path)
        pixels = int(reader.get(cv2.CAP_PROP_CODEC_PIXEL_FORMAT))
        tag = pixels.to_bytes(4, "little")
        if tag[:1] == b"Y" and tag[3:] in _DEEP_BITS:
            raise DataError(
                f"{log.path}: has more than 8 bits a colour, as HLG and PQ of phones have, which OpenCV cuts off; "
                "install PyAV with: pip install 'fprf[video]'"
            )
        log.note(
            "is read by OpenCV, which knows no HLG, PQ or wide colours: pip install 'fprf[video]' for these"
        )
        log.expected = max(0, int(reader.get(cv2.CAP_PROP_FRAME_COUNT)))
        log.exact = False
        numerator = int(reader.get(cv2.CAP_PROP_SAR_NUM))
        denominator = int(reader.get(cv2.CAP_PROP_SAR_DEN))
        ratio = None
        if numerator > 0 and denominator > 0:
            ratio = Fraction(numerator, denominator)
        turned = int(reader.get(cv2.CAP_PROP_ORIENTATION_META)) % 180 == 90
        failed = 0
        while failed <= _MAX_LOST_GRABS:
            done, frame = reader.read()
            if not done:
                failed += 1
                continue
            log.damaged += failed
            failed = 0
            log.read += 1
            yield _CvFrame(log, np.asarray(frame, dtype=np.uint8), ratio, turned)
    finally:
        reader.release()


class _CvFrame(VideoFrame):
    """A frame of OpenCV, which has turned it."""

    def __init__(self, log: VideoLog, frame: Picture, ratio: Fraction | None, turned: bool) -> None:
        self._log = log
        self._frame = frame
        self._ratio = ratio
        self._turned = turned

    def grey(self) -> Grey:
        return np.asarray(cv2.cvtColor(self._frame, cv2.COLOR_BGR2GRAY), dtype=np.uint8)

    def picture(self) -> Picture:
        picture: Picture = np.asarray(cv2.cvtColor(self._frame, cv2.COLOR_BGR2RGB), dtype=np.uint8)
        height, width = picture.shape[:2]
        ratio = self._ratio
        if ratio is not None and self._turned:
            ratio = 1 / ratio
        size = square_size(width, height, _shape_of_pixels(self._log, ratio, width, height))
        if size == (width, height):
            return picture
        return resized(picture, *size)
