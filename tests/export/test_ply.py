from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from splatter import table

from fprf.export.point_cloud import write_ply

KINDS = ("f4", "f8", "u1", "i4")


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 2**31), kinds=st.lists(st.sampled_from(KINDS), min_size=1, max_size=6), count=st.integers(0, 9))
def test_columns_come_back_bit_for_bit(
    tmp_path_factory: pytest.TempPathFactory, seed: int, kinds: list[str], count: int
) -> None:
    draw = np.random.default_rng(seed)
    columns = {f"c{i}": (draw.normal(size=count) * 100).astype(f"<{kind}") for i, kind in enumerate(kinds)}
    path = tmp_path_factory.mktemp("ply") / "x.ply"
    write_ply(path, columns)
    found = table(path.read_bytes())
    assert found.dtype.names == tuple(columns)
    assert all(np.array_equal(found[name], column) for name, column in columns.items())


def test_trimesh_reads_a_mesh_with_normals_and_colours(tmp_path: Path) -> None:
    draw = np.random.default_rng(0)
    point = draw.normal(size=(5, 3)).astype(np.float32)
    colour = draw.integers(0, 256, (5, 3)).astype(np.uint8)
    faces = np.array([[0, 1, 2], [2, 3, 4]], dtype=np.int32)
    path = tmp_path / "mesh.ply"
    columns = dict(zip("xyz", point.T, strict=True)) | dict(zip(("red", "green", "blue"), colour.T, strict=True))
    write_ply(path, columns, faces, comments=["made for a test"])
    found = trimesh.load(path, process=False)
    assert np.array_equal(found.vertices, point) and np.array_equal(found.faces, faces)
    assert np.array_equal(found.visual.vertex_colors[:, :3], colour)
    assert b"\ncomment made for a test\n" in path.read_bytes()


def test_trimesh_reads_points(tmp_path: Path) -> None:
    point = np.arange(12, dtype=np.float32).reshape(4, 3)
    shade = np.arange(12, dtype=np.uint8).reshape(4, 3)
    columns = dict(zip("xyz", point.T, strict=True)) | dict(zip(("red", "green", "blue"), shade.T, strict=True))
    write_ply(tmp_path / "points.ply", columns)
    found = trimesh.load(tmp_path / "points.ply")
    assert np.array_equal(found.vertices, point) and np.array_equal(found.colors[:, :3], shade)


def test_a_failed_write_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(KeyError):
        write_ply(tmp_path / "x.ply", {"z": np.zeros(3, dtype="c16")})
    assert list(tmp_path.iterdir()) == []
