"""Poses made exact, sizes and numbers checked."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from capture_files import rotations, write_image
from hypothesis import given, settings
from hypothesis import strategies as st

from fprf.datamanagers.parsers.views import View, assemble, found, rigid
from fprf.errors import DataError


def pose(seed: int = 0) -> np.ndarray:
    draw = np.random.default_rng(seed)
    return np.concatenate([rotations(draw.normal(size=(1, 3)))[0], draw.normal(size=(3, 1))], 1)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 999), st.floats(0, 4e-4))
def test_rounded_rotations_are_repaired(seed: int, amount: float) -> None:
    exact = pose(seed)
    noisy = exact.copy()
    noisy[:, :3] += amount * np.random.default_rng(seed).uniform(-0.5, 0.5, (3, 3))
    repaired = rigid("here", noisy)
    assert np.abs(repaired[:, :3].T @ repaired[:, :3] - np.eye(3)).max() < 1e-14
    assert np.abs(repaired - exact).max() <= 2 * amount + 1e-14
    assert np.array_equal(repaired[:, 3], exact[:, 3])


def test_a_last_row_is_accepted_and_checked() -> None:
    whole = np.concatenate([pose(), [[0, 0, 0, 1]]])
    assert np.allclose(rigid("here", whole), pose(), atol=1e-14)
    whole[3, 3] = 2
    with pytest.raises(DataError, match="last row"):
        rigid("here", whole)


@pytest.mark.parametrize(
    ("change", "finding"),
    [
        (lambda p: p * 1.01, "no rotation"),
        (lambda p: p * [[1], [1], [-1]], "reflection"),
        (lambda p: p * 0, "no rotation"),
        (lambda p: p * 1e200, "no rotation"),
        (lambda p: p + np.array([0, 0, 0, 1e13]), "position .* lies beyond"),
        (lambda p: p * np.nan, "no finite"),
        (lambda p: p + np.inf, "no finite"),
        (lambda p: p[:2], "no finite 3x4"),
    ],
)
def test_other_matrices_are_refused(change: object, finding: str) -> None:
    with pytest.raises(DataError, match=f"^frame 7: .*{finding}"):
        rigid("frame 7", change(pose()))  # type: ignore[operator]


def view(folder: Path, name: str = "a.png", **fields: object) -> View:
    if not (folder / name).exists():
        write_image(folder / name, (24, 16))
    whole = View(name=name, path=folder / name, pose=pose(), size=(24, 16), focal=(20.0, 21.0), centre=(12.5, 8.0))
    return replace(whole, **fields)  # type: ignore[arg-type]


def test_a_scene_has_what_its_views_have(tmp_path: Path) -> None:
    views = [view(tmp_path, f"{k}.png", depths=(1.0, 2.0 + k)) for k in range(9)]
    scene = assemble(tmp_path, views, downscale=1, points=np.ones((4, 3)))
    assert scene.name == tmp_path.name and scene.paths == tuple(v.path for v in views)
    assert scene.cameras.focal[3].tolist() == [20.0, 21.0] and scene.cameras.centre[3].tolist() == [12.5, 8.0]
    assert scene.cameras.pose.dtype == torch.float64 and scene.cameras.size.dtype == torch.int64
    assert scene.test.tolist() == [0, 8] and not scene.alpha
    assert scene.depths is not None and scene.depths[8].tolist() == [1.0, 10.0]
    assert scene.points is not None and scene.points.shape == (4, 3)


def test_depths_are_all_or_none_and_no_points_are_none(tmp_path: Path) -> None:
    views = [view(tmp_path, "a.png", depths=(1.0, 2.0)), view(tmp_path, "b.png")]
    scene = assemble(tmp_path, views, downscale=1, points=np.zeros((0, 3)))
    assert scene.depths is None and scene.points is None


@pytest.mark.parametrize("downscale", [2, 3, 5, 1000])
def test_downscaling_keeps_the_exact_ratio(tmp_path: Path, downscale: int) -> None:
    cameras = assemble(tmp_path, [view(tmp_path)], downscale=downscale).cameras
    size = [max(1, round(24 / downscale)), max(1, round(16 / downscale))]
    assert cameras.size[0].tolist() == size
    assert cameras.focal[0].tolist() == pytest.approx([20 * size[0] / 24, 21 * size[1] / 16], rel=1e-15)
    assert cameras.centre[0].tolist() == pytest.approx([12.5 * size[0] / 24, 8 * size[1] / 16], rel=1e-15)


def test_reduced_images_scale_the_cameras(tmp_path: Path) -> None:
    whole = view(tmp_path, size=(97, 65), centre=(48.5, 32.5))
    cameras = assemble(tmp_path, [whole], downscale=1, reduced=True).cameras
    assert cameras.size[0].tolist() == [24, 16]
    assert cameras.centre[0].tolist() == [12.0, 8.0]
    assert cameras.focal[0].tolist() == pytest.approx([20 * 24 / 97, 21 * 16 / 65])


@pytest.mark.parametrize(
    ("fields", "reduced", "finding"),
    [
        ({"size": (48, 32)}, False, "24x16 pixels, but its camera has 48x32"),
        ({"size": (16, 24)}, True, "24x16 pixels, but its camera has 16x24"),
        ({"focal": (0.0, 1.0)}, False, "focal length is 0.0"),
        ({"focal": (1.0, -1.0)}, False, "focal length is -1.0"),
        ({"focal": (float("nan"), 1.0)}, False, "not all finite"),
        ({"centre": (float("inf"), 1.0)}, False, "not all finite"),
        ({"distortion": (1e300, 0.0, 0.0, 0.0, 0.0, 0.0)}, False, "not all finite and sane"),
        ({"depths": (2.0, 1.0)}, False, "0 < near < far"),
        ({"depths": (0.0, 1.0)}, False, "0 < near < far"),
        ({"depths": (1.0, float("inf"))}, False, "0 < near < far"),
    ],
)
def test_views_that_cannot_be_are_named(tmp_path: Path, fields: dict[str, object], reduced: bool, finding: str) -> None:
    with pytest.raises(DataError, match=finding) as caught:
        assemble(tmp_path, [view(tmp_path, **fields)], downscale=1, reduced=reduced)
    assert "a.png" in str(caught.value)


def test_missing_images_are_counted_and_named(tmp_path: Path) -> None:
    write_image(tmp_path / "b.png", (4, 4))
    with pytest.raises(DataError, match=r"2 of 3 images are missing, the first is .*a\.png"):
        found(tmp_path, [tmp_path / name for name in ("a.png", "b.png", "c.png")])


def test_transparency_is_noticed(tmp_path: Path) -> None:
    write_image(tmp_path / "a.png", (24, 16), channels=4)
    assert assemble(tmp_path, [view(tmp_path)], downscale=1).alpha
