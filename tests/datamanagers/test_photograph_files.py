"""What of a folder are photographs: not thumbnails, reduced copies, maps, masks, hidden files, copies."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from capture_files import Capture, write_colmap, write_image, write_llff, write_record3d, write_transforms

from fprf.datamanagers.parsers.config import parse_scene
from fprf.datamanagers.photograph_files import equal_pictures, find_photographs

SIZE = (48, 32)


def picture(k: int, size: tuple[int, int] = SIZE) -> np.ndarray:
    """A smooth picture, so that a reduced copy of it looks like it."""
    draw = np.random.default_rng(k).integers(0, 256, (4, 6, 3), dtype=np.uint8)
    return np.asarray(cv2.resize(draw, size, interpolation=cv2.INTER_CUBIC), dtype=np.uint8)


def save(path: Path, pixels: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), pixels)
    return path


def photographs(folder: Path, count: int = 4, suffix: str = ".png") -> list[str]:
    """Pictures in a folder; their names."""
    names = [f"IMG_{k:04d}{suffix}" for k in range(count)]
    for k, name in enumerate(names):
        save(folder / name, picture(k))
    return names


def kept(folder: Path) -> list[str]:
    return [path.relative_to(folder).as_posix() for path in find_photographs(folder).files]


FOLDERS = [
    "@eaDir/IMG_0000.png", ".thumbnails", "Thumbs", "thumbnails", "thumb", "previews", "depth", "Depths", "depth_maps",
    "mono_depth", "masks", "Mask", "sky_masks", "masks_4", "normals", "normal", "segmentation", "disparity", "sparse/0",
    "__MACOSX", "#recycle", "$RECYCLE.BIN", ".hidden", "stereo/depth_maps",
]  # fmt: skip


@pytest.mark.parametrize("inner", FOLDERS)
def test_folders_of_other_pictures_are_left_out_and_named(tmp_path: Path, inner: str) -> None:
    names = photographs(tmp_path)
    for k in range(3):
        save(tmp_path / inner / f"IMG_{k:04d}.png", picture(9 + k))
    assert kept(tmp_path) == names
    notes = find_photographs(tmp_path).notes()
    assert len(notes) == 1 and "3 " in notes[0] and f"{inner}/IMG_0000.png" in notes[0]


@pytest.mark.parametrize(
    "inner", ["day 2", "garden_2", "images_2", "mask shop", "left", "normal_photos", "alpha", "small"]
)
def test_folders_of_other_photographs_are_kept(tmp_path: Path, inner: str) -> None:
    photographs(tmp_path / "images")
    for k in range(3):  # of the same names and half the size, but another place
        save(tmp_path / inner / f"IMG_{k:04d}.png", picture(9 + k, (24, 16)))
    assert len(kept(tmp_path)) == 7 and not find_photographs(tmp_path).left_out


@pytest.mark.parametrize("inner", ["images_2", "images_4", "small", "web/resized"])
@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_reduced_copies_are_told_by_name_shape_and_look(tmp_path: Path, inner: str, suffix: str) -> None:
    names = photographs(tmp_path / "images")
    for k in range(4):
        small = cv2.resize(picture(k), (23, 16), interpolation=cv2.INTER_AREA)
        save(tmp_path / inner / f"IMG_{k:04d}{suffix}", small)
    assert kept(tmp_path) == [f"images/{name}" for name in names]
    assert list(find_photographs(tmp_path).left_out.values()) == [
        [f"{inner}/IMG_{k:04d}{suffix}" for k in range(4)]
    ]


def test_the_least_reduced_stay_where_there_is_no_more(tmp_path: Path) -> None:
    for factor in (2, 4, 8):
        for k in range(3):
            size = (240 // factor, 160 // factor)
            save(tmp_path / f"images_{factor}" / f"{k}.png", picture(k, size))
    assert kept(tmp_path) == ["images_2/0.png", "images_2/1.png", "images_2/2.png"]


BESIDE = [
    "IMG_0000_mask.png", "mask_IMG_0000.png", "IMG_0000.mask.png", "IMG_0000_0_mask_0.png", "IMG_0000_depth.png",
    "img_0000_depth_0001.png", "IMG_0000.png.mask.png", "IMG_0000_normal.png", "._IMG_0000.png",
]  # fmt: skip


@pytest.mark.parametrize("name", BESIDE)
def test_masks_and_maps_beside_their_photographs_are_none(tmp_path: Path, name: str) -> None:
    names = photographs(tmp_path)
    save(tmp_path / name, picture(9))
    assert kept(tmp_path) == names and name in find_photographs(tmp_path).notes()[0]


def test_thumbnails_beside_their_photographs_are_smaller(tmp_path: Path) -> None:
    names = photographs(tmp_path)
    save(tmp_path / "IMG_0001_thumb.png", picture(1, (24, 16)))
    save(tmp_path / "IMG_0001-24x16.png", picture(1, (24, 16)))
    assert kept(tmp_path) == names
    save(tmp_path / "IMG_0001_thumb.png", picture(7))
    assert kept(tmp_path) == sorted([*names, "IMG_0001_thumb.png"]), "of the full size it is a photograph"


def test_a_folder_that_is_given_counts_by_its_content(tmp_path: Path) -> None:
    names = photographs(tmp_path / "masks")
    assert kept(tmp_path / "masks") == names


def test_copies_are_told_by_their_pixels_in_any_encoding(tmp_path: Path) -> None:
    photographs(tmp_path)
    for name in ("IMG_0000 (1).png", "IMG_0001 - Copy.png", "Copy of IMG_0002.png", "other.png"):
        shutil.copy(
            tmp_path / f"IMG_000{'0' if name[0] == 'o' else name.split('IMG_000')[1][0]}.png", tmp_path / name
        )
    save(tmp_path / "IMG_0003 copy 2.bmp", picture(3))
    changed = picture(3)
    changed[5, 7] ^= 1
    save(tmp_path / "IMG_0003 (1).png", changed)
    files = find_photographs(tmp_path).files
    found = {copy.name: original.name for copy, original in equal_pictures(files).items()}
    assert found == {
        "IMG_0000 (1).png": "other.png" if len("other.png") < len("IMG_0000.png") else "IMG_0000.png",
        "IMG_0000.png": "other.png",
        "IMG_0001 - Copy.png": "IMG_0001.png",
        "Copy of IMG_0002.png": "IMG_0002.png",
        "IMG_0003 copy 2.bmp": "IMG_0003.png",
    }


def twice(folder: Path, name: str, *, moved: float = 0.0, changed: bool = False) -> Path:
    """A scene whose first image occurs a second time."""
    write_transforms(folder, Capture.make(9))
    import json

    file = folder / "transforms.json"
    content = json.loads(file.read_text())
    again = json.loads(json.dumps(content["frames"][3]))
    again["file_path"] = f"images/{name}"
    again["transform_matrix"][0][3] += moved
    content["frames"].append(again)
    file.write_text(json.dumps(content))
    (folder / "points.npz").unlink()
    pixels = cv2.imread(str(folder / "images" / "0003.png"))
    if changed:
        pixels[0, 0] ^= 1
    save(folder / "images" / name, pixels)
    return folder


@pytest.mark.parametrize(
    "name", ["0003 (1).png", "0003 - Copy.png", "copy of 0003.bmp", "a/0003.png", "z.png"]
)
def test_a_photograph_with_one_camera_trains_once(tmp_path: Path, name: str) -> None:
    scene = parse_scene(twice(tmp_path, name), 1, None)
    assert len(scene.paths) == 9 and len(scene.train) + len(scene.test) == 9
    original = min("0003.png", name, key=lambda each: (len(each), each))
    assert original in [path.relative_to(tmp_path / "images").as_posix() for path in scene.paths]
    assert sum("copies of other photographs" in note for note in scene.notes) == 1


@pytest.mark.parametrize("fields", [{"moved": 0.3}, {"changed": True}])
def test_what_differs_trains_as_well(tmp_path: Path, fields: dict[str, float]) -> None:
    scene = parse_scene(twice(tmp_path, "0003 (1).png", **fields), 1, None)  # type: ignore[arg-type]
    assert len(scene.paths) == 10 and not any("copies" in note for note in scene.notes)


def test_a_view_for_testing_stays_before_its_copy_for_training(tmp_path: Path) -> None:
    import json

    file = twice(tmp_path, "0003 (1).png") / "transforms.json"
    content = json.loads(file.read_text())
    content["test_filenames"] = ["images/0003 (1).png", "images/0005.png"]
    file.write_text(json.dumps(content))
    scene = parse_scene(tmp_path, 1, None)
    assert {scene.paths[k].name for k in scene.test.tolist()} == {"0003 (1).png", "0005.png"}
    assert len(scene.paths) == 9 and "0003.png" not in {path.name for path in scene.paths}


def test_pairs_of_views_and_points_follow(tmp_path: Path) -> None:
    capture = Capture.make(9)
    poses = capture.poses.copy()
    poses[4] = poses[2]
    write_colmap(tmp_path, Capture(capture.names, poses, capture.points))
    shutil.copy(tmp_path / "images/0002.png", tmp_path / "images/0004.png")
    scene = parse_scene(tmp_path, 1, None)
    assert len(scene.paths) == 8 and scene.seen is not None
    assert torch.equal(scene.seen[:, 0].unique(), torch.arange(8)) and len(scene.seen) == 8 * 40


@pytest.mark.parametrize("name", ["0004 (1).png", "0004 - Copy.png", "Copy of 0004.png", "0004_mask.png"])
def test_rows_of_llff_are_of_photographs_alone(tmp_path: Path, name: str) -> None:
    capture = Capture.make(9)
    write_llff(tmp_path, capture)
    shutil.copy(tmp_path / "images/0004.png", tmp_path / "images" / name)
    scene = parse_scene(tmp_path, 1, None)
    assert [path.name for path in scene.paths] == list(capture.names)
    assert np.allclose(scene.cameras.pose.numpy(), capture.poses) and any(
        name in note for note in scene.notes
    )


def test_files_beside_a_recording_are_named(tmp_path: Path) -> None:
    write_record3d(tmp_path, Capture.make(3))
    write_image(tmp_path / "rgb/1 (1).png")
    write_image(tmp_path / "rgb/._1.png")
    scene = parse_scene(tmp_path, 1, None)
    assert len(scene.paths) == 3 and sum("left out: 1 " in note for note in scene.notes) == 2
