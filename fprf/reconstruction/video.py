"""Frames of a video: their sharpness in one pass, those that are kept in another."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

from ..datamanagers.images import Image
from ..errors import DataError
from ..io.atomic import write_bytes
from .sharpness import sharpness

__all__ = ["VIDEO_SUFFIXES", "frame_name", "frame_scores", "save_frames"]

VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm"})
"""What is taken for a video, in lower case."""

_QUALITY = 95

Progress = Callable[[int, int, str], None]


def frame_name(frame: int) -> str:
    """The file of a frame."""
    return f"frame_{frame:06d}.jpg"


def frame_scores(video: Path, progress: Progress) -> list[float]:
    """Sharpness of every frame, in their order. Raises DataError where the file holds no frames."""
    with _opened(video) as (reader, expected):
        scores: list[float] = []
        for frame in _frames(reader):
            progress(len(scores), max(expected, len(scores) + 1), "looking for sharp frames")
            scores.append(sharpness(frame))
    if not scores:
        raise DataError(f"{video}: no frame can be decoded; convert it to H.264 in an .mp4, or give a folder of images")
    progress(len(scores), len(scores), "looking for sharp frames")
    return scores


def save_frames(video: Path, frames: Sequence[int], folder: Path, progress: Progress) -> None:
    """Write some of the frames, as JPEG (95), each whole or not at all; those that are there stay."""
    wanted = {frame for frame in frames if not (folder / frame_name(frame)).is_file()}
    if not wanted:
        return
    last, done = max(wanted), 0
    with _opened(video) as (reader, _):
        for index, image in enumerate(_frames(reader, wanted)):
            if index in wanted:
                coded, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
                assert coded
                write_bytes(folder / frame_name(index), data.tobytes())
                done += 1
                progress(done, len(wanted), "writing frames")
            if index == last:
                return
    raise DataError(f"{video}: frame {last} was there before and is not now; keep the video as it is while it is processed")


@contextmanager
def _opened(video: Path) -> Iterator[tuple[cv2.VideoCapture, int]]:
    """The reader of a video and the number of frames that it claims to have."""
    reader = cv2.VideoCapture(str(video))
    try:
        if not reader.isOpened():
            raise DataError(f"{video}: no video that can be opened; convert it to H.264 in an .mp4, or give a folder of images")
        yield reader, max(0, int(reader.get(cv2.CAP_PROP_FRAME_COUNT)))
    finally:
        reader.release()


def _frames(reader: cv2.VideoCapture, wanted: set[int] | None = None) -> Iterator[Image]:
    """Frames one by one; those that are not wanted come empty and are not decoded to pixels."""
    index = 0
    while reader.grab():
        if wanted is None or index in wanted:
            done, frame = reader.retrieve()
            if not done:
                return
            yield np.asarray(cv2.cvtColor(frame, cv2.COLOR_BGR2RGB), dtype=np.uint8)
        else:
            yield np.empty((0, 0, 3), dtype=np.uint8)
        index += 1
