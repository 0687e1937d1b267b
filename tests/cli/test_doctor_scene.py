"""What `fprf doctor` finds in a scene: each is there where it was put, and is not said of a scene without it."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image, ImageCms

from fprf.cli.doctor_scene import scene_folder
from fprf.cli.findings import Finding

VIEWS = 12


def write_scene(folder: Path, centre: tuple[float, ...] = (0, 0, 0), points: tuple[float, ...] = (0, 0, 0)) -> Path:
    """Views in a row before a wall of coloured points, as transforms.json with points.npz and with pictures of a texture."""
    draw = np.random.default_rng(0)
    texture = cv2.resize(draw.integers(40, 216, (48, 160, 3), dtype=np.uint8), None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
    frames = []
    (folder / "images").mkdir(parents=True)
    for k in range(VIEWS):
        pose = np.eye(4)
        pose[:3, 3] = np.array([0.1 * k, 0, 0]) + centre
        frames.append({"file_path": f"images/{k:02d}.png", "transform_matrix": pose.tolist()})
        Image.fromarray(texture[:, 8 * k : 8 * k + 96]).save(folder / f"images/{k:02d}.png")
    wall = draw.uniform((-1, -1, -2.001), (2, 1, -2), (400, 3)) + centre + np.array(points)
    np.savez(folder / "points.npz", xyz=wall)
    content = {"w": 96, "h": 96, "fl_x": 160.0, "fl_y": 160.0, "cx": 48.0, "cy": 48.0, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def findings(folder: Path) -> dict[str, Finding]:
    return {finding.what: finding for finding in scene_folder(folder)}


def test_a_scene_without_faults_has_none(tmp_path: Path) -> None:
    found = findings(write_scene(tmp_path / "s"))
    assert set(found) == {"format", "views", "split", "points", "exposure", "next"}
    assert not any(finding.remedy for finding in found.values())
    assert found["points"].found.startswith("400 ") and "10 of 10" in found["points"].found


def test_what_was_left_out_is_told(tmp_path: Path) -> None:
    folder = write_scene(tmp_path / "s")
    content = json.loads((folder / "transforms.json").read_text())
    content["frames"][3]["fl_x"] = np.nan
    (folder / "transforms.json").write_text(json.dumps(content))
    found = findings(folder)
    assert "1 of 12" in found["note"].found and found["views"].found.startswith("11 ")
    (folder / "points.npz").unlink()
    (folder / "sparse_pc.ply").touch()
    assert "sparse_pc.ply" in findings(folder)["points"].found and findings(folder)["points"].optional


def test_coordinates_beyond_float32_are_told_with_their_centre(tmp_path: Path) -> None:
    found = findings(write_scene(tmp_path / "s", centre=(500_000, 0, 5_600_000)))
    assert "(500000, 0, 5600000)" in found["coordinates"].found
    assert "10 of 10" in found["points"].found


def test_points_that_no_view_sees_and_few_points_are_told(tmp_path: Path) -> None:
    folder = write_scene(tmp_path / "s", points=(0, 0, 50))
    assert "0 of 10" in findings(folder)["points"].found and findings(folder)["points"].optional
    np.savez(folder / "points.npz", xyz=np.array([[0.5, 0, -2]] * 20))
    assert "too few" in findings(folder)["points"].found
    (folder / "points.npz").unlink()
    assert findings(folder)["points"].found.startswith("none")


@pytest.mark.parametrize(("value", "wrong"), [(0, True), (255, True), (128, False)])
def test_masks_that_say_nothing_are_told(tmp_path: Path, value: int, wrong: bool) -> None:
    folder = write_scene(tmp_path / "s")
    (folder / "masks").mkdir()
    for k in range(VIEWS):
        mask = np.full((96, 96), 0 if value == 128 else value, np.uint8)
        mask[:48] = 255 if value == 128 else value
        Image.fromarray(mask).save(folder / f"masks/{k:02d}.png")
    mask = findings(folder)["masks"]
    assert bool(mask.remedy) == wrong and f"{round(value / 255 * 100)} %" in mask.found.replace("50.2", "50")
    assert mask.optional == (value == 255)


def edit(folder: Path, k: int, change: Callable[[Image.Image, Path], None]) -> None:
    path = folder / f"images/{k:02d}.png"
    with Image.open(path) as image:
        image.load()
    change(image, path)


def test_profiles_and_orientations_are_told(tmp_path: Path) -> None:
    folder = write_scene(tmp_path / "s")
    lab, srgb = (ImageCms.ImageCmsProfile(ImageCms.createProfile(name)).tobytes() for name in ("XYZ", "sRGB"))
    exif = Image.Exif()
    exif[0x0112] = 6
    edit(folder, 0, lambda image, path: image.save(path, icc_profile=srgb))
    assert "profiles" not in findings(folder)
    edit(folder, 0, lambda image, path: image.save(path, icc_profile=lab))
    edit(folder, 1, lambda image, path: image.save(path, exif=exif))
    found = findings(folder)
    assert "XYZ" in found["profiles"].found and "(1) of 12" in found["profiles"].found
    assert found["orientation"].found.startswith("1 of 12")


def test_duplicates_are_told(tmp_path: Path) -> None:
    folder = write_scene(tmp_path / "s")
    (folder / "images/05.png").write_bytes((folder / "images/03.png").read_bytes())
    found = findings(folder)["duplicates"]
    assert found.found.startswith("1 of 12 views: 03.png and 05.png are the same file")
    folder = write_scene(tmp_path / "t")
    content = json.loads((folder / "transforms.json").read_text())
    content["frames"][7]["transform_matrix"] = content["frames"][2]["transform_matrix"]
    (folder / "transforms.json").write_text(json.dumps(content))
    found = findings(folder)["duplicates"]
    assert "02.png and 07.png" in found.found and "pose" in found.found


def test_blurred_and_damaged_images_are_named(tmp_path: Path) -> None:
    folder = write_scene(tmp_path / "s")

    def blur(image: Image.Image, path: Path) -> None:
        Image.fromarray(cv2.GaussianBlur(np.asarray(image), (0, 0), 3)).save(path)

    edit(folder, 4, blur)
    assert findings(folder)["blur"].found.startswith("1 of 12 images: 04.png")
    data = (folder / "images/06.png").read_bytes()
    (folder / "images/06.png").write_bytes(data[: len(data) // 2])
    assert "06.png" in findings(folder)["images"].found and not findings(folder)["images"].optional


def test_exposures_are_told_in_stops(tmp_path: Path) -> None:
    folder = write_scene(tmp_path / "s")
    stops = np.where(np.arange(VIEWS) % 2, 0.5, -0.5)
    for k in range(VIEWS):
        # sRGB is about the 2.2th root of light.
        gain = 2 ** (stops[k] / 2.2)
        edit(
            folder,
            k,
            lambda image, path, gain=gain: Image.fromarray((np.asarray(image) * gain * 0.8).astype(np.uint8)).save(path),
        )
    found = findings(folder)["exposure"].found
    assert "a factor for each view" in found and float(found.split()[2]) == pytest.approx(0.5, abs=0.15)
