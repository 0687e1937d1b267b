"""Damaged files and values that no capture may hold, one at a time: each is refused in one line."""

import json
import struct
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from capture_files import (
    Capture,
    rotations,
    write_colmap,
    write_llff,
    write_odm,
    write_polycam,
    write_record3d,
    write_transforms,
)
from hypothesis import given
from hypothesis import strategies as st

from fprf.datamanagers.parsers import config as parsers
from fprf.datamanagers.parsers.config import parse_scene
from fprf.datamanagers.parsers.files import path_inside, read_npz
from fprf.datamanagers.parsers.views import rigid_pose
from fprf.errors import DataError

EYE = "[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]"
BENT = "[[2,0,0,0],[0,2,0,0],[0,0,2,0],[0,0,0,1]]"
WRONG = {
    "transforms": """frames=[] frames=null fl_x=0 fl_y=-3 fl_x="20" w=25 w=0 camera_model="EQUIRECTANGULAR" near=3&far=1
        camera_model="OPENCV_FISHEYE"&p1=0.1 camera_model="PINHOLE"&k1=0.1 test_filenames=["images/0009.png"]
        test_filenames=["images/0000.png"]&train_filenames=["images/0000.png"] test_filenames="x"
        fl_x=null&fl_y=null&camera_angle_x=4.0 fl_x=null&fl_y=null""",
    "frame": f"""file_path="images/none.png" file_path="/etc/passwd" file_path="../0001.png" file_path=null
        file_path="images/0000.png" transform_matrix=[[1,0,0,0],[0,1,0,0]] transform_matrix={EYE[:-2]}2]]
        transform_matrix={BENT} transform_matrix=[["a"]] transform_matrix=null""",
    "polycam": 't_00=null fx="20" fx=-1.0 t_11=7.0 width=0 width=1e9 width=48',
    "record3d": """poses=[[0,0,0,1,0,0,0],[0,0,0,1,0,0,0]] poses=[] poses=[[0,0,0,2,0,0,0],[0,0,0,2,1,0,0]]
        poses=[[1,2,3]] poses=null K=[1,2] perFrameIntrinsicCoeffs=[[1,2,3,"4"]] w=0 h=1e9 h=17""",
    "odm": """projection_type="spherical" focal_x=null&focal_y=null focal_x=-0.5 width=24&height=24 k1="x" """,
    "shot": 'rotation=[1,2] rotation=[1e9,0,0] translation=null camera="none"',
    "reconstruction": '=[] ={} =[{}] =[{"shots":{}}] =[3] =[{"shots":3}]',
    "colmap": """cameras.0="8" cameras.1="FOO" cameras.1="RADIAL" cameras.2="0" cameras.4="-1" cameras.4="x" images.1="9"
        images.4="x" images.9="../x.png" images.9="0001.png" images.9="a\\u001bb.png" points3D.0="x" points3D.1="x" """,
    "llff": "1=3.0 4=0.0 9=1e30 14=-5.0 15=10.0 9=16.0",
    "rows": "=[] =[[1,2,3]] =[1,2,3]",
}
"""Changes `key=value` by what they are made to, several at once joined by &; of COLMAP's files the words of
the first line.
"""


def changed(file: Path, change: Callable[[Any], object]) -> None:
    content = json.loads(file.read_text())
    replaced = change(content)
    file.write_text(json.dumps(content if replaced is None else replaced))


@pytest.mark.parametrize(
    ("what", "change"), [(what, change) for what, line in WRONG.items() for change in line.split()]
)
def test_wrong_values_are_refused_in_one_line(tmp_path: Path, what: str, change: str) -> None:
    values = {key: json.loads(value) for key, _, value in (each.partition("=") for each in change.split("&"))}
    capture = Capture.make(2)
    if what in ("llff", "rows"):
        rows = write_llff(tmp_path, capture)
        for column, value in values.items():
            if what == "rows":
                rows = np.array(value, float)
            else:
                rows[1, int(column)] = value
        np.save(tmp_path / "poses_bounds.npy", rows)
    elif what in ("transforms", "frame"):
        write_transforms(tmp_path, capture)
        place = (lambda c: c["frames"][1].update(values)) if what == "frame" else (lambda c: c.update(values))
        changed(tmp_path / "transforms.json", place)
    elif what == "colmap":
        sparse = write_colmap(tmp_path, capture, binary=False)
        for key, value in values.items():
            name, _, word = key.partition(".")
            comment, line, *rest = (sparse / f"{name}.txt").read_text().splitlines()
            words = line.split()
            words[int(word)] = value
            (sparse / f"{name}.txt").write_text("\n".join([comment, " ".join(words), *rest]))
    elif what == "polycam":
        write_polycam(tmp_path / "keyframes", capture, **values)
    elif what == "record3d":
        write_record3d(tmp_path, capture, **values)
    else:
        file = write_odm(tmp_path, capture, **(values if what == "odm" else {}))
        if what == "shot":
            changed(file, lambda c: c[0]["shots"]["0001.png"].update(values))
        if what == "reconstruction":
            changed(file, lambda c: values[""])
    with pytest.raises(DataError) as fault:
        parse_scene(tmp_path, 1, None)
    assert "\n" not in str(fault.value) and str(tmp_path) in str(fault.value)


@pytest.mark.parametrize(
    "name", ["BlockNerf", "MegaNerf", "PhotoTourism", "Polycam", "Record3D", "Odm", "Llff", "Colmap"]
)
def test_a_folder_without_the_files_of_a_format_is_refused(tmp_path: Path, name: str) -> None:
    np.save(tmp_path / "poses_bounds.npy", np.zeros((3, 17)))
    with pytest.raises(DataError) as fault:
        getattr(parsers, f"{name}Config")().build().parse(tmp_path, 1)
    assert "\n" not in str(fault.value) and str(tmp_path) in str(fault.value)


def test_paths_stay_inside_and_are_normalised() -> None:
    for text in (
        "/etc/passwd", "../a.png", "images/../../a.png", "..", "a\\..\\..\\b", "C:\\a.png", "/roots/a.png",
        "\\\\host\\share\\a.png", "", ".", "images/..", "a\0b", "a\nb", "a\x1b[2Jb", "\ud800", "\u2028",
    ):  # fmt: skip
        with pytest.raises(DataError, match="here: the path"):
            path_inside(Path("root"), "here", text)
    for text in (
        "images/a b.png",
        "./images/a b.png",
        "images//a b.png",
        ".\\images\\a b.png",
        "x/../images/a b.png",
    ):
        assert path_inside(Path("root"), "here", text) == ("images/a b.png", Path("root/images/a b.png"))


@pytest.mark.parametrize("field", [20, 24])
def test_an_archive_that_claims_more_than_the_file_holds_takes_no_memory(tmp_path: Path, field: int) -> None:
    """Packed and unpacked size stand in the directory at its end; a gigabyte is allowed for an array."""
    path = tmp_path / "a.npz"
    np.savez(path, xyz=np.arange(9.0))
    data = path.read_bytes()
    head = data.rfind(b"PK\x01\x02")
    path.write_bytes(data[: head + field] + struct.pack("<I", 1 << 30) + data[head + field + 4 :])
    tracemalloc.start()
    try:
        with pytest.raises(DataError, match=r"claims .* bytes, but the file has 3"):
            read_npz(path, "xyz")
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
    finally:
        tracemalloc.stop()


@given(st.integers(0, 999), st.floats(0, 4e-4))
def test_rounded_rotations_are_repaired(seed: int, amount: float) -> None:
    draw = np.random.default_rng(seed)
    exact = np.concatenate([rotations(draw.normal(size=(1, 3)))[0], draw.normal(size=(3, 1))], 1)
    noisy = exact.copy()
    noisy[:, :3] += amount * draw.uniform(-0.5, 0.5, (3, 3))
    repaired = rigid_pose("here", noisy)
    assert np.abs(repaired[:, :3].T @ repaired[:, :3] - np.eye(3)).max() < 1e-14
    assert np.abs(repaired - exact).max() <= 2 * amount + 1e-14
    assert np.array_equal(repaired[:, 3], exact[:, 3])
