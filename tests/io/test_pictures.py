"""Pictures, maps and films in files."""

import math
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fprf.errors import DataError, NumericsError, UsageError
from fprf.io.images import encode, shrink, srgb_to_linear, to_uint8, write_image
from fprf.io.maps import depth_image, depth_limits, match_image, match_summary, palette, side_by_side
from fprf.io.video import missing_frames, write_video


def ramp(height: int = 40, width: int = 60) -> np.ndarray:
    y, x = np.mgrid[:height, :width]
    return np.stack([x * 255 // max(1, width - 1), y * 255 // max(1, height - 1), x * 0 + 40], -1).astype(
        np.uint8
    )


def read(path: Path) -> np.ndarray:
    return cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_what_is_not_finite_is_refused(value: float) -> None:
    image = torch.zeros(2, 2, 3)
    image[0, 0, 0] = value
    with pytest.raises(NumericsError, match="not finite"):
        to_uint8(image)


def test_png_is_exact_and_the_others_are_close(tmp_path: Path) -> None:
    picture = ramp()
    for name, bound in (("a.png", 0), ("a.jpg", 12), ("a.JPEG", 12), ("a.webp", 14)):
        write_image(tmp_path / name, picture)
        assert np.abs(read(tmp_path / name).astype(int) - picture).max() <= bound, name


def test_png_and_webp_keep_transparency(tmp_path: Path) -> None:
    alpha = np.arange(0, 256, dtype=np.uint8).reshape(16, 16)
    picture = np.dstack([np.full((16, 16, 3), (200, 90, 30), np.uint8), alpha])
    write_image(tmp_path / "a.png", picture)
    found = cv2.imread(str(tmp_path / "a.png"), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(found[:, :, [2, 1, 0, 3]], picture)
    webp = cv2.imdecode(np.frombuffer(encode(picture, "webp"), np.uint8), cv2.IMREAD_UNCHANGED)
    assert np.abs(webp[:, :, 3].astype(int) - alpha).max() <= 2


def test_other_endings_and_other_arrays_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError):
        write_image(tmp_path / "a.tiff", ramp())
    for wrong in (
        ramp().astype(np.float32),
        ramp()[..., 0],
        np.zeros((0, 4, 3), np.uint8),
        np.zeros((4, 4, 5), np.uint8),
        np.zeros((4, 4, 4), np.float32),
    ):
        with pytest.raises(DataError):
            encode(wrong, "png")
    with pytest.raises(DataError):
        encode(np.zeros((4, 4, 4), np.uint8), "jpg")
    with pytest.raises(DataError, match="use png"):
        encode(np.zeros((1, 20000, 3), np.uint8), "webp")
    assert not list(tmp_path.iterdir())


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 70), st.integers(1, 70), st.integers(1, 80))
def test_shrinking_keeps_the_shape_and_the_mean(height: int, width: int, side: int) -> None:
    picture = ramp(height, width)
    small = shrink(picture, side)
    assert max(small.shape[:2]) == min(side, max(height, width))
    assert small.min() >= picture.min() and small.max() <= picture.max()
    if min(small.shape[:2]) > 8:
        assert np.abs(small.mean((0, 1)) - picture.mean((0, 1))).max() < 3


def test_light_is_srgb_to_linear() -> None:
    assert srgb_to_linear(np.array([0.0, 0.04045, 0.5, 1.0], np.float32)) == pytest.approx(
        [0, 0.0031308, 0.2140411, 1], abs=1e-6
    )


def lightness(picture: np.ndarray) -> np.ndarray:
    return picture.astype(float) @ np.array([0.2126, 0.7152, 0.0722])


def test_depth_scale_does_not_matter_and_outliers_do_not_blind() -> None:
    depth = 1 + torch.rand(30, 30)
    solid = torch.ones(30, 30)
    assert np.abs(depth_image(depth, solid).astype(int) - depth_image(depth * 512, solid)).max() <= 1
    outlier = depth.clone()
    outlier[0, 0] = 1e-3
    assert np.abs(depth_image(outlier, solid)[1:].astype(int) - depth_image(depth, solid)[1:]).mean() < 8


@pytest.mark.parametrize("nothing", [0.0, -1.0, math.nan, math.inf])
def test_where_nothing_is_it_is_grey(nothing: float) -> None:
    depth = torch.full((5, 5), 2.0)
    depth[0] = nothing
    picture = depth_image(depth, torch.ones(5, 5))
    empty = depth_image(torch.full((5, 5), 2.0), torch.zeros(5, 5))
    assert np.array_equal(picture[0], empty[0]) and np.ptp(empty[0, 0]) < 10
    assert not np.array_equal(picture[1], empty[1])
    assert depth_limits([depth], [torch.zeros(5, 5)]) == (0.0, 1.0)


def certain(codes: torch.Tensor, count: int) -> torch.Tensor:
    return torch.nn.functional.one_hot(codes, count).float()


def test_match_map_shows_hue_shade_and_doubt() -> None:
    reference = torch.tensor([0, 0, 1])
    sure = match_image(certain(torch.tensor([[0, 1, 2]]), 3), reference, ["a", "b"]).astype(int)
    unsure = match_image(torch.full((1, 3, 3), 1 / 3), reference, ["a", "b"]).astype(int)
    assert np.abs(sure[0, 2] - (palette(2)[1].numpy() * 255)).max() <= 1
    assert lightness(sure)[0, 0] < lightness(sure)[0, 1]  # two shades of the first reference
    assert sure[0, 0, 0] > sure[0, 0, 2] and sure[0, 1, 0] > sure[0, 1, 2]  # both orange
    assert lightness(unsure)[0, 0] == pytest.approx(0.45 * lightness(sure)[0, 0], rel=0.05)
    empty = match_image(certain(torch.tensor([[0]]), 3), reference, ["a", "b"], torch.zeros(1, 1))
    assert np.ptp(empty[0, 0]) < 10


def test_match_summary_in_closed_form() -> None:
    attention = torch.tensor([[[1.0, 0, 0], [0, 0.5, 0.5]]])
    row = match_summary(attention, torch.tensor([0, 1, 1]), ["a", "b"])
    assert row == {
        "references": [{"name": "a", "share": 0.5}, {"name": "b", "share": 0.5}],
        "mean_score": 0.75,
        "entropy_bits": pytest.approx(0.5),
    }
    hidden = match_summary(attention, torch.tensor([0, 1, 1]), ["a", "b"], torch.tensor([[3.0, 0.0]]))
    assert hidden["references"] == [{"name": "a", "share": 1.0}, {"name": "b", "share": 0.0}]
    nothing = match_summary(attention, torch.tensor([0, 1, 1]), ["a", "b"], torch.zeros(1, 2))
    assert nothing["mean_score"] == 0.0


def flat(value: int, width: int = 40, height: int = 6) -> np.ndarray:
    return np.full((height, width, 3), value, np.uint8)


def test_beside_keeps_every_pixel() -> None:
    whole = side_by_side([flat(10), flat(20, 30), flat(30, 5)])
    assert whole.shape == (6, 40 + 2 + 30 + 2 + 5, 3)
    assert (whole[:, :40] == 10).all() and (whole[:, 42:72] == 20).all() and (whole[:, 74:] == 30).all()
    assert (whole[:, 40:42] == 255).all() and np.array_equal(side_by_side([flat(7)]), flat(7))
    with pytest.raises(DataError, match="heights"):
        side_by_side([flat(1), flat(2, height=7)])


def test_missing_frames_are_those_not_there(tmp_path: Path) -> None:
    paths = [tmp_path / f"{k}.png" for k in range(3)]
    assert missing_frames(tmp_path, "a", paths) == paths
    paths[1].write_bytes(b"x")
    (tmp_path / "mine.txt").write_text("stays")
    assert missing_frames(tmp_path, "a", paths) == [paths[0], paths[2]]
    assert (
        missing_frames(tmp_path, "b", paths) == paths
        and not paths[1].exists()
        and (tmp_path / "mine.txt").is_file()
    )
    for path in paths:
        path.write_bytes(b"x")
    assert missing_frames(tmp_path, "c", paths[:1]) == paths[:1] and not paths[2].exists(), (
        "frames of a longer film"
    )
    for damaged in ("damaged", '{"key": "a", "frames": ["", "..", "."]}'):
        (tmp_path / ".render.json").write_text(damaged)
        assert missing_frames(tmp_path, "b", paths) == paths


COLOURS = [(230, 40, 40), (40, 200, 60), (30, 60, 220), (240, 240, 240), (10, 10, 10)]


def plain(height: int, width: int) -> Iterator[np.ndarray]:
    for colour in COLOURS:
        yield np.broadcast_to(np.array(colour, np.uint8), (height, width, 3)).copy()


def frames_of(path: Path) -> tuple[list[np.ndarray], float]:
    film = cv2.VideoCapture(str(path))
    found = []
    while (read := film.read())[0]:
        found.append(cv2.cvtColor(read[1], cv2.COLOR_BGR2RGB))
    return found, film.get(cv2.CAP_PROP_FPS)


@pytest.mark.parametrize("h264", [True, False])
@pytest.mark.parametrize("size", [(48, 64), (49, 65)])
def test_a_film_reads_back(tmp_path: Path, h264: bool, size: tuple[int, int]) -> None:
    if h264:
        pytest.importorskip("av")
    path = tmp_path / "film.mp4"
    assert write_video(path, plain(*size), 12, h264=h264) == ("h264" if h264 else "mp4v")
    found, fps = frames_of(path)
    assert len(found) == len(COLOURS) and fps == pytest.approx(12)
    for frame, colour in zip(found, COLOURS, strict=True):
        assert frame.shape == (size[0] + size[0] % 2, size[1] + size[1] % 2, 3)
        # 8-bit YUV is two steps coarse; MPEG-4 part 2 quantises more. The padded edge has the same colour.
        assert np.abs(frame.astype(int) - colour).max() <= (4 if h264 else 8)
    assert list(tmp_path.iterdir()) == [path]


def test_a_sky_that_changes_slowly_leaves_no_squares(tmp_path: Path) -> None:
    # A frame changes the sky by less than an encoder takes for a change, and something moves below it.
    frames = []
    for step in range(41):
        sky = np.full((64, 96, 3), 60 + step, np.uint8)
        sky[48:, 2 * step : 2 * step + 16] = 240
        frames.append(sky)
    write_video(tmp_path / "sky.webp", iter(frames), fps=10)
    done, film = cv2.imreadanimation(str(tmp_path / "sky.webp"))
    assert done and len(film.frames) == 41
    for frame, wanted in zip(film.frames, frames, strict=True):
        shown = frame[:32, :, 2::-1].astype(int)
        assert np.abs(shown - wanted[:32]).max() <= 4


@pytest.mark.parametrize(("ending", "far"), [(".gif", 12), (".webp", 8), (".apng", 0)])
def test_animated_pictures_read_back(tmp_path: Path, ending: str, far: int) -> None:
    path = tmp_path / f"film{ending}"
    assert write_video(path, plain(48, 64), 24) == ending[1:]
    read, found = cv2.imdecodeanimation(np.frombuffer(path.read_bytes(), np.uint8))
    assert read and len(found.frames) == len(COLOURS) and found.loop_count == 0
    assert sum(found.durations) == pytest.approx(5 / 24 * 1000, abs=5), "roundings do not add up"
    for frame, colour in zip(found.frames, COLOURS, strict=True):
        assert np.abs(frame[:, :, 2::-1].mean((0, 1)) - colour).max() <= far, "GIF dithers"
    assert list(tmp_path.iterdir()) == [path]


def test_a_film_plays_while_it_loads_and_says_its_colours(tmp_path: Path) -> None:
    av = pytest.importorskip("av")
    path = tmp_path / "film.mp4"
    write_video(path, plain(32, 32), 29.97)
    data = path.read_bytes()
    assert data.find(b"moov") < data.find(b"mdat") and b"avc1" in data
    with av.open(str(path)) as film:
        context = film.streams.video[0].codec_context
        assert context.name == "h264"
        assert (context.pix_fmt, context.colorspace, context.color_range) == ("yuv420p", 1, 1)
        assert float(film.streams.video[0].average_rate) == pytest.approx(29.97, abs=1e-3)


def test_wrong_requests_leave_nothing(tmp_path: Path) -> None:
    with pytest.raises(UsageError):
        write_video(tmp_path / "x.avi", plain(8, 8), 10)
    for fps in (0, -1, float("nan"), float("inf")):
        with pytest.raises(UsageError):
            write_video(tmp_path / "x.mp4", plain(8, 8), fps)
    unlike = [np.zeros((16, 16, 3), np.uint8), np.zeros((16, 18, 3), np.uint8)]
    for frames in (unlike, [], [np.zeros((8, 8, 3))]):
        for h264 in (True, False):
            with pytest.raises(DataError):
                write_video(tmp_path / "x.mp4", frames, 10, h264=h264)
    assert not list(tmp_path.iterdir())
