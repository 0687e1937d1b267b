import json
import sys
from dataclasses import asdict
from pathlib import Path

import cv2
import numpy as np
import pytest
from photo_files import HEIC

from fprf.datamanagers.images import load_image
from fprf.errors import ConfigError, DataError, UsageError
from fprf.io.video import write_video
from fprf.reconstruction.config import SfmConfig
from fprf.reconstruction.images import gather, in_order
from fprf.reconstruction.scene_folder import Place, State, key_of


def photo(path: Path, seed: int = 0, size: tuple[int, int] = (24, 16)) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.random.default_rng(seed).integers(0, 256, (size[1], size[0], 3), dtype=np.uint8))
    return path


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    for k in (2, 10, 1):
        photo(tmp_path / "in" / f"IMG_{k}.jpg", k)
    return tmp_path / "in"


def gathered(source: Path, place: Place, **knobs: object) -> State:
    state = State.load(place)
    gather(source, place, state, SfmConfig(**knobs), lambda *_: None)  # type: ignore[arg-type]
    return state


def names(place: Place) -> list[str]:
    return in_order([p.relative_to(place.images).as_posix() for p in place.images.rglob("*") if p.is_file()])


def test_numbers_are_in_peoples_order() -> None:
    assert in_order(["b1", "a10", "a2", "a", "10", "9"]) == ["9", "10", "a", "a2", "a10", "b1"]


def test_images_are_copied_as_they_are(photos: Path, tmp_path: Path) -> None:
    place = Place(tmp_path / "scene")
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
    state = gathered(photos, Place(tmp_path / "scene"))
    assert len(state.images) == 3
    assert state.dropped.keys() == {"empty.jpg", "text.png", "half.jpg"}
    assert state.dropped["half.jpg"] == "the JPEG is truncated (no end-of-image marker)"


def test_heic_becomes_jpeg_with_its_lens_or_says_what_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = tmp_path / "in"
    source.mkdir()
    for k in range(3):
        (source / f"IMG {k}.HEIC").write_bytes(HEIC)
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "pillow_heif", None)
        with pytest.raises(DataError, match=r"0 usable images.*IMG 0\.HEIC: is HEIC.*pip install 'fprf\[heic\]'"):
            gathered(source, Place(tmp_path / "without"))
    pytest.importorskip("pillow_heif")
    place = Place(tmp_path / "scene")
    state = gathered(source, place)
    assert names(place) == list(state.images) == [f"IMG_{k}.HEIC.jpg" for k in range(3)]
    assert state.images["IMG_0.HEIC.jpg"] | {"sha256": ""} == {
        "sha256": "",
        "width": 48,
        "height": 64,
        "lens": ["Phone 9", 0.0, 0],
    }
    jpeg = place.images / "IMG_0.HEIC.jpg"
    assert np.array_equal(load_image(jpeg), load_image(jpeg, upright=True)), "it is upright already"
    assert abs(load_image(jpeg).astype(int) - load_image(source / "IMG 0.HEIC")).mean() < 3


def test_a_folder_of_other_files_is_told_by_what_it_holds(tmp_path: Path) -> None:
    for name in ("a.dng", "b.DNG", "c.txt"):
        (tmp_path / name).write_bytes(b"x")
    with pytest.raises(DataError, match=r"0 usable images.*holds \.dng \.txt files.*convert"):
        gathered(tmp_path, Place(tmp_path / "scene"))


def test_folders_below_and_blanks_in_names(photos: Path, tmp_path: Path) -> None:
    photo(photos / "left side" / "a b.jpg", 5)
    place = Place(tmp_path / "scene")
    assert "left_side/a_b.jpg" in gathered(photos, place).images and "left_side/a_b.jpg" in names(place)
    photo(photos / "left_side" / "a_b.jpg", 6)
    with pytest.raises(UsageError, match="so that no other is called left_side/a_b"):
        gathered(photos, place)


def test_a_second_time_follows_what_has_changed(photos: Path, tmp_path: Path) -> None:
    place = Place(tmp_path / "scene")
    before = {name: (place.images / name).stat().st_mtime_ns for name in gathered(photos, place).images}
    photo(photos / "IMG_2.jpg", 99)
    photo(photos / "IMG_3.jpg", 3)
    (photos / "IMG_10.jpg").unlink()
    state = gathered(photos, place)
    assert list(state.images) == names(place) == ["IMG_1.jpg", "IMG_2.jpg", "IMG_3.jpg"]
    assert (place.images / "IMG_1.jpg").stat().st_mtime_ns == before["IMG_1.jpg"], "what is the same is not copied again"
    assert (place.images / "IMG_2.jpg").read_bytes() == (photos / "IMG_2.jpg").read_bytes()


def test_images_may_lie_in_the_scene_already(tmp_path: Path) -> None:
    place = Place(tmp_path / "scene")
    for k in range(4):
        photo(place.images / f"{k}.png", k)
    assert len(gathered(place.images, place).images) == 4
    (place.images / "3.png").unlink()
    assert len(gathered(place.images, place).images) == 3 and len(names(place)) == 3
    photo(place.images / "a b.png")
    with pytest.raises(UsageError, match="no blanks"):
        gathered(place.images, place)


def test_a_video_gives_its_sharp_frames(tmp_path: Path) -> None:
    drawn = np.random.default_rng(0)
    base = cv2.resize(drawn.integers(0, 256, (30, 40, 3), dtype=np.uint8), (160, 120), interpolation=cv2.INTER_NEAREST)
    frames = [np.roll(base, 3 * k, 1) for k in range(12)]
    frames = [frame if k % 3 == 1 else cv2.GaussianBlur(frame, (0, 0), 3) for k, frame in enumerate(frames)]
    write_video(tmp_path / "clip.mp4", frames, 12, h264=False)
    place = Place(tmp_path / "scene")
    state = gathered(tmp_path / "clip.mp4", place, frames=4)
    assert names(place) == list(state.images) == [f"frame_{k:06d}.jpg" for k in (1, 4, 7, 10)]
    assert len(state.dropped) == 8 and state.dropped["frame 0"].startswith("less sharp than frame 1")
    stamp = (place.images / "frame_000004.jpg").stat().st_mtime_ns
    gathered(tmp_path / "clip.mp4", place, frames=4)
    assert (place.images / "frame_000004.jpg").stat().st_mtime_ns == stamp
    assert len(gathered(tmp_path / "clip.mp4", place, frames=6, blurred=0.0).images) == len(names(place)) == 6


def test_mistakes_are_named(photos: Path, tmp_path: Path) -> None:
    place = Place(tmp_path / "scene")
    with pytest.raises(UsageError, match="neither a folder of images nor a video"):
        gathered(tmp_path / "absent", place)
    with pytest.raises(UsageError, match="neither a folder of images nor a video"):
        gathered(photos / "IMG_1.jpg", place)
    (tmp_path / "few").mkdir()
    photo(tmp_path / "few" / "a.jpg")
    (tmp_path / "few" / "b.jpg").write_bytes(b"")
    with pytest.raises(DataError, match=r"1 usable images, at least 3 are needed; b\.jpg: the file is empty"):
        gathered(tmp_path / "few", place)
    gathered(photos, place)
    (tmp_path / "other").mkdir()
    with pytest.raises(UsageError, match=f"was begun with {photos}"):
        gathered(tmp_path / "other", place)
    with pytest.raises(UsageError, match="holds something else"):
        State.load(Place(tmp_path))
    (place.work / "state.json").write_text(json.dumps({"format": 1, "wrong": 3}))
    with pytest.raises(DataError, match=r"state\.json: cannot be read"):
        State.load(place)
    for knob, value in {"frames": 2, "blurred": 1.5, "features": 5, "side": 9, "overlap": 0, "threads": 0}.items():
        with pytest.raises(ConfigError, match=knob):
            SfmConfig(**{knob: value})


def test_keys_differ_where_anything_does() -> None:
    assert key_of("a", 1, {"x": 2, "y": 3}) == key_of("a", 1, {"y": 3, "x": 2})
    assert len({key_of("a"), key_of("b"), key_of("a", "b"), key_of(["a", "b"]), key_of("a", 0), key_of("a", False)}) == 6
