import math
from dataclasses import replace

import pytest
import torch
from analytic import RADIUS, globe

from fprf.errors import DataError
from fprf.export.depth_maps import DepthMaps, surface_points
from fprf.export.point_cloud import Cloud, cells, concatenate, fuse, keys, overlapping_views


def fused(maps: DepthMaps, **changes: object) -> Cloud:
    options: dict[str, object] = {"edge": None, "most": 10**6, "tolerance": 0.02, "agree": 2, **changes}
    return fuse(maps, **options)  # type: ignore[arg-type]


def test_points_of_a_sphere_lie_on_it_and_look_outwards() -> None:
    maps = globe(8)
    cloud = fused(maps, edge=0.1)
    radius = cloud.point.norm(dim=-1)
    # The mean of points of one voxel lies inside of the sphere by at most the sagitta of its diagonal.
    assert float(radius.amin()) > RADIUS - (0.1 * math.sqrt(3) / 2) ** 2 / 2 - 1e-3 and float(radius.amax()) < RADIUS + 1e-3
    agree = (cloud.normal.double() * cloud.point).sum(-1) / radius
    assert float(agree.amin()) > 0.9 and float(agree.mean()) > 0.99
    assert torch.allclose(cloud.normal.norm(dim=-1), torch.ones(len(cloud.normal)), atol=1e-5)


def test_they_cover_it_evenly() -> None:
    """The band that the ring sees. A sphere meets 1.5 voxels an edge squared; pixels three quarters as wide miss corners."""
    cloud = fused(globe(8), edge=0.1)
    band = cloud.point[:, 2].abs() < 0.5
    area = 2 * math.pi * RADIUS * 1.0  # Archimedes: of a band of height 1
    assert 0.8 < int(band.sum()) * 0.1**2 / area < 1.5
    assert 0.6 < float((cloud.space / cloud.edge)[band].median()) < 1.3


def test_one_point_a_voxel_and_the_best_view() -> None:
    maps = globe(8, floor=-1.5)
    cloud = fused(maps, edge=0.15)
    local = cloud.point - cloud.point.mean(0)
    assert bool((cloud.edge == 0.15).any())
    for edge in cloud.edge.unique().tolist():
        mine = cloud.edge == edge
        # The lattice starts at a mean that the cloud no longer knows: pairs closer than a voxel are few, not none.
        key = keys(cells(local[mine], edge))
        assert len(key.unique()) > 0.6 * len(key)
    towards = torch.nn.functional.normalize(maps.cameras.pose[cloud.view, :, 3] - cloud.point, dim=-1)
    facing = (towards * cloud.normal.double()).sum(-1)
    assert float((facing > 0).double().mean()) > 0.99


def test_a_bound_on_the_number_of_points() -> None:
    maps = globe(8, floor=-1.5)
    every = fused(maps)
    few = fused(maps, most=500)
    assert 100 < len(few.point) <= 500 < len(every.point)
    assert float(few.edge.amin()) > float(every.edge.amin())


def test_what_one_view_alone_claims_is_dropped() -> None:
    """A view with a wall right before it: the others look through that wall."""
    maps = globe(8)
    wall = torch.full_like(maps.depth[3], 1.5)
    spoilt = maps._replace(depth=(*maps.depth[:3], wall, *maps.depth[4:]))
    assert len(surface_points(spoilt, 3).point) > 1000
    cloud = fused(spoilt, edge=0.1)
    assert float(cloud.point.norm(dim=-1).amax()) < RADIUS + 0.05
    assert not bool((cloud.view == 3).any())


def test_noise_within_the_tolerance_is_averaged() -> None:
    maps = globe(8)
    draw = torch.Generator().manual_seed(0)
    noisy = tuple(d * (1 + 0.005 * torch.randn(d.shape, generator=draw)) for d in maps.depth)
    cloud = fused(maps._replace(depth=noisy), edge=0.2)
    off = (cloud.point.norm(dim=-1) - RADIUS)[cloud.point[:, 2].abs() < 0.5]
    # 0.005 of 3 metres a pixel. Voxels before and behind the surface hold few pixels, those on it dozens.
    assert float(off.abs().median()) < 0.4 * 0.015 and float(off.std()) < 0.8 * 0.015


def test_views_that_agree_on_nothing() -> None:
    maps = globe(2)
    with pytest.raises(DataError, match=r"no surface that two views agree on.*--tolerance"):
        fused(maps._replace(depth=tuple(torch.full_like(d, 1.0 + k) for k, d in enumerate(maps.depth))))


def test_partners_are_those_that_see_the_same() -> None:
    maps = globe(8)
    found = overlapping_views(maps, 0, surface_points(maps, 0).point, 0.02)
    assert set(found[:2]) == {1, 7} and 0 not in found and 4 not in found


def test_it_is_the_same_far_from_the_origin() -> None:
    """World coordinates of a survey: 4.5e6 m from the origin."""
    maps = globe(6)
    shift = torch.tensor([4.5e6, 5e5, 200.0], dtype=torch.float64)
    pose = maps.cameras.pose
    moved = replace(maps.cameras, pose=torch.cat([pose[:, :, :3], (pose[:, :, 3] + shift)[:, :, None]], 2))
    here, there = fused(maps, edge=0.2), fused(maps._replace(cameras=moved), edge=0.2)
    assert abs(len(here.point) - len(there.point)) <= 0.02 * len(here.point)
    assert float((there.point - shift).norm(dim=-1).amax()) < RADIUS + 0.01


def test_joined() -> None:
    cloud = fused(globe(6), edge=0.3)
    both = concatenate(cloud, cloud)
    assert len(both.point) == 2 * len(cloud.point) == len(both.view)
