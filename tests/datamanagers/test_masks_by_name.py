"""Masks are found by the names that people and programs give them, and what does not fit is said."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from capture_files import (
    Capture,
    write_colmap,
    write_llff,
    write_meganerf,
    write_odm,
    write_polycam,
    write_transforms,
)

from fprf.datamanagers.images import load_mask
from fprf.datamanagers.masks import masks_in
from fprf.datamanagers.parsers.config import parse_scene

COUNT = 3


def write_masks(folder: Path, template: str, stems: list[str], suffix: str = ".png") -> None:
    """Masks of 24 x 16 pixels; the k-th has k + 1 white columns."""
    for k, stem in enumerate(stems):
        path = folder / template.format(stem=stem, name=f"{stem}{suffix}", upper=stem.upper())
        path.parent.mkdir(parents=True, exist_ok=True)
        mask = np.zeros((16, 24), np.uint8)
        mask[:, : k + 1] = 255
        assert cv2.imwrite(str(path), mask)


def white_columns(path: Path | None) -> int:
    assert path is not None
    return int(load_mask(path)[0].sum())


TEMPLATES = [
    "masks/{name}.png", "masks/{stem}.png", "masks/{name}", "masks/{stem}_mask.png", "masks/mask_{stem}.png",
    "masks/{stem}.mask.png", "masks/{stem}.png.png", "masks/{stem}_0_mask_0.png", "mask/{stem}.png", "Masks/{stem}.png",
    "MASK/{stem}_Mask.PNG", "masks/{upper}.PNG", "masks_2/{stem}.png", "masks/{stem}-mask.jpg", "masks/{stem} mask.png",
    "masks/{stem}_seg.png", "masks/{stem}.bmp", "masks/{name}_mask.png", "masks/{name}.mask.png", "masks/{stem}_mask_1.png",
    "masks/Mask-{stem}.webp", "masks/{stem}_people_mask.png", "images/{stem}_mask.png", "images/masks/{stem}.png",
    "masks/images/{stem}.png", "masks/{stem}.TIF",
]  # fmt: skip


@pytest.mark.parametrize("template", TEMPLATES)
def test_masks_of_any_known_name_are_used(tmp_path: Path, template: str) -> None:
    names = tuple(f"shot_{k:04d}.png" for k in range(COUNT))
    own = Capture.make(COUNT)
    write_transforms(tmp_path, Capture(names, own.poses, own.points))
    write_masks(tmp_path, template, [Path(name).stem for name in names])
    scene = parse_scene(tmp_path, 1, None)
    assert [white_columns(path) for path in scene.masks] == [1, 2, 3]
    assert not any("mask" in note for note in scene.notes)


@pytest.mark.parametrize("template", ["masks/{stem}.png", "masks/mask_{stem}.png", "masks/{stem}_mask.png"])
@pytest.mark.parametrize("word", ["frame_", "IMG_", "rgb_", "image-"])
def test_a_number_tells_a_mask_where_the_image_has_a_camera_s_word(
    tmp_path: Path, template: str, word: str
) -> None:
    numbers = [f"{k:05d}" for k in range(COUNT)]
    own = Capture.make(COUNT)
    write_transforms(tmp_path, Capture(tuple(f"{word}{n}.png" for n in numbers), own.poses, own.points))
    write_masks(tmp_path, template, numbers)
    assert [white_columns(path) for path in parse_scene(tmp_path, 1, None).masks] == [1, 2, 3]


WRITERS: dict[str, tuple[Callable[[Path, Capture], object], str]] = {
    "transforms": (write_transforms, ""),
    "colmap": (write_colmap, ""),
    "llff": (write_llff, ""),
    "odm": (write_odm, ""),
    "polycam": (write_polycam, ""),
    "meganerf": (write_meganerf, "train/"),
}


@pytest.mark.parametrize("format_name", WRITERS)
def test_every_format_of_scenes_has_the_rule(tmp_path: Path, format_name: str) -> None:
    capture = Capture.make(10)
    writer, part = WRITERS[format_name]
    writer(tmp_path, capture)
    for folder in {part, part.replace("train", "val")}:
        write_masks(tmp_path / folder, "Mask/{stem}_mask.png", [Path(name).stem for name in capture.names])
    scene = parse_scene(tmp_path, 1, None)
    assert [white_columns(path) for path in scene.masks] == [int(path.stem) + 1 for path in scene.paths]


def test_sky_has_the_same_rule_and_is_no_mask(tmp_path: Path) -> None:
    capture = Capture.make(COUNT)
    write_transforms(tmp_path, capture)
    stems = [Path(name).stem for name in capture.names]
    write_masks(tmp_path, "Sky_Mask/sky_{stem}.png", stems)
    scene = parse_scene(tmp_path, 1, None)
    assert [white_columns(path) for path in scene.sky_masks] == [1, 2, 3] and not scene.masks


def test_cameras_have_folders_of_their_own(tmp_path: Path) -> None:
    own = Capture.make(4)
    names = ("left/0.png", "left/1.png", "right/0.png", "right/1.png")
    write_transforms(tmp_path, Capture(names, own.poses, own.points))
    write_masks(tmp_path / "masks", "{stem}_mask.png", ["left/0", "left/1", "right/0", "right/1"])
    assert [white_columns(path) for path in parse_scene(tmp_path, 1, None).masks] == [1, 2, 3, 4]


def test_a_mask_that_may_be_of_two_is_of_none(tmp_path: Path) -> None:
    own = Capture.make(2)
    write_transforms(tmp_path, Capture(("left/0.png", "right/0.png"), own.poses, own.points))
    write_masks(tmp_path / "masks", "{stem}.png", ["0"])
    scene = parse_scene(tmp_path, 1, None)
    assert not scene.masks and sum("masks" in note for note in scene.notes) == 1


def test_what_does_not_fit_is_one_line_with_examples(tmp_path: Path) -> None:
    write_transforms(tmp_path, Capture.make(COUNT))
    write_masks(tmp_path, "masks/person{stem}x.png", ["0", "1"])
    scene = parse_scene(tmp_path, 1, None)
    assert not scene.masks
    (note,) = (note for note in scene.notes if "mask" in note)
    assert "none of its 2 images" in note and "person0x.png" in note and "0000.png" in note
    write_masks(tmp_path, "masks/{stem}.png", ["0000", "0002"])
    scene = parse_scene(tmp_path, 1, None)
    assert [path is None for path in scene.masks] == [False, True, False]
    (note,) = (note for note in scene.notes if "mask" in note)
    assert (
        "1 of 3 images" in note and "0001.png" in note and "2 of 4 files" in note and "person0x.png" in note
    )


def test_masks_of_some_frames_alone_are_said(tmp_path: Path) -> None:
    content = write_transforms(tmp_path, Capture.make(COUNT))
    write_masks(tmp_path, "covers/{stem}.png", ["a"])
    content["frames"][1]["mask_path"] = "covers/a.png"  # type: ignore[index]
    import json

    (tmp_path / "transforms.json").write_text(json.dumps(content))
    scene = parse_scene(tmp_path, 1, None)
    assert [path is not None for path in scene.masks] == [False, True, False]
    assert any("2 of 3 images" in note and "0000.png" in note for note in scene.notes)


def test_masks_of_references_lie_in_any_folder(tmp_path: Path) -> None:
    photographs = [tmp_path / "photos" / "a.jpg", tmp_path / "others" / "b.jpg"]
    write_masks(tmp_path / "covers", "{stem}_mask.png", ["a", "b"])
    assert [white_columns(path) for path in masks_in(tmp_path / "covers", photographs).masks] == [1, 2]


def test_used_pixels_are_those_of_the_masks(tmp_path: Path) -> None:
    capture = Capture.make(COUNT)
    write_colmap(tmp_path, capture)
    write_masks(tmp_path, "masks/{stem}_mask.png", [Path(name).stem for name in capture.names])
    scene = parse_scene(tmp_path, 1, None)
    used = [torch.from_numpy(load_mask(path, (24, 16))) for path in scene.masks if path is not None]
    assert [int(mask.sum()) for mask in used] == [16, 32, 48]
