"""What captures hold besides what their formats promise: odd names, parts, missing images and sizes, NaN,
lenses, points.
"""

import json
import os
import struct
import subprocess
import sys
import unicodedata
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh
from capture_files import (
    Capture,
    cameras_of,
    write_colmap,
    write_image,
    write_llff,
    write_meganerf,
    write_odm,
    write_polycam,
    write_record3d,
    write_transforms,
)

from fprf.datamanagers.images import load_images
from fprf.datamanagers.parsers.colmap_model import MODELS
from fprf.datamanagers.parsers.config import TransformsConfig, parse_scene
from fprf.datamanagers.scene import ParsedScene
from fprf.errors import DataError
from fprf.rendering.cameras import project

Writer = Callable[[Path, Capture], object]
WRITERS: dict[str, Writer] = {
    "transforms": write_transforms,
    "colmap": write_colmap,
    "colmap text": partial(write_colmap, binary=False),
    "odm": write_odm,
}


def parse(folder: Path) -> ParsedScene:
    return parse_scene(folder, 1, None)


def named(template: str, count: int = 3) -> Capture:
    capture = Capture.make(count)
    return Capture(tuple(template.format(k) for k in range(count)), capture.poses, capture.points)


def expect(
    scene: ParsedScene, capture: Capture, kept: list[int] | None = None, folder: Path | None = None
) -> None:
    """The scene has these views of the capture, with their poses, and the pixels that were written for
    them.
    """
    kept = list(range(len(capture.names))) if kept is None else kept
    assert np.allclose(scene.cameras.pose.numpy(), capture.poses[kept], atol=1e-9)
    for image, seed in zip(load_images(scene), kept, strict=True):
        assert np.array_equal(image[:, :, ::-1], pixels(capture, seed))
    assert sorted(scene.train.tolist() + scene.test.tolist()) == list(range(len(kept)))
    if scene.points is not None:
        assert np.allclose(scene.points.numpy(), capture.points, atol=1e-6)
    if scene.seen is not None:
        assert scene.seen.tolist() == [
            [view, point] for view in range(len(kept)) for point in range(len(capture.points))
        ]


def pixels(capture: Capture, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (capture.size[1], capture.size[0], 3), dtype=np.uint8)


NAMES = [
    "Screenshot at 4.42.0{}\u202fPM.png", "写真\u3000{}.png", "\u3000{}.png", "A_V plan, wp-2 ({}).png", "🌳 täst {}.png",
    "a  b%20{}.png", "x/y/{}.png", "\u200e{}.png", "#{} 'q' \"w\".png", "a\tb{}.png", "\u202e{}.png", "[{}]*?.png",
]  # fmt: skip


@pytest.mark.parametrize("writer", WRITERS)
@pytest.mark.parametrize("template", NAMES)
def test_every_name_that_a_file_can_have_is_read(tmp_path: Path, template: str, writer: str) -> None:
    capture = named(template)
    WRITERS[writer](tmp_path, capture)
    scene = parse(tmp_path)
    expect(scene, capture)
    assert [path.relative_to(tmp_path / "images").as_posix() for path in scene.paths] == list(capture.names)


@pytest.mark.parametrize("writer", WRITERS)
def test_names_that_another_system_spelt_are_found(tmp_path: Path, writer: str) -> None:
    capture = named("Bäume/Ä{}.png")
    WRITERS[writer](tmp_path, capture)
    for file in list((tmp_path / "images/Bäume").iterdir()):
        file.rename(file.with_name(unicodedata.normalize("NFD", file.stem) + ".PNG"))
    expect(parse(tmp_path), capture)


WRITTEN: dict[str, Callable[[Path, str], str]] = {
    "./": lambda folder, name: f"./{name}",
    "backslash": lambda folder, name: name.replace("/", "\\"),
    "no suffix": lambda folder, name: name.removesuffix(".png"),
    "absolute": lambda folder, name: str(folder / name),
    "detour": lambda folder, name: f"images/../{name}",
    "other case": lambda folder, name: name.replace("png", "PNG"),
}


@pytest.mark.parametrize("how", WRITTEN)
def test_paths_of_transforms_lead_to_their_images(tmp_path: Path, how: str) -> None:
    capture = Capture.make(3)
    content = write_transforms(tmp_path, capture)
    frames = content["frames"]
    assert isinstance(frames, list)
    for frame in frames:
        frame["file_path"] = WRITTEN[how](tmp_path, frame["file_path"])
    (tmp_path / "transforms.json").write_text(json.dumps(content), encoding="utf-8-sig")
    expect(parse(tmp_path), capture)
    if how == "no suffix":
        for file in list((tmp_path / "images").iterdir()):
            file.rename(file.with_suffix(".JPG"))  # what it holds decides how it is decoded
        expect(parse(tmp_path), capture)


@pytest.mark.skipif(os.name == "nt", reason="a backslash parts folders there")
def test_a_backslash_belongs_to_a_name_where_a_file_has_it(tmp_path: Path) -> None:
    capture = named("a\\b{}.png")
    write_transforms(tmp_path, capture)
    expect(parse(tmp_path), capture)


@pytest.mark.parametrize("writer", WRITERS)
def test_missing_images_are_counted(tmp_path: Path, writer: str) -> None:
    WRITERS[writer](tmp_path, Capture.make(5))
    for name in ("0001.png", "0003.png"):
        (tmp_path / "images" / name).unlink()
    with pytest.raises(DataError, match=r"2 of 5 images are missing, the first is .*0001\.png"):
        parse(tmp_path)


def test_what_is_left_out_is_in_no_split_and_sees_no_point(tmp_path: Path) -> None:
    capture = Capture.make(4)
    content = write_transforms(tmp_path, capture, test_filenames=["images/0001.png", "images/0003.png"])
    content["frames"][1]["fl_x"] = np.nan  # type: ignore[index]
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    np.savez(
        tmp_path / "points.npz",
        xyz=capture.points,
        seen=[[view, point] for view in range(4) for point in range(40)],
    )
    scene = parse(tmp_path)
    expect(scene, capture, [0, 2, 3])
    assert (scene.train.tolist(), scene.test.tolist()) == ([0, 1], [2]) and scene.seen is not None
    write_meganerf(tmp_path / "mill", capture, held=(0, 2))
    file = tmp_path / "mill/train/metadata/0001.pt"
    torch.save(torch.load(file) | {"c2w": torch.full((3, 4), torch.nan)}, file)
    scene = parse(tmp_path / "mill")
    expect(scene, capture, [0, 2, 3])
    assert (scene.train.tolist(), scene.test.tolist()) == ([2], [0, 1])


@pytest.mark.parametrize("wrong", ["NaN", "-nan(ind)", "nan", "-Infinity", "inf", "1.#QNAN", "-1.#IND"])
def test_a_camera_that_is_not_finite_loses_its_image(tmp_path: Path, wrong: str) -> None:
    capture = Capture.make(4)
    for part, place in (("lens", 4), ("pose", 1)):
        folder = tmp_path / part
        sparse = write_colmap(folder, capture, binary=False)
        lines = (sparse / "images.txt").read_text().splitlines()
        if part == "lens":
            cameras = (sparse / "cameras.txt").read_text()
            (sparse / "cameras.txt").write_text(cameras + f"8 PINHOLE 24 16 {wrong} 20 12 8\n")
            lines[3] = lines[3].replace(" 7 0001", " 8 0001")
        else:
            words = lines[3].split()
            words[place] = wrong
            lines[3] = " ".join(words)
        (sparse / "images.txt").write_text("\n".join(lines) + "\n")
        scene = parse(folder)
        expect(scene, capture, [0, 2, 3])
        assert "1 of 4" in scene.notes[0]
    text = json.dumps(write_transforms(tmp_path / "a nan, b", capture, per_frame=True))
    for old in ('"fl_x": 20.0', repr(float(capture.poses[2, 0, 3]))):
        assert old in text
        parts = text.split("0002.png")
        broken = parts[0] + "0002.png" + parts[1].replace(old, old[: -len(old.split(": ")[-1])] + wrong, 1)
        (tmp_path / "a nan, b/transforms.json").write_text(broken)
        expect(parse(tmp_path / "a nan, b"), capture, [0, 1, 3])
    (tmp_path / "a nan, b/transforms.json").write_text(
        text.replace('"frames"', f'"sharpness, nan, ": {wrong}, "frames"')
    )
    assert parse(tmp_path / "a nan, b").notes == ()


def test_binary_models_and_arrays_lose_what_is_not_finite(tmp_path: Path) -> None:
    capture = Capture.make(4)
    sparse = write_colmap(tmp_path / "colmap", capture)
    data = bytearray((sparse / "images.bin").read_bytes())
    data[8 + 4 : 8 + 4 + 8] = struct.pack("<d", np.inf)
    (sparse / "images.bin").write_bytes(data)
    expect(parse(tmp_path / "colmap"), capture, [1, 2, 3])
    for column in (3, 14, 16):
        rows = write_llff(tmp_path / "llff", capture)
        rows[2, column] = np.nan
        np.save(tmp_path / "llff/poses_bounds.npy", rows)
        expect(parse(tmp_path / "llff"), capture, [0, 1, 3])
    cameras = write_polycam(tmp_path / "polycam/keyframes", capture)
    (cameras / "0000.json").write_text(
        (cameras / "0000.json").read_text().replace('"t_03": ', '"t_03": nan, "was": ')
    )
    expect(parse(tmp_path / "polycam"), capture, [1, 2, 3])
    file = write_record3d(tmp_path / "record3d", capture)
    content = json.loads(file.read_text())
    content["poses"][1][2] = np.nan
    file.write_text(json.dumps(content))
    expect(parse(tmp_path / "record3d"), capture, [0, 2, 3])
    file = write_odm(tmp_path / "odm", capture)
    content = json.loads(file.read_text())
    content[0]["shots"]["0000.png"]["translation"] = [np.nan, 0, 0]
    file.write_text(json.dumps(content))
    expect(parse(tmp_path / "odm"), capture, [1, 2, 3])


def test_of_several_models_the_largest_is_read(tmp_path: Path) -> None:
    capture = Capture.make(9)
    for place, binary in (("sparse/1", True), ("sparse/2", False), ("colmap/sparse/0", True)):
        folder = tmp_path / place.replace("/", "-")
        small = Capture(capture.names[:2], capture.poses[:2] + 5, capture.points + 5)
        write_colmap(folder, small, binary=not binary)
        write_colmap(folder / "large", capture, binary=binary)
        (folder / "large/images").rename(folder / "images-9")
        (folder / "images").rename(folder / "images-2")
        (folder / "images-9").rename(folder / "images")
        (folder / place).parent.mkdir(parents=True, exist_ok=True)
        (folder / "large/sparse/0").rename(folder / place)
        scene = parse(folder)
        expect(scene, capture)
        assert len(scene.notes) == 1 and place in scene.notes[0]


def lensed(model: str) -> list[float]:
    """Small parameters of each model."""
    values = {
        "f": 20.0,
        "fx": 20.0,
        "fy": 21.0,
        "cx": 12.0,
        "cy": 8.0,
        "k1": 0.05,
        "k2": -0.02,
        "k3": 0.003,
        "k4": 0.001,
    }
    values |= {"p1": 0.002, "p2": -0.001}
    if "THIN" in model:
        values |= {"p1": 0.0, "p2": 0.0}
    return [values.get(key, 0.0) for key in dict(MODELS)[model].split()]


PANORAMA = "EQUIRECTANGULAR"
EUCM = "EUCM"
READ = [name for name, _ in MODELS if name not in (PANORAMA, EUCM)]


def test_lenses_project_as_opencv_s(tmp_path: Path) -> None:
    draw = np.random.default_rng(0)
    points = draw.uniform((-0.6, -0.4, 1.0), (0.6, 0.4, 1.0), (50, 3))
    for binary in (True, False):
        for model in READ:
            write_colmap(tmp_path, Capture.make(1), model=model, params=tuple(lensed(model)), binary=binary)
            cameras = parse(tmp_path).cameras
            given = dict(zip(dict(MODELS)[model].split(), lensed(model), strict=True))
            k = [given.get(key, 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2")]
            focal = [given.get("fx", 20.0), given.get("fy", 20.0)]
            matrix = np.array([[focal[0], 0, 12], [0, focal[1], 8], [0, 0, 1]])
            if "FISHEYE" in model:
                wanted = cv2.fisheye.projectPoints(
                    points[:, None], np.zeros(3), np.zeros(3), matrix, np.array(k[:4])
                )[0][:, 0]
            else:
                wanted = cv2.projectPoints(
                    points, np.zeros(3), np.zeros(3), matrix, np.array([k[0], k[1], k[4], k[5], k[2]])
                )[0][:, 0]
            still = cameras_of(torch.eye(4, dtype=torch.float64)[None, :3], (24, 16), focal)
            turned = torch.from_numpy(points * [1, -1, -1])
            lens = {
                "distortion": cameras.distortion,
                "lens": cameras.lens,
                "focal": cameras.focal,
                "centre": cameras.centre,
            }
            seen = project(
                type(still)(pose=still.pose, size=still.size, **lens),
                torch.zeros(50, dtype=torch.int64),
                turned,
            )[0]
            assert np.abs(seen.numpy() - wanted).max() < 1e-9, model
            for file in (tmp_path / "sparse/0").iterdir():
                file.unlink()


_ORACLE = """
import json, pycolmap
models = [pycolmap.CameraModelId(k) for k in range({count})]
cameras = [pycolmap.Camera.create_from_model_id(1, model, 20.0, 24, 16) for model in models]
print(json.dumps([[camera.model.name, len(camera.params), camera.params_info] for camera in cameras]))
"""


@pytest.mark.skipif(find_spec("pycolmap") is None, reason="pycolmap is not installed")
def test_models_are_numbered_as_in_colmap() -> None:
    command = [sys.executable, "-c", _ORACLE.format(count=11)]  # those that older versions have too
    listed = json.loads(subprocess.run(command, capture_output=True, check=True, text=True).stdout)
    for (name, params), (wanted, count, info) in zip(MODELS, listed, strict=False):
        assert name == wanted and len(params.split()) == count
        assert [key for key in params.split() if key[0] in "fc"] == [
            key for key in info.split(", ") if key[0] in "fc"
        ]


@pytest.mark.parametrize(
    ("model", "key", "value"),
    [
        ("FULL_OPENCV", "d1", 0.1), ("FOV", "omega", 0.5), ("THIN_PRISM_FISHEYE", "s1", 0.1), ("THIN_PRISM_FISHEYE", "p1", 0.1),
        ("RAD_TAN_THIN_PRISM_FISHEYE", "k5", 0.1), ("SIMPLE_DIVISION", "division", -0.1), ("DIVISION", "division", 0.1),
        ("EUCM", "beta", 1.0), ("EQUIRECTANGULAR", "w", 24),
    ],
)  # fmt: skip
@pytest.mark.parametrize("binary", [True, False])
def test_what_no_lens_here_can_do_is_refused_with_the_undistorter(
    tmp_path: Path, model: str, key: str, value: float, binary: bool
) -> None:
    params = [
        value if each == key else given
        for each, given in zip(dict(MODELS)[model].split(), lensed(model), strict=True)
    ]
    write_colmap(tmp_path, Capture.make(2), model=model, params=tuple(params), binary=binary)
    with pytest.raises(DataError, match=f"{model}.*image_undistorter"):
        parse(tmp_path)


@pytest.mark.parametrize(
    "given",
    [
        {"camera_model": "OPENCV", "k5": 0.1},
        {"k6": 0.1, "k4": 0.2},
        {"camera_model": "FULL_OPENCV", "k4": 0.1},
    ],
)
def test_rational_terms_of_transforms_are_not_dropped(tmp_path: Path, given: dict[str, object]) -> None:
    write_transforms(tmp_path, Capture.make(2), **given)
    with pytest.raises(DataError, match=r"OPENCV.*image_undistorter"):
        parse(tmp_path)


def ply(points: np.ndarray, how: str) -> bytes:
    colours = np.random.default_rng(0).integers(0, 256, (len(points), 4), dtype=np.uint8)
    if how == "double":
        rows = np.zeros(len(points), [("xyz", "<f8", 3), ("rgb", "u1", 3)])
        rows["xyz"] = points
        kinds = [("double", "xyz"), ("uchar", ["red", "green", "blue"])]
        properties = "".join(f"property {kind} {name}\n" for kind, names in kinds for name in names)
        return (
            f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{properties}end_header\n".encode()
            + rows.tobytes()
        )
    cloud = trimesh.PointCloud(points, colors=colours)
    data: bytes = cloud.export(file_type="ply", encoding="ascii" if how != "binary" else "binary")
    return data.replace(b"\n", b"\r\n") if how == "crlf" else data


@pytest.mark.parametrize("how", ["ascii", "crlf", "binary", "double"])
def test_points_of_a_ply_file_are_read(tmp_path: Path, how: str) -> None:
    capture = Capture.make(3)
    write_transforms(tmp_path / "a", capture, ply_file_path="./sparse_pc.ply")
    (tmp_path / "a/points.npz").unlink()
    (tmp_path / "a/sparse_pc.ply").write_bytes(ply(capture.points, how))
    sparse = write_colmap(tmp_path / "b", capture)
    (sparse / "points3D.bin").unlink()
    (sparse / "points3D.ply").write_bytes(ply(capture.points, how))
    write_colmap(tmp_path / "c", capture, binary=False)
    (tmp_path / "c/sparse/0/points3D.txt").write_text("# none\n")
    (tmp_path / "c/input.ply").write_bytes(ply(capture.points, how))
    for name in "abc":
        scene = parse(tmp_path / name)
        assert scene.points is not None and scene.notes == ()
        expect(scene, capture)


@pytest.mark.parametrize(
    "content",
    [None, b"", b"ply\nformat ascii 1.0\nend_header\n", b"ply\nelement vertex 9000000000\n", b"x" * 99],
)
def test_a_ply_file_that_cannot_be_read_is_said_and_left(tmp_path: Path, content: bytes | None) -> None:
    capture = Capture.make(3)
    write_transforms(tmp_path, capture, ply_file_path="sparse_pc.ply")
    (tmp_path / "points.npz").unlink()
    if content is not None:
        (tmp_path / "sparse_pc.ply").write_bytes(content)
    scene = parse(tmp_path)
    expect(scene, capture)
    assert (
        scene.points is None
        and len(scene.notes) == 1
        and "\n" not in scene.notes[0]
        and "sparse_pc.ply" in scene.notes[0]
    )


def test_a_frame_that_is_written_twice_is_one_view(tmp_path: Path) -> None:
    capture = Capture.make(3)
    content = write_transforms(tmp_path, capture)
    frames = content["frames"]
    assert isinstance(frames, list)
    (tmp_path / "transforms.json").write_text(json.dumps(content | {"frames": [*frames, frames[1]]}))
    scene = parse(tmp_path)
    expect(scene, capture)
    assert len(scene.notes) == 1
    (tmp_path / "transforms.json").write_text(
        json.dumps(content | {"frames": [*frames, frames[1] | {"fl_x": 30.0}]})
    )
    with pytest.raises(DataError, match=r"0001\.png occurs twice"):
        parse(tmp_path)


@pytest.mark.parametrize("images", [0, 4, 9])
def test_polycam_s_frames_are_corrected_where_they_can_be(tmp_path: Path, images: int) -> None:
    capture = Capture.make(9)
    better = Capture(capture.names, capture.poses + np.array([0, 0, 0, 0.01]), capture.points)
    write_polycam(tmp_path / "keyframes", capture)
    write_polycam(tmp_path / "keyframes", better, corrected=True)
    for k in range(images, 9):
        (tmp_path / f"keyframes/corrected_images/{k:04d}.png").unlink()
    scene = parse(tmp_path)
    mixed = np.concatenate([better.poses[:images], capture.poses[images:]])
    expect(scene, Capture(capture.names, mixed, capture.points))
    assert [path.parent.name for path in scene.paths] == ["corrected_images"] * images + ["images"] * (
        9 - images
    )
    assert bool(scene.notes) == (images < 9)


def test_sizes_come_from_the_images_where_no_file_says_them(tmp_path: Path) -> None:
    capture = Capture.make(3)
    write_polycam(tmp_path / "polycam/keyframes", capture, width=None, height=None)
    write_record3d(tmp_path / "record3d", capture, w=None, h=None)
    write_transforms(tmp_path / "transforms", capture, w=None, h=None)
    write_odm(tmp_path / "odm", capture, width=None, height=None)
    write_meganerf(tmp_path / "mega", capture, held=())
    for file in (tmp_path / "mega/train/metadata").iterdir():
        torch.save({key: value for key, value in torch.load(file).items() if key not in "WH"}, file)
    for folder in tmp_path.iterdir():
        scene = parse(folder)
        expect(scene, capture)
        assert (
            scene.cameras.size.tolist() == [[24, 16]] * 3 and scene.cameras.focal.tolist() == [[20, 20]] * 3
        )


def test_record3d_s_images_beyond_the_poses_are_left_out(tmp_path: Path) -> None:
    capture = Capture.make(4)
    file = write_record3d(tmp_path, capture)
    content = json.loads(file.read_text())
    file.write_text(json.dumps(content | {"poses": content["poses"][:3]}))
    scene = parse(tmp_path)
    expect(scene, capture, [0, 1, 2])
    assert len(scene.notes) == 1 and "1 of 4" in scene.notes[0]
    (tmp_path / "rgb/1.png").unlink()
    expect(parse(tmp_path), capture, [0, 2])


@pytest.mark.parametrize(
    "change", [np.asfortranarray, lambda rows: rows.astype("f4"), lambda rows: rows.astype(">f8")]
)
def test_llff_s_array_may_be_stored_in_any_order(
    tmp_path: Path, change: Callable[[np.ndarray], np.ndarray]
) -> None:
    capture = Capture.make(9)
    np.save(tmp_path / "poses_bounds.npy", change(write_llff(tmp_path, capture)))
    for junk in ("._0000.png", ".DS_Store", "Thumbs.db"):
        (tmp_path / "images" / junk).write_bytes(b"x")
    scene = parse(tmp_path)
    assert torch.allclose(scene.cameras.pose, torch.from_numpy(capture.poses), atol=1e-6)
    assert scene.depths is not None and torch.equal(
        scene.depths, torch.tensor([[2.0, 9.0]] * 9, dtype=torch.float64)
    )
    write_image(tmp_path / "images/0009.png")
    with pytest.raises(DataError, match=r"10 images.* 9 rows"):
        parse(tmp_path)


def test_blender_s_files_without_suffix_are_png_before_others(tmp_path: Path) -> None:
    capture = Capture.make(2)
    write_transforms(tmp_path, named("{}.png", 2))
    content = json.loads((tmp_path / "transforms.json").read_text())
    for k, frame in enumerate(content["frames"]):
        frame["file_path"] = f"images/{k}"
        write_image(tmp_path / f"images/{k}.jpg", seed=9)
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    assert [path.name for path in parse_scene(tmp_path, 1, TransformsConfig()).paths] == ["0.png", "1.png"]
    expect(parse(tmp_path), capture)
