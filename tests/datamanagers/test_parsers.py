"""One capture is one scene in every format, also far from 0; what each may say besides: lenses, splits,
masks, points.
"""

import json
import math
import shutil
import struct
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from capture_files import (
    Capture,
    write_colmap,
    write_image,
    write_llff,
    write_meganerf,
    write_odm,
    write_phototourism,
    write_polycam,
    write_record3d,
    write_transforms,
)
from moved_scene import UTM

from fprf.datamanagers.parsers.config import (
    ColmapConfig,
    DataParserConfig,
    LlffConfig,
    MegaNerfConfig,
    OdmConfig,
    PhotoTourismConfig,
    PolycamConfig,
    Record3DConfig,
    TransformsConfig,
    model_folders,
    parse_scene,
    recognise,
)
from fprf.datamanagers.scene import ParsedScene
from fprf.errors import ConfigError, DataError
from fprf.rendering.lens import FISHEYE, OPENCV, PINHOLE

Writer = Callable[[Path, Capture], object]
FORMATS: dict[str, tuple[DataParserConfig, Writer]] = {
    "transforms": (TransformsConfig(), write_transforms),
    "transforms by frame": (TransformsConfig(), partial(write_transforms, per_frame=True)),
    "colmap": (ColmapConfig(), write_colmap),
    "colmap text": (ColmapConfig(), partial(write_colmap, binary=False)),
    "llff": (LlffConfig(), write_llff),
    "llff reduced": (LlffConfig(), partial(write_llff, images="images_8", factor=8)),
    "phototourism": (PhotoTourismConfig(), write_phototourism),
    "polycam": (PolycamConfig(), lambda folder, capture: write_polycam(folder / "keyframes", capture)),
    "polycam corrected": (PolycamConfig(), partial(write_polycam, corrected=True)),
    "record3d": (Record3DConfig(), write_record3d),
    "record3d packed": (Record3DConfig(), partial(write_record3d, packed=True)),
    "odm": (OdmConfig(), write_odm),
    "odm report": (OdmConfig(), partial(write_odm, report=True)),
    "meganerf": (MegaNerfConfig(), write_meganerf),
}


def parse(folder: Path, config: DataParserConfig | None = None) -> ParsedScene:
    return parse_scene(folder, 1, config)


@pytest.mark.parametrize("name", FORMATS)
def test_one_capture_in_every_format_is_one_scene(tmp_path: Path, name: str) -> None:
    config, write = FORMATS[name]
    k = (0.05, -0.02, 0.001, -0.002) if name.startswith(("transforms", "odm")) else (0.0,) * 4
    capture = Capture.make(9, focal=(20.0, 20.0 if "llff" in name else 21.0), k=k)
    write(tmp_path, capture)
    assert recognise(tmp_path) == config
    for downscale in (1, 2, 3):
        scene = parse_scene(tmp_path, downscale, None)
        wanted = capture.cameras().scaled(downscale)
        for field in ("pose", "focal", "centre", "distortion"):
            torch.testing.assert_close(
                getattr(scene.cameras, field), getattr(wanted, field), atol=1e-9, rtol=0
            )
        assert (
            scene.cameras.size.tolist() == wanted.size.tolist()
            and scene.cameras.lens.tolist() == wanted.lens.tolist()
        )
    for file in [*tmp_path.rglob("*")]:  # macOS leaves these beside each file
        if file.is_file():
            file.with_name(f"._{file.name}").write_bytes(b"\0\5\x16\7Mac OS X")
    scene = parse(tmp_path)
    names = [f"{k}.png" for k in range(9)] if "record3d" in name else list(capture.names)
    assert [path.name for path in scene.paths] == names
    assert scene.test.tolist() == {"meganerf": [2, 5], "phototourism": []}.get(name, [0, 8])
    assert sorted(scene.train.tolist() + scene.test.tolist()) == list(range(9))
    pointed = name.startswith(("transforms", "colmap", "phototourism")) or name == "odm"
    assert (scene.points is not None) == pointed
    if scene.points is not None:
        assert np.allclose(scene.points.numpy(), capture.points, atol=1e-12)
    if name.startswith(("colmap", "phototourism")):
        depth = (capture.points - capture.poses[3, :, 3]) @ -capture.poses[3, :, 2]
        assert scene.depths is not None and scene.seen is not None
        assert scene.depths[3].tolist() == pytest.approx(
            np.percentile(depth, (0.1, 99.9)).tolist(), rel=1e-12
        )
        assert scene.seen.tolist() == [[view, point] for view in range(9) for point in range(40)]
    if "llff" in name:
        assert scene.depths is not None and scene.depths.tolist() == [[2.0, 9.0]] * 9


def colmap(model: str, *params: float) -> Writer:
    return partial(write_colmap, model=model, params=params)


STRAIGHT = [0.0] * 6
LENSES: list[tuple[Writer, int, list[float]]] = [
    (colmap("SIMPLE_RADIAL", 20, 12, 8, 0), PINHOLE, STRAIGHT),
    (colmap("OPENCV", 20, 20, 12, 8, 0.1, 0.2, 0.3, 0.4), OPENCV, [0.1, 0.2, 0, 0, 0.3, 0.4]),
    (partial(write_transforms, camera_model="PINHOLE"), PINHOLE, STRAIGHT),
    (partial(write_transforms, camera_model="OPENCV"), PINHOLE, STRAIGHT),
    (partial(write_transforms, camera_model="OPENCV", k3=0.1, k4=0.2), OPENCV, [0, 0, 0.1, 0.2, 0, 0]),
    (
        partial(write_transforms, distortion_params=[0.1, 0.2, 0.3, 0.4, 0.5, 0.6]),
        OPENCV,
        [0.1, 0.2, 0.3, 0.4, 0.5, 0.6],
    ),
    (partial(write_transforms, camera_model="OPENCV_FISHEYE", k1=0.1), FISHEYE, [0.1, 0, 0, 0, 0, 0]),
    (partial(write_transforms, is_fisheye=True), FISHEYE, STRAIGHT),
    (partial(write_transforms, k1=None), PINHOLE, STRAIGHT),
    (
        partial(write_odm, projection_type="perspective", focal=0.9, k1=0.1, k2=0.2),
        OPENCV,
        [0.1, 0.2, 0, 0, 0, 0],
    ),
    (
        partial(write_odm, projection_type="perspective", focal=20 / 24, focal_x=None, focal_y=None),
        PINHOLE,
        STRAIGHT,
    ),
    (partial(write_odm, projection_type="fisheye", k1=0.1), FISHEYE, [0.1, 0, 0, 0, 0, 0]),
    (partial(write_odm, projection_type="fisheye_opencv"), FISHEYE, STRAIGHT),
    (partial(write_odm, k3=0.3), OPENCV, [0, 0, 0.3, 0, 0, 0]),
]


@pytest.mark.parametrize(("write", "lens", "distortion"), LENSES)
def test_lenses(tmp_path: Path, write: Writer, lens: int, distortion: list[float]) -> None:
    write(tmp_path, Capture.make(2))
    cameras = parse(tmp_path).cameras
    assert cameras.lens.tolist() == [lens] * 2 and cameras.distortion.tolist() == [distortion] * 2
    assert cameras.focal.tolist() == [[20, 20]] * 2 and cameras.centre.tolist() == [[12, 8]] * 2


def test_models_are_found_in_three_places_and_need_no_points(tmp_path: Path) -> None:
    sparse = write_colmap(tmp_path, Capture.make(2))
    for place in (sparse, tmp_path / "sparse", tmp_path):
        for file in list(sparse.iterdir()):
            file.rename(place / file.name)
        sparse = place
        assert model_folders(tmp_path) == [place] and len(parse(tmp_path).paths) == 2
    (tmp_path / "points3D.bin").unlink()
    scene = parse(tmp_path)
    assert scene.points is None and scene.depths is None and scene.seen is None
    (tmp_path / "cameras.bin").unlink()
    assert model_folders(tmp_path) == []


def test_reduced_images_scale_the_cameras_of_a_model(tmp_path: Path) -> None:
    write_colmap(tmp_path, Capture.make(2, size=(12, 8)), images="images_2")
    path = tmp_path / "sparse" / "0" / "cameras.bin"
    path.write_bytes(struct.pack("<QIiQQ4d", 1, 7, 1, 24, 16, 20.0, 20.0, 12.0, 8.0))
    for config in (ColmapConfig(images="images_2"), ColmapConfig()):
        cameras = parse(tmp_path, config).cameras
        assert cameras.size[0].tolist() == [12, 8] and cameras.focal[0].tolist() == [10.0, 10.0]
    (tmp_path / "images_2").rename(tmp_path / "images")
    assert parse(tmp_path).cameras.focal[1].tolist() == [10.0, 10.0]
    write_image(tmp_path / "images" / "0001.png", (24, 16))
    with pytest.raises(DataError, match=r"0000\.png: 12x8 pixels, but its camera has 24x16"):
        parse(tmp_path)


@pytest.mark.parametrize("shift", [0.0, 0.5])
def test_poses_take_points_from_the_model_that_they_were_made_of(tmp_path: Path, shift: float) -> None:
    capture = replace(
        Capture.make(5), names=("a/1.png", "b/1.png", "b/2.png", "b/3.png", "b/4.png")
    )  # a rig of two cameras
    write_colmap(tmp_path, capture)
    write_transforms(tmp_path, capture)
    scene = parse(tmp_path)
    model = parse(tmp_path, ColmapConfig())
    assert (
        scene.points is not None
        and model.points is not None
        and scene.seen is not None
        and model.seen is not None
    )
    assert torch.equal(scene.points, model.points) and torch.equal(scene.seen, model.seen)
    for write in (write_colmap, write_llff):
        write(tmp_path / "llff", Capture.make(5))  # type: ignore[operator]
    scene = parse(tmp_path / "llff")
    assert scene.points is not None and torch.equal(scene.points, model.points)
    assert scene.seen is not None and torch.equal(scene.seen, model.seen) and scene.notes == ()
    (tmp_path / "llff/sparse/0/images.bin").write_bytes(b"1")  # a model that is broken, or of another program
    scene = parse(tmp_path / "llff")
    assert scene.points is None and len(scene.notes) == 1 and "points are not read: " in scene.notes[0]
    # ns-process-data turns the poses and leaves the model as it is, in colmap/sparse/0; it once did not say
    # how.
    applied = np.array([[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1.0, shift]])
    turned = np.concatenate([applied[:, :3] @ capture.poses[:, :, :3], capture.poses[:, :, 3:]], 2)
    turned[:, :, 3] = capture.poses[:, :, 3] @ applied[:, :3].T + applied[:, 3]
    moved = Capture(capture.names, turned, capture.points)
    (tmp_path / "ns/colmap").mkdir(parents=True)
    shutil.copytree(tmp_path / "sparse", tmp_path / "ns/colmap/sparse")
    write_transforms(tmp_path / "ns", moved, applied_transform=applied.tolist() if shift else None)
    (tmp_path / "ns/points.npz").unlink()
    scene = parse(tmp_path / "ns")
    assert scene.points is not None and torch.equal(scene.seen, model.seen)
    assert np.allclose(scene.points.numpy(), capture.points @ applied[:, :3].T + applied[:, 3], atol=1e-12)
    np.savez(
        tmp_path / "points.npz", xyz=[[np.nan] * 3, [0, 0, 1.0], [0, 1, 1.0]], seen=[[0, 0], [0, 2], [4, 1]]
    )
    scene = parse(tmp_path)
    assert scene.points is not None and scene.seen is not None
    assert scene.points.tolist() == [[0, 0, 1], [0, 1, 1]] and scene.seen.tolist() == [[0, 1], [4, 0]]
    write_transforms(tmp_path, Capture.make(5, seed=1))
    assert parse(tmp_path).seen is None, "its cameras stand elsewhere"
    for wrong in ({"xyz": np.zeros((4, 2))}, {"xyz": np.zeros((4, 3)), "seen": [[5, 0]]}):
        np.savez(tmp_path / "points.npz", **wrong)  # type: ignore[arg-type]
        with pytest.raises(DataError, match=r"points\.npz: "):
            parse(tmp_path)


def test_llff_s_folder_is_images_else_the_least_reduced_else_as_told(tmp_path: Path) -> None:
    for name in ("images_8", "images_16"):
        write_llff(tmp_path, Capture.make(3), images=name)
    (tmp_path / "images_2.zip").touch()
    assert parse(tmp_path).paths[0].parent.name == "images_8"
    write_llff(tmp_path, Capture.make(3))
    assert parse(tmp_path).paths[0].parent.name == "images"
    assert parse(tmp_path, LlffConfig(images="images_16")).paths[0].parent.name == "images_16"
    with pytest.raises(DataError, match="leaves"):
        parse(tmp_path, LlffConfig(images="../elsewhere"))


def test_meganerf_s_lengths_are_metres_and_its_files_whole(tmp_path: Path) -> None:
    capture = Capture.make(3)
    write_meganerf(tmp_path, capture, held=(1,), unit=50.0)
    assert np.allclose(parse(tmp_path).cameras.pose[:, :, 3].numpy(), 50 * capture.poses[:, :, 3], atol=1e-9)
    write_meganerf(tmp_path, capture, held=(0,))
    with pytest.raises(DataError, match=r"0000 occurs twice"):
        parse(tmp_path)
    for content in ({"pose_scale_factor": -1.0}, {"pose_scale_factor": "x"}, 3):
        torch.save(content, tmp_path / "coordinates.pt")
        with pytest.raises(DataError, match=r"coordinates\.pt: "):
            parse(tmp_path)


def test_the_table_says_who_is_in_and_for_what(tmp_path: Path) -> None:
    capture = Capture.make(6)
    rows = [(name, str(k), "test" if k == 4 else "train") for k, name in enumerate(capture.names) if k != 2]
    write_phototourism(
        tmp_path, capture, [*rows, ("other.jpg", "9", "train"), (capture.names[2], "nan", "train")]
    )
    write_image(tmp_path / "dense/masks/0003.png")
    scene = parse(tmp_path)
    whole = parse(tmp_path / "dense")
    kept = [0, 1, 3, 4, 5]
    assert [path.name for path in scene.paths] == [capture.names[k] for k in kept]
    assert (scene.train.tolist(), scene.test.tolist()) == ([0, 1, 2, 4], [3])
    assert torch.equal(scene.cameras.pose, whole.cameras.pose[kept])
    assert [mask is not None for mask in scene.masks] == [False, False, True, False, False]
    assert scene.seen is not None and scene.seen.tolist() == [
        [view, point] for view in range(5) for point in range(40)
    ]
    with pytest.raises(DataError, match=r"gone.tsv: no such table"):
        parse(tmp_path, PhotoTourismConfig(list="gone.tsv"))
    (tmp_path / "b.tsv").write_text("filename\tid\tsplit\nelsewhere.png\t1\ttrain\n")
    with pytest.raises(DataError, match="none of the images"):
        parse(tmp_path, PhotoTourismConfig(list="b.tsv"))


def test_polycam_s_images_without_a_camera_are_left_out(tmp_path: Path) -> None:
    cameras = write_polycam(tmp_path / "keyframes", Capture.make(5))
    (cameras / "0002.json").unlink()
    scene = parse(tmp_path)
    assert [path.name for path in scene.paths] == ["0000.png", "0001.png", "0003.png", "0004.png"]
    assert len(scene.notes) == 1 and "1 of 5" in scene.notes[0]
    for file in cameras.iterdir():
        file.rename(file.with_name(f"x{file.name}"))
    with pytest.raises(DataError, match="has the name of an image"):
        parse(tmp_path)


def test_record3d_s_images_go_by_their_numbers_and_may_have_lenses_of_their_own(tmp_path: Path) -> None:
    capture = Capture.make(12)
    lenses = [[20.0 + k, 21.0 + k, 11.0, 9.0] for k in range(12)]
    write_record3d(tmp_path, capture, perFrameIntrinsicCoeffs=lenses)
    for config, kept in ((Record3DConfig(), list(range(12))), (Record3DConfig(frames=4), [0, 4, 7, 11])):
        scene = parse(tmp_path, config)
        assert [path.stem for path in scene.paths] == [str(k) for k in kept]
        assert np.allclose(scene.cameras.pose.numpy(), capture.poses[kept], atol=1e-9)
        assert torch.cat([scene.cameras.focal, scene.cameras.centre], 1).tolist() == [lenses[k] for k in kept]
    with pytest.raises(ConfigError):
        Record3DConfig(frames=0)


def test_what_transforms_leave_out_follows_from_the_image(tmp_path: Path) -> None:
    content = write_transforms(tmp_path, Capture.make(2))
    for key in ("w", "h", "cx", "cy", "fl_x", "fl_y"):
        del content[key]
    for given, focal in (
        ({"camera_angle_x": math.pi / 2}, [12, 12]),
        ({"fl_x": 30}, [30, 30]),
        ({"fl_x": 30, "camera_angle_y": math.pi / 2}, [30, 8]),
    ):
        (tmp_path / "transforms.json").write_text(json.dumps(content | given))
        cameras = parse(tmp_path).cameras
        assert cameras.size[0].tolist() == [24, 16] and cameras.centre[0].tolist() == [12, 8]
        assert cameras.focal[0].tolist() == pytest.approx(focal)


def test_blender_s_two_files(tmp_path: Path) -> None:
    for part, count in (("train", 4), ("test", 2)):
        for k in range(count):
            write_image(tmp_path / part / f"r_{k}.png", (10, 10), channels=4, seed=count + 10 * k)
        frames = [
            {"file_path": f"./{part}/r_{k}", "transform_matrix": np.eye(4).tolist()} for k in range(count)
        ]
        (tmp_path / f"transforms_{part}.json").write_text(
            json.dumps({"camera_angle_x": 0.6911, "frames": frames})
        )
    scene = parse(tmp_path)
    assert scene.alpha and (len(scene.train), len(scene.test)) == (4, 2)
    assert {scene.paths[k].parent.name for k in scene.train} == {"train"}
    assert {scene.paths[k].parent.name for k in scene.test} == {"test"}
    assert scene.cameras.focal[0, 0].item() == pytest.approx(5 / math.tan(0.6911 / 2))
    for path in scene.paths:  # what game engines write
        assert cv2.imwrite(str(path), np.full((10, 10, 4), 255, np.uint8))
    assert not parse(tmp_path).alpha


@pytest.mark.parametrize(
    ("lists", "train", "test"),
    [
        ({"train_filenames": ["images/0001.png"], "test_filenames": ["images/0003.png"]}, [1], [3]),
        ({"train_filenames": ["./images/0001.png"]}, [1], [0, 2, 3]),
        ({"train_filenames": ["images/0001.png"], "val_filenames": ["images/0000.png"]}, [1], [2, 3]),
        (
            {
                "train_filenames": [f"images/000{k}.png" for k in range(3)],
                "val_filenames": ["./images/0003.png"],
            },
            [0, 1, 2],
            [3],
        ),
        ({"test_filenames": ["images/0000.png", "images/0002.png"]}, [1, 3], [0, 2]),
    ],
)
def test_the_capture_says_what_is_held_out(
    tmp_path: Path, lists: dict[str, object], train: list[int], test: list[int]
) -> None:
    write_transforms(tmp_path, Capture.make(4), **lists)
    scene = parse(tmp_path)
    assert scene.train.tolist() == train and scene.test.tolist() == test


def test_masks_are_named_or_lie_beside_the_images(tmp_path: Path) -> None:
    content = write_transforms(tmp_path, Capture.make(4))
    frames = content["frames"]
    assert isinstance(frames, list)
    write_image(tmp_path / "masks" / "0002.png.png")
    scene = parse(tmp_path)
    assert scene.masks == (None, None, tmp_path / "masks" / "0002.png.png", None) and scene.sky_masks == ()
    frames[1]["mask_path"], frames[3]["sky_mask_path"] = "people/a.png", "sky/b.png"
    write_image(tmp_path / "people/a.png")
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(DataError, match=r"b\.png"):
        parse(tmp_path)
    write_image(tmp_path / "sky/b.png")
    scene = parse(tmp_path)
    assert scene.masks == (None, tmp_path / "people/a.png", None, None)
    assert scene.sky_masks == (None, None, None, tmp_path / "sky/b.png")
    write_transforms(tmp_path / "round", Capture.make(2), fisheye_crop_radius=9.0)
    assert "fisheye_crop_radius is not applied" in parse(tmp_path / "round").notes[0]
    # Images may lie in the scene's folder itself; what lies outside of it is another's.
    flat = write_transforms(tmp_path / "flat", Capture.make(4))
    for frame in flat["frames"]:  # type: ignore[attr-defined]
        name = frame["file_path"] = Path(frame["file_path"]).name
        (tmp_path / "flat/images" / name).rename(tmp_path / "flat" / name)
    (tmp_path / "flat/transforms.json").write_text(json.dumps(flat))
    assert parse(tmp_path / "flat").masks == ()
    write_image(tmp_path / "flat/masks/0001.png")
    assert parse(tmp_path / "flat").masks == (None, tmp_path / "flat/masks/0001.png", None, None)
    frames[1]["mask_path"] = "../a.png"
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(DataError, match="leaves"):
        parse(tmp_path)


ECEF = (4_000_000.0, 1_000_000.0, 4_900_000.0)


@pytest.mark.parametrize("shift", [UTM, ECEF])
@pytest.mark.parametrize("name", FORMATS)
def test_every_format_is_read_in_float64(
    tmp_path: Path, name: str, shift: tuple[float, float, float]
) -> None:
    own = Capture.make(9, focal=(20.0, 20.0))
    poses = own.poses.copy()
    poses[:, :, 3] += shift
    FORMATS[name][1](tmp_path, replace(own, poses=poses, points=own.points + shift))
    scene = parse_scene(tmp_path, 1, FORMATS[name][0])
    origin = np.array(scene.origin)
    assert np.abs(origin - shift).max() < 8 and float(scene.cameras.pose[:, :, 3].abs().max()) < 8
    assert np.abs(scene.cameras.pose.numpy()[:, :, :3] - own.poses[:, :, :3]).max() < 1e-9
    # float64 has a nanometre there; ODM's rotation vectors, by which a world-to-camera pose is inverted, keep
    # less.
    assert np.abs(scene.cameras.pose.numpy()[:, :, 3] + (origin - shift) - own.poses[:, :, 3]).max() < 1e-7
    if scene.points is not None:
        assert np.abs(scene.points.numpy() + (origin - shift) - own.points).max() < 1e-8
