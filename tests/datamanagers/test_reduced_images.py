"""Cameras are scaled where all images are reduced by one factor; else the images that differ are named."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from capture_files import (
    Capture,
    write_colmap,
    write_image,
    write_llff,
    write_odm,
    write_polycam,
    write_record3d,
    write_transforms,
)

from fprf.datamanagers.images import load_images
from fprf.datamanagers.parsers.config import parse_scene
from fprf.errors import DataError

FULL = (1280, 961)
COUNT = 5


def reduced(size: tuple[int, int], factor: float, up: bool = False) -> tuple[int, int]:
    """The size at 1/factor, each side rounded down or up."""
    rounded = np.ceil if up else np.floor
    return int(rounded(size[0] / factor)), int(rounded(size[1] / factor))


def rewrite(folder: Path, size: tuple[int, int]) -> None:
    for seed, path in enumerate(sorted(folder.glob("*.png"))):
        write_image(path, size, seed=seed)


WRITERS: dict[str, tuple[Callable[[Path, Capture], object], str]] = {
    "transforms": (write_transforms, "images"),
    "colmap": (write_colmap, "images"),
    "llff": (write_llff, "images"),
    "odm": (write_odm, "images"),
    "polycam": (write_polycam, "images"),
    "record3d": (write_record3d, "rgb"),
}


@pytest.mark.parametrize("format_name", WRITERS)
@pytest.mark.parametrize(("factor", "up"), [(4, False), (4, True), (2.5, False), (8, True)])
def test_every_format_scales_its_cameras(tmp_path: Path, format_name: str, factor: float, up: bool) -> None:
    writer, folder = WRITERS[format_name]
    capture = Capture.make(COUNT, size=FULL, focal=(1200.0, 1200.0))
    writer(tmp_path, capture)
    size = reduced(FULL, factor, up)
    rewrite(tmp_path / folder, size)
    scene = parse_scene(tmp_path, 1, None)
    assert scene.cameras.size.tolist() == [list(size)] * COUNT
    assert np.allclose(scene.cameras.focal.numpy(), 1200 / factor, rtol=0.01)
    assert np.allclose(scene.cameras.centre.numpy(), np.array(size) / 2)
    if format_name != "odm":  # whose cameras have no pixels
        assert sum("1280x961" in note for note in scene.notes) == 1


@pytest.mark.parametrize("format_name", ["transforms", "colmap", "llff", "odm"])
def test_reduced_copies_are_read_where_the_images_are_not_there(tmp_path: Path, format_name: str) -> None:
    """As data sets are downloaded: poses of the full size, and images_4 alone."""
    capture = Capture.make(COUNT, size=(96, 64), focal=(80.0, 80.0))
    WRITERS[format_name][0](tmp_path, capture)
    rewrite(tmp_path / "images", (24, 16))
    (tmp_path / "images").rename(tmp_path / "images_4")
    for factor in (8, 16):
        for name in capture.names:
            write_image(tmp_path / f"images_{factor}" / name, (96 // factor, 64 // factor))
    scene = parse_scene(tmp_path, 1, None)
    assert {path.parent.name for path in scene.paths} == {"images_4"}
    assert scene.cameras.focal[0].tolist() == pytest.approx([20.0, 20.0])
    assert np.array_equal(load_images(scene)[2][:, :, ::-1], write_image(tmp_path / "again.png", seed=2))


def test_intrinsics_without_a_size_belong_to_the_images_that_are_named(tmp_path: Path) -> None:
    content = write_transforms(tmp_path, Capture.make(COUNT, size=(96, 64), focal=(80.0, 80.0)))
    for key in ("w", "h"):
        del content[key]
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    rewrite(tmp_path / "images", (24, 16))
    (tmp_path / "images").rename(tmp_path / "images_4")
    cameras = parse_scene(tmp_path, 1, None).cameras
    assert cameras.focal[0].tolist() == [20.0, 20.0] and cameras.centre[0].tolist() == [12.0, 8.0]


@pytest.mark.parametrize(
    ("sizes", "named"),
    [
        ([(24, 16)] * 4 + [(48, 32)], "0004.png"),
        ([(96, 64)] * 4 + [(48, 32)], "0004.png"),
        ([(24, 16), (16, 24), (24, 16), (24, 16), (24, 16)], "0001.png"),
        ([(24, 24)] * 5, "0000.png"),
        ([(95, 64)] * 5, "0000.png"),
    ],
)
def test_images_that_differ_are_named(tmp_path: Path, sizes: list[tuple[int, int]], named: str) -> None:
    capture = Capture.make(COUNT, size=(96, 64))
    write_transforms(tmp_path, capture)
    for seed, (name, size) in enumerate(zip(capture.names, sizes, strict=True)):
        write_image(tmp_path / "images" / name, size, seed=seed)
    width, height = sizes[capture.names.index(named)]
    with pytest.raises(
        DataError, match=rf"{named}: {width}x{height} pixels, but its camera has 96x64"
    ) as told:
        parse_scene(tmp_path, 1, None)
    assert ("4 more" in str(told.value)) == (len(set(sizes)) == 1)


def test_images_of_several_sizes_have_one_factor(tmp_path: Path) -> None:
    content = write_transforms(tmp_path, Capture.make(COUNT, size=(96, 64)), per_frame=True)
    for k, frame in enumerate(content["frames"]):  # type: ignore[arg-type, var-annotated]
        wide, tall = (97 + 10 * k, 65) if k % 2 else (65, 99 + 7 * k)
        frame |= {"w": wide, "h": tall, "cx": wide / 2, "cy": tall / 2}
        write_image(tmp_path / frame["file_path"], (round(wide / 3), round(tall / 3)), seed=k)
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    cameras = parse_scene(tmp_path, 1, None).cameras
    assert np.allclose(cameras.focal.numpy(), 20 / 3, rtol=0.03)
    assert np.allclose(cameras.centre.numpy(), cameras.size.numpy() / 2)
