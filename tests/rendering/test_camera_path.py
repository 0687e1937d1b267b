import json
import math
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fprf.errors import DataError
from fprf.rendering.camera_path import read_camera_path, write_camera_path
from fprf.rendering.paths import look_at, pinhole

IDENTITY = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]


def file(path: Path, **changes: Any) -> Path:
    frame = {"camera_to_world": IDENTITY, "fov": 90.0, "aspect": 1.5}
    content = {"render_width": 300, "render_height": 200, "camera_path": [frame], **changes}
    path.write_text(json.dumps(content))
    return path


@settings(max_examples=15)
@given(st.integers(1, 6), st.floats(20, 4000), st.floats(1, 120), st.integers(0, 99))
def test_what_is_written_reads_back(
    tmp_path_factory: pytest.TempPathFactory, count: int, focal: float, fps: float, seed: int
) -> None:
    draw = torch.Generator().manual_seed(seed)
    position = torch.randn(count, 3, dtype=torch.float64, generator=draw)
    pose = look_at(position, position + torch.randn(count, 3, dtype=torch.float64, generator=draw), torch.eye(3).double()[2])
    cameras = pinhole(pose, width=320, height=240, fov=math.degrees(2 * math.atan(120 / focal)))
    path = tmp_path_factory.getbasetemp() / "path.json"
    write_camera_path(path, cameras, fps)
    found, rate = read_camera_path(path)
    assert rate == fps
    torch.testing.assert_close(found.pose, cameras.pose, atol=1e-12, rtol=0)
    torch.testing.assert_close(found.focal, cameras.focal, atol=0, rtol=1e-9)
    assert torch.equal(found.centre, cameras.centre) and torch.equal(found.size, cameras.size)


def test_a_file_as_the_viewer_exports_it(tmp_path: Path) -> None:
    cameras, fps = read_camera_path(file(tmp_path / "p.json", camera_type="perspective", seconds=4, keyframes=[{}]))
    assert fps == 24 and cameras.focal.tolist() == [[pytest.approx(100.0)] * 2]
    assert cameras.centre.tolist() == [[150, 100]] and cameras.size.tolist() == [[300, 200]]
    rows = [IDENTITY[:4], IDENTITY[4:8], IDENTITY[8:12], IDENTITY[12:]]
    nested = file(tmp_path / "q.json", fps=30, camera_path=[{"camera_to_world": rows, "fov": 90}])
    again, fps = read_camera_path(nested)
    assert fps == 30 and torch.equal(again.pose, cameras.pose)


def test_a_rounded_rotation_is_made_exact(tmp_path: Path) -> None:
    turned = [0.70711, -0.70711, 0, 1, 0.70711, 0.70711, 0, 2, 0, 0, 1, 3, 0, 0, 0, 1]
    cameras, _ = read_camera_path(file(tmp_path / "p.json", camera_path=[{"camera_to_world": turned, "fov": 60}]))
    rotation = cameras.pose[0, :, :3]
    assert float((rotation.T @ rotation - torch.eye(3)).abs().max()) < 1e-14
    assert cameras.pose[0, :, 3].tolist() == [1, 2, 3]


FRAME = {"camera_to_world": IDENTITY, "fov": 60}


WRONG = [("camera_type", "equirectangular"), ("render_width", 0), ("render_width", 10**400), ("fps", 0), ("camera_path", [])]
WRONG_FRAMES = [{"fov": 60}, {**FRAME, "fov": 180}]
# letters, what is too large, a scale, a mirroring
WRONG_FRAMES += [{**FRAME, "camera_to_world": [first, *IDENTITY[1:]]} for first in ("x", 10**400, 2, -1)]


@pytest.mark.parametrize(
    ("name", "value", "told"),
    [(name, value, name) for name, value in WRONG]
    + [("camera_path", [FRAME, frame], r"camera_path\[1\]") for frame in WRONG_FRAMES]
    + [("render_height", value, "cannot be read") for value in (math.inf, math.nan)],
)
def test_what_is_wrong_is_named(tmp_path: Path, name: str, value: object, told: str) -> None:
    with pytest.raises(DataError, match=told):
        read_camera_path(file(tmp_path / "p.json", **{name: value}))
