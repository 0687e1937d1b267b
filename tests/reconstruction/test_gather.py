import contextlib
import json
import os
import sys
from dataclasses import asdict
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from photo_files import HEIC, oriented
from PIL import Image
from PIL.ExifTags import IFD, Base
from raw_files import dng

from fprf.datamanagers.images import load_image
from fprf.datamanagers.positions import read_position
from fprf.errors import ConfigError, DataError, UsageError
from fprf.io.video import write_video
from fprf.reconstruction.config import SfmConfig
from fprf.reconstruction.images import (
    Lens,
    choose_frames,
    gather_images,
    lost_files,
    natural_order,
    read_lens,
    save_frames,
)
from fprf.reconstruction.scene_folder import SceneFolder, State

NOISE = np.random.default_rng(0).integers(0, 256, (8, 12, 3), dtype=np.uint8)


def photo(path: Path, seed: int = 0, size: tuple[int, int] = (24, 16)) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(
        str(path), np.random.default_rng(seed).integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)
    )
    return path


@settings(deadline=None)
@given(st.lists(st.floats(0, 1e6), max_size=80), st.integers(1, 30), st.floats(0, 0.9))
def test_every_frame_is_chosen_or_has_a_reason(scores: list[float], count: int, least: float) -> None:
    chosen, dropped = choose_frames(scores, count, least)
    assert sorted([*chosen, *dropped]) == list(range(len(scores)))
    assert len(chosen) <= count and chosen == sorted(chosen)
    assert all(dropped.values())


HERE = {1: "S", 2: (33.0, 54.0, 3.6), 3: "E", 4: (18.0, 24.0, 0.0)}
"""A position in an EXIF block."""
BLACK = np.zeros((8, 12, 3), np.uint8)


def with_lens(path: Path, pixels: np.ndarray = BLACK, **options: object) -> Path:
    """A photograph whose EXIF block, with an orientation, names its camera, its focal length and its position."""
    exif = Image.Exif()
    exif[Base.Model], exif[Base.Orientation] = "Phone 9", 6
    exif.get_ifd(IFD.Exif).update({Base.FocalLength: 4.25, Base.FocalLengthIn35mmFilm: 26})
    exif.get_ifd(IFD.GPSInfo).update(HERE)
    for part in (IFD.Exif, IFD.GPSInfo):
        exif[part] = exif.get_ifd(part)  # else TIFF would be without
    Image.fromarray(pixels).save(path, exif=exif, **options)
    return path


def test_the_lens_is_read_from_every_format_and_no_lens_is_an_empty_one(tmp_path: Path) -> None:
    for suffix in ("jpg", "png", "webp", "tif", "avif"):
        path = with_lens(tmp_path / f"lens.{suffix}")
        assert read_lens(path) == Lens("Phone 9", 4.25, 26)
        assert read_position(path) == pytest.approx((-33.901, 18.4, 0.0))
    (tmp_path / "text.jpg").write_text("no image")
    for path in (
        photo(tmp_path / "a.jpg"),
        photo(tmp_path / "a.png"),
        tmp_path / "gone",
        tmp_path / "text.jpg",
    ):
        assert read_lens(path) == Lens()


@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.binary(max_size=200), st.integers(0, 160))
def test_a_damaged_exif_block_is_no_fault(tmp_path: Path, noise: bytes, cut: int) -> None:
    whole = with_lens(tmp_path / "a.jpg").read_bytes()
    start = whole.index(b"Exif")
    length = int.from_bytes(whole[start - 2 : start], "big")
    block = whole[start : start + length - 2]
    block = block[:cut] + noise + block[cut + len(noise) :]
    rest = whole[start + length - 2 :]
    (tmp_path / "b.jpg").write_bytes(whole[: start - 2] + (len(block) + 2).to_bytes(2, "big") + block + rest)
    assert sorted(load_image(tmp_path / "b.jpg", upright=True).shape) == [3, 8, 12]
    lens = read_lens(tmp_path / "b.jpg")
    assert isinstance(lens.model, str) and 0 <= lens.focal < np.inf and lens.focal_35 >= 0
    assert json.dumps(lens) == json.dumps(list(lens)), "it goes into a file"


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    for k in (2, 10, 1):
        photo(tmp_path / "in" / f"IMG_{k}.jpg", k)
    return tmp_path / "in"


def gathered(source: Path, place: SceneFolder, **knobs: object) -> State:
    state = State.load(place)
    gather_images(source, place, state, SfmConfig(**knobs), lambda *_: None)  # type: ignore[arg-type]
    return state


def names(place: SceneFolder) -> list[str]:
    return natural_order(
        [p.relative_to(place.images).as_posix() for p in place.images.rglob("*") if p.is_file()]
    )


def test_images_are_copied_as_they_are(photos: Path, tmp_path: Path) -> None:
    place = SceneFolder(tmp_path / "scene")
    state = gathered(photos, place)
    assert list(state.images) == names(place) == ["IMG_1.jpg", "IMG_2.jpg", "IMG_10.jpg"]
    for name, about in state.images.items():
        assert (place.images / name).read_bytes() == (photos / name).read_bytes()
        assert (about["width"], about["height"], about["lens"]) == (24, 16, ["", 0.0, 0])
    assert asdict(State.load(place)) == asdict(state), "it is on disk"


def test_what_cannot_be_used_is_dropped_with_its_reason(photos: Path, tmp_path: Path) -> None:
    (photos / "empty.jpg").write_bytes(b"")
    (photos / "text.png").write_text("hello")
    whole = (photos / "IMG_1.jpg").read_bytes()
    (photos / "half.jpg").write_bytes(whole[: len(whole) // 2])
    (photos / "notes.txt").write_text("not an image at all")
    photo(photos / ".hidden" / "x.jpg")
    lost = {"empty.jpg", "text.png", "half.jpg"}
    with contextlib.suppress(OSError):  # file systems that take UTF-8 alone
        (photos / "IMG_1.jpg").with_name(os.fsdecode(b"\xe9.jpg")).write_bytes(whole)
        lost.add("\\udce9.jpg")
    state = gathered(photos, SceneFolder(tmp_path / "scene"))
    assert len(state.images) == 3 and state.dropped.keys() == lost
    assert asdict(State.load(SceneFolder(tmp_path / "scene"))) == asdict(state)
    assert "truncated" in state.dropped["half.jpg"]
    told = f"{len(lost)} of {3 + len(lost)} files could not be decoded: empty.jpg (the file is empty), half.jpg ("
    assert lost_files(state).startswith(told)


def test_heic_becomes_jpeg_with_its_lens_or_says_what_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = tmp_path / "in"
    source.mkdir()
    for k in range(3):
        (source / f"IMG {k}.HEIC").write_bytes(HEIC)
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "pillow_heif", None)
        with pytest.raises(
            DataError,
            match=r"3 of 3 files could not .*: IMG 0\.HEIC, IMG 1\.HEIC, IMG 2\.HEIC \(is HEIC.*pip install pillow-heif",
        ):
            gathered(source, SceneFolder(tmp_path / "without"))
    pytest.importorskip("pillow_heif")
    for k in (1, 2):
        (source / f"IMG {k}.HEIC").unlink()
        photo(source / f"{k}.png", k)
    place = SceneFolder(tmp_path / "scene")
    state = gathered(source, place)
    assert names(place) == list(state.images) == ["1.png", "2.png", "IMG_0.HEIC.jpg"]
    told = state.images["IMG_0.HEIC.jpg"]
    assert (told["width"], told["height"], told["lens"]) == (48, 64, ["Phone 9", 0.0, 0])
    jpeg = place.images / "IMG_0.HEIC.jpg"
    assert np.array_equal(load_image(jpeg), load_image(jpeg, upright=True)), "it is upright already"
    assert abs(load_image(jpeg).astype(int) - load_image(source / "IMG 0.HEIC")).mean() < 3


def test_raw_photographs_become_jpegs_and_those_beside_a_jpeg_are_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = tmp_path / "in"
    source.mkdir()
    small = np.zeros((4, 6, 3), np.uint8)
    colours = np.array([[0.8, 0.3, 0.2], [0.2, 0.6, 0.3], [0.3, 0.3, 0.8], [0.7, 0.7, 0.2]])
    for k in range(4):
        flat = np.tile(colours[k], (40, 60, 1))
        (source / f"{k}.DNG").write_bytes(dng(flat, small, orientation=6))
    photo(source / "3.jpg", 1)
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "rawpy", None)
        with pytest.raises(
            DataError, match=r"3 of 4 files .*: 0\.DNG, .* \(is a raw photograph .*fprf\[raw\]"
        ):
            gathered(source, SceneFolder(tmp_path / "without"))
    pytest.importorskip("rawpy")
    place = SceneFolder(tmp_path / "scene")
    state = gathered(source, place)
    assert names(place) == list(state.images) == ["0.DNG.jpg", "1.DNG.jpg", "2.DNG.jpg", "3.jpg"]
    assert state.images["0.DNG.jpg"]["lens"] == ["test camera", 35.0, 52]
    for k in range(3):
        found = load_image(place.images / f"{k}.DNG.jpg")
        assert found.shape == (60, 40, 3)
        assert np.abs(found / 255 - colours[k]).max() < 0.02
    assert any("raw" in note and "3.DNG" in note for note in state.notes["left out"])


def test_what_colmap_does_not_read_becomes_jpeg_whatever_it_is_called(tmp_path: Path) -> None:
    source = tmp_path / "in"
    smooth = cv2.resize(NOISE, (48, 32), interpolation=cv2.INTER_CUBIC)
    source.mkdir()
    foreign = {"a.webp": "WEBP", "b.JPG": "WEBP", "c.avif": "AVIF", "d.png": "AVIF"}
    kinds = foreign | {"e.webp": "JPEG", "f.jpg": "PNG", "g.tif": "TIFF"}
    for k, (name, form) in enumerate(kinds.items()):
        image = Image.fromarray(np.roll(smooth, 8 * k, 1))
        (source / name).write_bytes(oriented(image, form, 6))
    place = SceneFolder(tmp_path / "scene")
    state = gathered(source, place)
    assert not state.dropped and lost_files(state) == ""
    assert list(state.images) == [f"{name}.jpg" if name in foreign else name for name in kinds]
    for name, about in state.images.items():
        kept = load_image(place.images / name)
        assert kept.shape[1::-1] == (about["width"], about["height"])
        if name in kinds:
            assert (place.images / name).read_bytes() == (source / name).read_bytes()
        else:  # upright, and nothing left that would turn it again
            assert (
                abs(kept.astype(int) - load_image(source / name.removesuffix(".jpg"), upright=True)).mean()
                < 3
            )
            assert np.array_equal(kept, load_image(place.images / name, upright=True)) and kept.shape == (
                48,
                32,
                3,
            )


def test_photographs_keep_their_positions(tmp_path: Path) -> None:
    source = tmp_path / "in"
    source.mkdir()
    for k, suffix in enumerate(("jpg", "webp", "tif")):
        with_lens(source / f"{k}.{suffix}", np.roll(NOISE, 8 * k, 1))
    place = SceneFolder(tmp_path / "scene")
    state = gathered(source, place)
    assert list(state.images) == ["0.jpg", "1.webp.jpg", "2.tif"]
    for name in state.images:
        assert read_position(place.images / name) == pytest.approx((-33.901, 18.4, 0.0))


def test_a_second_time_follows_what_has_changed(photos: Path, tmp_path: Path) -> None:
    place = SceneFolder(tmp_path / "scene")
    before = {name: (place.images / name).stat().st_mtime_ns for name in gathered(photos, place).images}
    photo(photos / "IMG_2.jpg", 99)
    photo(photos / "IMG_3.jpg", 3)
    (photos / "IMG_10.jpg").unlink()
    state = gathered(photos, place)
    assert list(state.images) == names(place) == ["IMG_1.jpg", "IMG_2.jpg", "IMG_3.jpg"]
    assert (place.images / "IMG_1.jpg").stat().st_mtime_ns == before["IMG_1.jpg"], (
        "what is the same is not copied again"
    )
    assert (place.images / "IMG_2.jpg").read_bytes() == (photos / "IMG_2.jpg").read_bytes()


def test_images_may_lie_in_the_scene_already(tmp_path: Path) -> None:
    place = SceneFolder(tmp_path / "scene")
    for k in range(4):
        photo(place.images / f"{k}.png", k)
    assert len(gathered(place.images, place).images) == 4
    (place.images / "3.png").unlink()
    assert len(gathered(place.images, place).images) == 3 and len(names(place)) == 3
    for k in range(3):
        photo(tmp_path / "photos" / f"#{k}.png", k)
    copied = gathered(tmp_path / "photos", SceneFolder(tmp_path / "copy"))
    assert list(copied.images) == ["_0.png", "_1.png", "_2.png"], "# begins a comment in lists of pairs"
    for name in ("a b.png", "#1.png"):
        photo(place.images / name, 7)
        with pytest.raises(UsageError, match="no blanks or leading #"):
            gathered(place.images, place)
        (place.images / name).unlink()


def test_a_video_gives_its_sharp_frames(tmp_path: Path) -> None:
    coarse = cv2.imread(str(photo(tmp_path / "a.png", size=(40, 30))))
    base = cv2.resize(coarse, (160, 120), interpolation=cv2.INTER_NEAREST)
    frames = [np.roll(base, 3 * k, 1) for k in range(12)]
    frames = [frame if k % 3 == 1 else cv2.GaussianBlur(frame, (0, 0), 3) for k, frame in enumerate(frames)]
    write_video(tmp_path / "clip.mp4", frames, 12, h264=False)
    place = SceneFolder(tmp_path / "scene")
    state = gathered(tmp_path / "clip.mp4", place, frames=4)
    assert names(place) == list(state.images) == [f"frame_{k:06d}.jpg" for k in (1, 4, 7, 10)]
    assert len(state.dropped) == 8 and state.dropped["frame 0"].startswith("less sharp than frame 1")
    stamp = (place.images / "frame_000004.jpg").stat().st_mtime_ns
    gathered(tmp_path / "clip.mp4", place, frames=4)
    assert (place.images / "frame_000004.jpg").stat().st_mtime_ns == stamp
    assert len(gathered(tmp_path / "clip.mp4", place, frames=6, blurred=0.0).images) == len(names(place)) == 6
    with pytest.raises(DataError, match="frame 99 was there before"):
        save_frames(tmp_path / "clip.mp4", [2, 99], SceneFolder(tmp_path / "out"), State(), lambda *_: None)
    # Another video in its place leaves nothing of the first.
    write_video(tmp_path / "clip.mp4", [np.full_like(base, 255)] * 9, 12, h264=False)
    for name in gathered(tmp_path / "clip.mp4", place, frames=4, blurred=0.0).images:
        assert load_image(place.images / name).min() > 240


@pytest.mark.parametrize("kind", ["copy", "webp", "video"])
def test_pictures_of_others_stay(photos: Path, tmp_path: Path, kind: str) -> None:
    place = SceneFolder(tmp_path / "scene")
    source = tmp_path / "clip.mp4" if kind == "video" else photos
    name = {"copy": "IMG_10.jpg", "webp": "a.webp.jpg", "video": "frame_000000.jpg"}[kind]
    write_video(tmp_path / "clip.mp4", [cv2.imread(str(photos / "IMG_1.jpg"))] * 3, 12, h264=False)
    Image.fromarray(NOISE).save(photos / "a.webp")
    (place.root / ".DS_Store").parent.mkdir()
    (place.root / ".DS_Store").touch()
    mine = photo(place.images / name, 99).read_bytes()
    with pytest.raises(UsageError, match=f"images/{name} is another picture; name a folder"):
        gathered(source, place)
    assert (place.images / name).read_bytes() == mine
    (place.images / name).unlink()
    gathered(source, place)
    (place.work / "state.json").unlink()  # as if it had been cut off
    assert name in gathered(source, place).images


def test_a_scene_inside_of_the_source_is_none_of_its_photographs(
    photos: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(photos)
    for _ in range(2):
        assert len(gathered(Path(), SceneFolder(Path("scenes/in"))).images) == 3
    with pytest.raises(UsageError, match="is the scene folder itself; give new/images"):
        gathered(Path("new"), SceneFolder(Path("new")))


def test_mistakes_are_named(photos: Path, tmp_path: Path) -> None:
    place = SceneFolder(tmp_path / "scene")
    for source in (tmp_path / "absent", photos / "IMG_1.jpg"):
        with pytest.raises(UsageError, match="neither a folder of images nor a video"):
            gathered(source, place)
    photo(tmp_path / "few" / "a.jpg")
    (tmp_path / "few" / "b.jpg").write_bytes(b"")
    with pytest.raises(
        DataError,
        match=r"1 of 2 files could not .*: b\.jpg \(the file is empty\); 1 usable images, at least 3",
    ):
        gathered(tmp_path / "few", place)
    (tmp_path / "few" / "no.mp4").write_bytes(b"nothing of the kind" * 100)
    with pytest.raises(DataError, match=r"no\.mp4: no video that can be opened"):
        gathered(tmp_path / "few" / "no.mp4", place)
    gathered(photos, place)
    with pytest.raises(UsageError, match=f"was begun with {photos}"):
        gathered(tmp_path / "few", place)
    with pytest.raises(UsageError, match="holds something else"):
        State.load(SceneFolder(tmp_path))
    (place.work / "state.json").write_text(json.dumps({"format": 1, "wrong": 3}))
    with pytest.raises(DataError, match=r"state\.json: cannot be read"):
        State.load(place)
    for knob, value in {
        "frames": 2,
        "blurred": 1.5,
        "features": 5,
        "side": 9,
        "overlap": 0,
        "threads": 0,
    }.items():
        with pytest.raises(ConfigError, match=knob):
            SfmConfig(**{knob: value})
