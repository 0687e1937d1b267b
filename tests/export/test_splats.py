"""Discs as 3D Gaussians, in both formats, read and drawn by `splatter`."""

from pathlib import Path

import numpy as np
import pytest
import torch
from analytic import globe
from hypothesis import given
from hypothesis import strategies as st
from splatter import draw, matrices, read_gaussians, read_splat, table

from fprf.export.point_cloud import Cloud, fuse
from fprf.export.splats import rotation_to_normal, surface_discs, write_gaussians, write_splat
from fprf.rendering.local_frame import read_offset

ZERO = (0.0, 0.0, 0.0)
STANDARD = ["x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3)), "opacity"]
STANDARD += [*(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]  # Kerbl et al., degree 0


@pytest.fixture(scope="module")
def cloud() -> Cloud:
    return fuse(globe(8), edge=0.2, most=10**6, tolerance=0.02, agree=2)


@given(seed=st.integers(0, 2**31))
def test_turns_bring_the_z_axis_to_the_normal(seed: int) -> None:
    drawn = torch.randn(20, 3, generator=torch.Generator().manual_seed(seed)).double()
    poles = torch.tensor([[0, 0, 1.0], [0, 0, -1.0], [0, 1e-4, -1.0]]).double()
    normal = torch.nn.functional.normalize(torch.cat([drawn, poles]), dim=-1)
    turn = rotation_to_normal(normal)
    assert torch.allclose(turn.norm(dim=-1), torch.ones(23).double())
    axis = torch.from_numpy(matrices(turn.numpy())[:, :, 2])
    assert torch.allclose(axis, normal, atol=1e-6)


def test_both_files_hold_the_same_gaussians(cloud: Cloud, tmp_path: Path) -> None:
    splats = surface_discs(cloud)._replace(opacity=torch.linspace(0.2, 0.99, len(cloud.point)))
    colour = torch.rand(len(cloud.point), 3)
    origin = (500_000.0, -2.0, 5_600_000.5)
    write_gaussians(tmp_path / "g.ply", splats, colour, origin)
    write_splat(tmp_path / "g.splat", splats, colour, origin)
    data = (tmp_path / "g.ply").read_bytes()
    assert list(table(data).dtype.names or ()) == STANDARD and table(data).dtype["x"] == np.float64
    ply, splat = read_gaussians(data), read_splat((tmp_path / "g.splat").read_bytes())
    assert np.allclose(ply.at - origin, cloud.point.numpy(), atol=1e-6)
    assert np.allclose(ply.deviation, splats.deviation.numpy(), rtol=1e-5)
    assert np.allclose(ply.colour, colour.numpy(), atol=1e-6)
    assert np.allclose(ply.opacity, splats.opacity.numpy(), atol=1e-5)
    match = (splats.deviation.prod(1) * splats.opacity).argsort(descending=True).numpy()  # the largest first
    assert np.array_equal(np.float32(splat.at), np.float32(ply.at - origin)[match])
    assert read_offset(tmp_path / "g.splat") == origin
    assert np.abs(splat.colour - ply.colour[match]).max() <= 0.5 / 255 + 1e-6
    assert np.abs(splat.opacity - ply.opacity[match]).max() <= 0.5 / 255 + 1e-5
    # 8 bits a component: half a step of 1/128 each, in four of them.
    turned = np.abs((splat.turn * ply.turn[match]).sum(1))
    assert turned.min() > np.cos(2 * 0.5 / 128)


def test_discs_leave_no_holes(cloud: Cloud, tmp_path: Path) -> None:
    """A white sphere on black: opaque where it is seen head-on, empty where it is not."""
    maps = globe(8)
    write_gaussians(tmp_path / "g.ply", surface_discs(cloud), torch.ones(len(cloud.point), 3), ZERO)
    pose = maps.cameras.pose[2].numpy()
    image, covered = draw(read_gaussians((tmp_path / "g.ply").read_bytes()), pose, 50.0, (48, 40))
    sees = maps.depth[2].isfinite().numpy()
    inner = sees & np.roll(sees, 2, 0) & np.roll(sees, -2, 0) & np.roll(sees, 2, 1) & np.roll(sees, -2, 1)
    assert covered[inner].min() > 0.88 and image[inner].min() > 0.88
    outer = ~(sees | np.roll(sees, 4, 0) | np.roll(sees, -4, 0) | np.roll(sees, 4, 1) | np.roll(sees, -4, 1))
    assert covered[outer].max() < 0.1
