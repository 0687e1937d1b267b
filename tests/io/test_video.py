from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from fprf.errors import DataError, UsageError
from fprf.io.video import write_frames, write_video

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


@pytest.mark.parametrize(("ending", "far"), [(".gif", 12), (".webp", 8), (".apng", 0)])
def test_animated_pictures_read_back(tmp_path: Path, ending: str, far: int) -> None:
    path = tmp_path / f"film{ending}"
    assert write_video(path, flat(48, 64), 24) == ending[1:]
    read, found = cv2.imdecodeanimation(np.frombuffer(path.read_bytes(), np.uint8))
    assert read and len(found.frames) == len(COLOURS) and found.loop_count == 0
    assert sum(found.durations) == pytest.approx(5 / 24 * 1000, abs=5), "roundings do not add up"
    for frame, colour in zip(found.frames, COLOURS, strict=True):
        assert np.abs(frame[:, :, 2::-1].mean((0, 1)) - colour).max() <= far, "GIF dithers"
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


def test_frames_as_pictures_are_exact_and_named(tmp_path: Path) -> None:
    paths = write_frames(tmp_path / "out", ["0001", "b.c", "x", "y", "z"], flat(5, 7))
    assert [path.name for path in paths] == ["0001.png", "b.c.png", "x.png", "y.png", "z.png"]
    assert sorted((tmp_path / "out").iterdir()) == sorted(paths)
    for path, frame in zip(paths, flat(5, 7), strict=True):
        assert np.array_equal(cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB), frame)


@pytest.mark.parametrize("names", [["../x"], ["a/b"], [""], [".."], ["/x"], ["a", "a"]])
def test_names_that_leave_the_folder_or_repeat_are_refused(tmp_path: Path, names: list[str]) -> None:
    with pytest.raises(DataError):
        write_frames(tmp_path / "out", names, list(flat(4, 4))[: len(names)])
