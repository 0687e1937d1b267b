from pathlib import Path

import numpy as np
import torch
import trimesh
from analytic import globe

from fprf.export.point_cloud import fuse, origin_comment, origin_of, write_points


def test_trimesh_reads_points_colours_and_normals(tmp_path: Path) -> None:
    cloud = fuse(globe(6), edge=0.2, most=10**6, tolerance=0.02, agree=2)
    colour = torch.rand(len(cloud.point), 3)
    origin = origin_of(cloud)
    assert not bool(origin.any()) and origin_comment(origin) == []
    write_points(tmp_path / "points.ply", cloud, colour, origin)
    found = trimesh.load(tmp_path / "points.ply")
    assert np.array_equal(found.vertices, cloud.point.float().numpy())
    assert np.array_equal(found.colors[:, :3], (colour * 255 + 0.5).to(torch.uint8).numpy())
    raw = found.metadata["_ply_raw"]["vertex"]["data"]
    assert np.array_equal(np.stack([raw[name].ravel() for name in ("nx", "ny", "nz")], 1), cloud.normal.numpy())


def test_far_from_its_origin_a_capture_is_moved_and_the_file_says_so(tmp_path: Path) -> None:
    near = fuse(globe(6), edge=0.2, most=10**6, tolerance=0.02, agree=2)
    shift = torch.tensor([4_500_000.0, 500_000.0, 200.0], dtype=torch.float64)
    far = near._replace(point=near.point + shift)
    origin = origin_of(far)
    assert bool(origin.any()) and torch.equal(origin, origin.round())
    write_points(tmp_path / "points.ply", far, torch.rand(len(far.point), 3), origin)
    found = trimesh.load(tmp_path / "points.ply")
    # float32 at 4.5e6 has steps of 0.5; here the grain is that of coordinates of some metres.
    assert np.abs(found.vertices + origin.numpy() - far.point.numpy()).max() < 1e-6
    assert f"comment {origin_comment(origin)[0]}".encode() in (tmp_path / "points.ply").read_bytes()
    assert all(f"{value:.0f}" in origin_comment(origin)[0] for value in origin.tolist())
