"""Point clouds fused from exact depth maps of a sphere: on it, even, bounded, with their sky, read again by trimesh."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from analytic import RADIUS, globe
from hypothesis import given
from hypothesis import strategies as st

from fprf.errors import DataError
from fprf.export.depth_maps import DepthMaps, surface_points
from fprf.export.point_cloud import (
    LEVELS,
    SPAN,
    Cloud,
    finest_only,
    fuse,
    keys,
    sky_dome,
    spacing,
    write_points,
)
from fprf.rendering.cameras import grid_rays
from fprf.rendering.local_frame import read_offset


def fused(maps: DepthMaps, edge: float = 0.2) -> Cloud:
    return fuse(maps, edge=edge, most=10**6, tolerance=0.02, agree=2)


def test_points_of_a_sphere_lie_on_it_and_look_outwards() -> None:
    maps = globe(8)
    cloud = fused(maps, edge=0.1)
    radius = cloud.point.norm(dim=-1)
    # The mean of points of one voxel lies inside of the sphere by at most the sagitta of its diagonal.
    assert float(radius.amin()) > RADIUS - (0.1 * math.sqrt(3) / 2) ** 2 / 2 - 1e-3 and float(radius.amax()) < RADIUS + 1e-3
    agree = (cloud.normal.double() * cloud.point).sum(-1) / radius
    assert float(agree.amin()) > 0.9 and float(agree.mean()) > 0.99
    assert torch.allclose(cloud.normal.norm(dim=-1), torch.ones(len(cloud.normal)), atol=1e-5)


def test_what_one_view_alone_claims_is_dropped() -> None:
    """A view with a wall right before it: the others look through that wall."""
    maps = globe(8)
    wall = torch.full_like(maps.depth[3], 1.5)
    spoilt = maps._replace(depth=(*maps.depth[:3], wall, *maps.depth[4:]))
    assert len(surface_points(spoilt, 3).point) > 1000
    cloud = fused(spoilt, edge=0.1)
    assert float(cloud.point.norm(dim=-1).amax()) < RADIUS + 0.05
    assert not bool((cloud.view == 3).any())


def test_points_are_bounded_in_number_and_none_is_an_error() -> None:
    maps = globe(6)
    assert 100 < len(fuse(maps, edge=None, most=300, tolerance=0.02, agree=2).point) <= 300
    nothing = tuple(torch.full_like(depth, torch.inf) for depth in maps.depth)
    with pytest.raises(DataError, match="no surface that two views agree on"):
        fused(maps._replace(depth=nothing))


def test_it_is_the_same_far_from_the_origin() -> None:
    """World coordinates of a survey: 4.5e6 m from the origin."""
    maps = globe(6)
    shift = torch.tensor([4.5e6, 5e5, 200.0], dtype=torch.float64)
    pose = maps.cameras.pose
    moved = replace(maps.cameras, pose=torch.cat([pose[:, :, :3], (pose[:, :, 3] + shift)[:, :, None]], 2))
    here, there = fused(maps), fused(maps._replace(cameras=moved))
    assert abs(len(here.point) - len(there.point)) <= 0.02 * len(here.point)
    assert float((there.point - shift).norm(dim=-1).amax()) < RADIUS + 0.01


seeds = st.integers(0, 2**31)


def drawn(seed: int, *shape: int) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@given(seed=seeds)
def test_keys_tell_voxels_and_levels_apart(seed: int) -> None:
    draw = torch.Generator().manual_seed(seed)
    cell = torch.randint(-2, 2, (60, 3), generator=draw) * torch.tensor([1, SPAN // 2 - 1, SPAN - 2]).roll(seed % 3)
    cell = cell.clamp(-SPAN + 1, SPAN - 1)
    level = torch.randint(0, LEVELS, (60,), generator=draw)
    key = keys(cell, level)
    same = (cell[:, None] == cell).all(-1) & (level[:, None] == level)
    assert torch.equal(key[:, None] == key, same)


@given(seed=seeds, edge=st.sampled_from([0.5, 1.0, 3.0]))
def test_spacing_is_the_mean_distance_to_the_nearest(seed: int, edge: float) -> None:
    """Against all pairs; one point a voxel, as it is used."""
    cell = torch.unique((drawn(seed, 80, 3) * 5).floor(), dim=0)
    points = (cell + drawn(seed + 1, len(cell), 3)) * edge - 2 * edge
    away = torch.linalg.vector_norm(points[:, None] - points, dim=-1)
    away.fill_diagonal_(torch.inf)
    nearest = torch.where(away <= 2 * edge, away, torch.inf).topk(4, largest=False).values.mean(-1)
    assert torch.allclose(spacing(points, torch.full((len(points),), edge, dtype=torch.float64)), nearest, rtol=1e-12)


def test_the_dome_lies_where_views_see_nothing() -> None:
    maps = globe(6)
    cloud = fused(maps)
    sky = sky_dome(maps, cloud)
    assert sky is not None
    centre = maps.cameras.pose[:, :, 3].mean(0)
    away = (sky.point - centre).norm(dim=-1)
    farthest = (cloud.point - centre).norm(dim=-1).amax()
    assert torch.allclose(away, 3 * farthest.expand(len(away)), rtol=1e-9)
    out = (sky.point - centre) / away[:, None]
    assert torch.allclose(sky.normal.double(), -out, atol=1e-6)
    assert float((sky.space / sky.edge).amin()) > 1
    for view, depth in enumerate(maps.depth):
        direction = grid_rays(maps.cameras, view)[1][depth.isinf().view(-1)]
        # Every direction of open sky has a point of the dome within a cell's diagonal, 2 pixels of 1/50 wide.
        assert float((direction @ out.T).amax(1).amin()) > 1 - (2 / 50 * 3**0.5) ** 2 / 2
    # ... and the view that is to colour it looks there.
    to = torch.nn.functional.normalize(out, dim=-1)
    ahead = -(maps.cameras.pose[sky.view, :, 2] * to).sum(-1)
    assert float(ahead.amin()) > 0.7


def test_far_from_0_positions_are_float64_or_local_with_a_file_that_says_so(tmp_path: Path) -> None:
    near = fused(globe(6))
    colour = torch.rand(len(near.point), 3)
    origin = (4_500_000.0, 500_000.0, 200.0)
    write_points(tmp_path / "world.ply", near, colour, origin)
    write_points(tmp_path / "local.ply", near, colour, origin, local=True)
    world, local = (trimesh.load(tmp_path / f"{name}.ply") for name in ("world", "local"))
    # float32 at 4.5e6 has steps of 0.5.
    assert np.abs(world.vertices - origin - near.point.numpy()).max() < 1e-8
    assert np.array_equal(local.vertices, near.point.float().numpy())
    assert np.array_equal(world.colors, local.colors)
    assert read_offset(tmp_path / "local.ply") == origin and read_offset(tmp_path / "world.ply") == (0, 0, 0)
    write_points(tmp_path / "local.ply", near, colour, (0.0, 0.0, 0.0))
    assert read_offset(tmp_path / "local.ply") == (0, 0, 0), "no offset of a file before is left"


@given(seed=seeds)
def test_coarse_points_give_way_to_finer_ones_in_their_voxel(seed: int) -> None:
    points = drawn(seed, 60, 3) * 8
    level = torch.randint(0, 3, (60,), generator=torch.Generator().manual_seed(seed))
    alone = finest_only(points, level, 1.0)
    for i in range(60):
        edge = 2.0 ** int(level[i])
        inside = (torch.floor(points / edge) == torch.floor(points[i] / edge)).all(-1)
        assert bool(alone[i]) == (not bool((inside & (level < level[i])).any()))
