from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from fprf.errors import DataError, UsageError
from fprf.io.video import write_video

COLOURS = [(230, 40, 40), (40, 200, 60), (30, 60, 220), (240, 240, 240), (10, 10, 10)]


def flat(height: int, width: int) -> Iterator[np.ndarray]:
    for colour in COLOURS:
        yield np.broadcast_to(np.array(colour, np.uint8), (height, width, 3)).copy()


def frames_of(path: Path) -> tuple[list[np.ndarray], float]:
    film, found = cv2.VideoCapture(str(path)), []
    while (read := film.read())[0]:
        found.append(cv2.cvtColor(read[1], cv2.COLOR_BGR2RGB))
    return found, film.get(cv2.CAP_PROP_FPS)


@pytest.mark.parametrize("h264", [True, False])
@pytest.mark.parametrize("size", [(48, 64), (49, 65)])
def test_a_film_reads_back(tmp_path: Path, h264: bool, size: tuple[int, int]) -> None:
    if h264:
        pytest.importorskip("av")
    path = tmp_path / "film.mp4"
    assert write_video(path, flat(*size), 12, h264=h264) == ("h264" if h264 else "mp4v")
    found, fps = frames_of(path)
    assert len(found) == len(COLOURS) and fps == pytest.approx(12)
    for frame, colour in zip(found, COLOURS, strict=True):
        assert frame.shape == (size[0] + size[0] % 2, size[1] + size[1] % 2, 3)
        # 8-bit YUV is two steps coarse; MPEG-4 part 2 quantises more. The padded edge has the same colour.
        assert np.abs(frame.astype(int) - colour).max() <= (4 if h264 else 8)
    assert list(tmp_path.iterdir()) == [path]


def test_a_film_plays_while_it_loads_and_says_its_colours(tmp_path: Path) -> None:
    av = pytest.importorskip("av")
    path = tmp_path / "film.mp4"
    write_video(path, flat(32, 32), 29.97)
    data = path.read_bytes()
    assert data.find(b"moov") < data.find(b"mdat") and b"avc1" in data
    with av.open(str(path)) as film:
        context = film.streams.video[0].codec_context
        assert context.name == "h264"
        assert (context.pix_fmt, context.colorspace, context.color_range) == ("yuv420p", 1, 1)
        assert float(film.streams.video[0].average_rate) == pytest.approx(29.97, abs=1e-3)


def test_wrong_requests_leave_nothing(tmp_path: Path) -> None:
    with pytest.raises(UsageError):
        write_video(tmp_path / "x.avi", flat(8, 8), 10)
    for fps in (0, -1, float("nan"), float("inf")):
        with pytest.raises(UsageError):
            write_video(tmp_path / "x.mp4", flat(8, 8), fps)
    unlike = [np.zeros((16, 16, 3), np.uint8), np.zeros((16, 18, 3), np.uint8)]
    for frames in (unlike, [], [np.zeros((8, 8, 3))]):
        for h264 in (True, False):
            with pytest.raises(DataError):
                write_video(tmp_path / "x.mp4", frames, 10, h264=h264)
    assert not list(tmp_path.iterdir())
