"""Videos that are read: damage, shapes of pixels, colours by their tags, and what OpenCV makes of them without PyAV."""

import sys
from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fprf.errors import DataError
from fprf.io.transfer import BT709, BT2020, rgb_to_xyz
from fprf.io.video_reader import VideoLog, read_video

av = pytest.importorskip("av")

COUNT = 24
WIDTH = 64
HEIGHT = 48
PATCHES = np.array(
    [
        [128, 128, 128],
        [200, 60, 50],
        [60, 150, 70],
        [50, 80, 190],
        [230, 200, 60],
        [30, 30, 30],
        [210, 210, 210],
    ]
)


def noise(k: int) -> np.ndarray:
    """A frame of 8 x 8 blocks, so that halved chroma loses nothing."""
    blocks = np.random.default_rng(k).integers(30, 220, (HEIGHT // 8, WIDTH // 8, 3), dtype=np.uint8)
    return blocks.repeat(8, 0).repeat(8, 1)


def patches() -> np.ndarray:
    """Columns of eight pixels, a colour each."""
    row = np.resize(PATCHES, (WIDTH // 8, 3)).astype(np.uint8).repeat(8, 0)
    return row[None].repeat(HEIGHT, 0)


def write(
    path: Path,
    frames: Sequence[Any],
    codec: str = "mjpeg",
    pixels: str = "yuvj420p",
    *,
    tags: tuple[int, int, int, int] = (0, 2, 2, 2),
    shape: Fraction | None = None,
    times: Sequence[int] | None = None,
) -> Path:
    """A video; tags are range, matrix, primaries and curve."""
    options = {"mjpeg": {"qscale": "1"}, "libx264": {"crf": "8"}}.get(codec, {})
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=10, options=options)
        stream.width, stream.height = WIDTH, HEIGHT
        stream.pix_fmt = pixels
        context = stream.codec_context
        context.color_range, context.colorspace, context.color_primaries, context.color_trc = tags
        if shape is not None:
            context.sample_aspect_ratio = shape
        for k, given in enumerate(frames):
            frame = given
            if isinstance(given, np.ndarray):
                frame = av.VideoFrame.from_ndarray(given, format="rgb24")
            frame.pts = k if times is None else times[k]
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def planes(rgb: np.ndarray, red: float, blue: float, bits: int, full: bool = False) -> Any:
    """A 4:4:4 frame of signals in [0, 1], by the weights of red and blue in luminance."""
    green = 1 - red - blue
    y = rgb @ np.array([red, green, blue])
    cb = (rgb[..., 2] - y) / (2 * (1 - blue))
    cr = (rgb[..., 0] - y) / (2 * (1 - red))
    largest = (1 << bits) - 1
    unit = 1 << (bits - 8)
    parts = [(16 + 219 * y) * unit, (128 + 224 * cb) * unit, (128 + 224 * cr) * unit]
    if full:
        parts = [y * largest, 128 * unit + cb * largest, 128 * unit + cr * largest]
    name = "yuv444p" if bits == 8 else "yuv444p10le"
    frame = av.VideoFrame(rgb.shape[1], rgb.shape[0], name)
    for plane, part in zip(frame.planes, parts, strict=True):
        levels = np.rint(part).clip(0, largest).astype("u1" if bits == 8 else "<u2")
        rows = np.zeros((plane.height, plane.line_size // levels.itemsize), levels.dtype)
        rows[:, : levels.shape[1]] = levels
        plane.update(rows.tobytes())
    return frame


def read(path: Path) -> tuple[VideoLog, list[np.ndarray]]:
    log, frames = read_video(path)
    return log, [frame.picture() for frame in frames]


def damage(path: Path, packet: int) -> None:
    """Fill a packet with noise."""
    with av.open(str(path)) as container:
        found = [each for each in container.demux(video=0) if each.size]
    data = bytearray(path.read_bytes())
    start = found[packet].pos
    size = found[packet].size
    data[start : start + size] = np.random.default_rng(0).integers(1, 250, size, dtype=np.uint8).tobytes()
    path.write_bytes(data)


@pytest.fixture(params=["av", "opencv"])
def reader(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    if request.param == "opencv":
        monkeypatch.setitem(sys.modules, "av", None)
    return str(request.param)


def test_what_lies_behind_a_damaged_frame_is_read(tmp_path: Path, reader: str) -> None:
    path = write(tmp_path / "walk.avi", [noise(k) for k in range(COUNT)])
    log, whole = read(path)
    assert (log.read, log.expected, log.missing) == (COUNT, COUNT, 0)
    damage(path, 8)
    log, rest = read(path)
    assert (log.read, log.damaged, log.missing) == (COUNT - 1, 1, 1)
    assert "23 of" in log.sentence() and "24 frames" in log.sentence()
    for before, after in zip(whole[:8] + whole[9:], rest, strict=True):
        assert np.array_equal(before, after)
    assert abs(rest[0].astype(int) - noise(0)).mean() < 6


@pytest.mark.parametrize("name", ["cut.mkv", "cut.avi"])
def test_a_truncated_video_gives_what_is_there(tmp_path: Path, name: str, reader: str) -> None:
    path = write(tmp_path / name, [noise(k) for k in range(COUNT)])
    whole = read(path)[1]
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 6 // 10])
    log, frames = read(path)
    assert 8 <= log.read == len(frames) < 20 and log.missing >= COUNT - log.read - 1
    assert np.array_equal(frames[7], whole[7])


def test_files_that_hold_nothing_are_refused_with_their_reason(tmp_path: Path, reader: str) -> None:
    whole = write(tmp_path / "a.mp4", [noise(k) for k in range(COUNT)], "libx264", "yuv420p").read_bytes()
    index = whole.index(b"moov") - 4
    (tmp_path / "cut.mp4").write_bytes(whole[:index])
    (tmp_path / "empty.mp4").write_bytes(b"")
    (tmp_path / "text.mp4").write_bytes(b"no video at all" * 99)
    for name, reason in {"cut": "moov", "empty": "empty", "text": "no video"}.items():
        with pytest.raises(DataError, match=reason):
            read(tmp_path / f"{name}.mp4")


def test_frames_at_uneven_times_are_all_read(tmp_path: Path, reader: str) -> None:
    times = [k if k < 12 else 12 + 10 * (k - 12) for k in range(COUNT)]
    frames = [noise(k) for k in range(COUNT)]
    log, found = read(write(tmp_path / "a.mp4", frames, "libx264", "yuv420p", times=times))
    assert log.read == COUNT and not log.missing
    assert abs(found[20].astype(int) - noise(20)).mean() < 6


@pytest.mark.parametrize(
    ("shape", "size"), [(Fraction(4, 3), (85, 48)), (Fraction(8, 9), (64, 54)), (Fraction(1000, 1), (64, 48))]
)
def test_pixels_become_square(tmp_path: Path, shape: Fraction, size: tuple[int, int], reader: str) -> None:
    """A line in the middle stays there, and is as wide a share of the frame."""
    frame = np.full((HEIGHT, WIDTH, 3), 40, np.uint8)
    frame[:, 24:40] = 200
    frames = [frame] * 3
    found = read(write(tmp_path / "a.mp4", frames, "libx264", "yuv420p", shape=shape))[1]
    assert found[0].shape == (size[1], size[0], 3)
    bright = (found[0][..., 1] > 120).mean(axis=0)
    assert bright.mean() == pytest.approx(16 / 64, abs=0.02)
    assert (np.arange(size[0])[bright > 0.5].mean() + 0.5) / size[0] == pytest.approx(0.5, abs=0.02)


MATRICES = [
    ((1, 1, 1, 1), 0.2126, 0.0722, False),
    ((1, 6, 6, 6), 0.299, 0.114, False),
    ((1, 5, 5, 5), 0.299, 0.114, False),
    ((2, 1, 1, 1), 0.2126, 0.0722, True),
    ((2, 6, 1, 13), 0.299, 0.114, True),
    ((0, 2, 2, 2), 0.299, 0.114, False),  # untagged, and small
]


@pytest.mark.parametrize(("tags", "red", "blue", "full"), MATRICES)
def test_matrix_and_range_are_obeyed(
    tmp_path: Path, tags: tuple[int, int, int, int], red: float, blue: float, full: bool
) -> None:
    frame = planes(patches() / 255, red, blue, 8, full)
    log, found = read(write(tmp_path / "a.mkv", [frame], "ffv1", "yuv444p", tags=tags))
    assert abs(found[0].astype(int) - patches()).max() <= 2
    assert not log.notes


def linear(levels: np.ndarray) -> np.ndarray:
    """Light of sRGB."""
    value = levels / 255
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def hlg(light: np.ndarray) -> np.ndarray:
    """Signal of HLG (BT.2100), white at 75 %."""
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    scene = light * 0.26496256
    return np.where(scene <= 1 / 12, np.sqrt(3 * scene), a * np.log(np.maximum(12 * scene - b, 1e-9)) + c)


def pq(light: np.ndarray) -> np.ndarray:
    """Signal of PQ (BT.2100), white at 203 cd/m2."""
    power = (light * 203 / 10000) ** 0.1593017578125
    return ((0.8359375 + 18.8515625 * power) / (1 + 18.6875 * power)) ** 78.84375


def gamma(light: np.ndarray) -> np.ndarray:
    """Signal of sRGB."""
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


@pytest.mark.parametrize(("curve", "signal"), [(18, hlg), (16, pq), (14, gamma)])
def test_wide_colours_and_high_dynamic_range_become_srgb(
    tmp_path: Path, curve: int, signal: Callable[[np.ndarray], np.ndarray]
) -> None:
    wide = np.linalg.inv(rgb_to_xyz(BT2020)) @ rgb_to_xyz(BT709)
    frame = planes(signal((linear(patches()) @ wide.T).clip(0, 1)), 0.2627, 0.0593, 10)
    path = write(tmp_path / "a.mkv", [frame], "ffv1", "yuv444p10le", tags=(1, 9, 9, curve))
    log, found = read(path)
    assert abs(found[0].astype(int) - patches()).max() <= 3
    assert len(log.notes) == 1


def test_ten_bits_reach_the_curve(tmp_path: Path) -> None:
    """A ramp in the shadows of PQ: cut to 8 bits, half of its levels would be gone."""
    light = np.linspace(0.0, 0.06, WIDTH)[None, :, None].repeat(HEIGHT, 0).repeat(3, 2)
    frame = planes(pq(light), 0.2627, 0.0593, 10)
    path = write(tmp_path / "a.mkv", [frame], "ffv1", "yuv444p10le", tags=(1, 9, 9, 16))
    found = read(path)[1][0]
    assert abs(found - 255 * gamma(light)).max() < 1.5
    assert len(np.unique(found[0, :, 1])) > 45


def test_without_pyav_more_than_eight_bits_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    frame = planes(patches() / 255, 0.2627, 0.0593, 10)
    path = write(tmp_path / "a.mkv", [frame], "ffv1", "yuv444p10le", tags=(1, 9, 9, 18))
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(DataError, match=r"fprf\[video\]"):
        read(path)


def test_names_with_a_colon_are_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reader: str) -> None:
    write(tmp_path / "a.avi", [noise(0)] * 3).rename(tmp_path / "10:30 walk 100%.avi")
    monkeypatch.chdir(tmp_path)
    assert read(Path("10:30 walk 100%.avi"))[0].read == 3
