"""The table of pixel rays is `rays_through`, looked up."""

from dataclasses import replace

import pytest
import torch
from pretend_cuda import CUDA, pretend_cuda
from torch import Tensor

from fprf.rendering.cameras import LIMIT, Cameras, PixelRays, grid_rays, pixel_grid, rays_through
from fprf.rendering.lens import FISHEYE, OPENCV, PINHOLE

K = {PINHOLE: [0.0] * 6, OPENCV: [0.05, -0.08, 0.01, 0.0, -0.001, 0.0002], FISHEYE: [0.05, -0.01, 0.002, 0.0, 0.0, 0.0]}


def rig(lenses: list[int], sizes: list[tuple[int, int]], offset: float = 0.0) -> Cameras:
    count, draw = len(lenses), torch.Generator().manual_seed(0)
    turn, _ = torch.linalg.qr(torch.randn(count, 3, 3, dtype=torch.float64, generator=draw))
    turn = turn * torch.linalg.det(turn)[:, None, None]
    place = torch.randn(count, 3, 1, dtype=torch.float64, generator=draw) + offset
    size = torch.tensor(sizes)
    return Cameras(
        pose=torch.cat([turn, place], -1),
        focal=torch.full((count, 2), 20.0, dtype=torch.float64),
        centre=size.double() / 2,
        size=size,
        distortion=torch.tensor([K[lens] for lens in lenses], dtype=torch.float64),
        lens=torch.tensor(lenses),
    )


def every_pixel(cameras: Cameras) -> tuple[Tensor, Tensor]:
    grids = [pixel_grid(cameras, v) for v in range(len(cameras))]
    return torch.cat([torch.full((len(g),), v) for v, g in enumerate(grids)]), torch.cat(grids)


MIXED = ([PINHOLE, OPENCV, FISHEYE, OPENCV, PINHOLE], [(9, 6), (12, 5), (7, 7), (12, 5), (6, 9)])


@pytest.mark.parametrize("offset", [0.0, 4.5e6])
@pytest.mark.parametrize("limit", [LIMIT, 0])
def test_every_pixel_of_mixed_cameras(offset: float, limit: int) -> None:
    cameras = rig(*MIXED, offset=offset)
    rays = PixelRays(cameras, limit=limit)
    view, pixel = every_pixel(cameras)
    origin, direction = rays(view, pixel)
    wanted_origin, wanted = rays_through(cameras, view, pixel)
    assert origin.dtype == direction.dtype == torch.float64
    assert torch.equal(origin, wanted_origin)
    assert (direction - wanted).abs().max() <= 1e-14
    assert (direction.norm(dim=-1) - 1).abs().max() <= 1e-14


def test_no_pixels() -> None:
    rays = PixelRays(rig([PINHOLE], [(4, 4)]))
    origin, direction = rays(torch.zeros(0, dtype=torch.int64), torch.zeros(0, 2))
    assert origin.shape == direction.shape == (0, 3)


@pytest.mark.parametrize("offset", [0.0, 4.5e6])
def test_whole_views_of_mixed_cameras(offset: float) -> None:
    """Twice, in turn: what is remembered of one lens must not be taken for another's, nor one place for another."""
    cameras = rig(*MIXED, offset=offset)
    for view in (*range(len(cameras)), *range(len(cameras))):
        pixel = pixel_grid(cameras, view)
        origin, direction = grid_rays(cameras, view)
        wanted_origin, wanted = rays_through(cameras, torch.full((len(pixel),), view), pixel)
        assert torch.equal(origin, wanted_origin) and origin.dtype == direction.dtype == torch.float64
        assert (direction - wanted).abs().max() <= 1e-14


def test_a_lens_that_differs_in_anything_is_another() -> None:
    base = rig([OPENCV], [(12, 5)])
    changed = [
        replace(base, focal=base.focal * 1.01),
        replace(base, centre=base.centre + 0.5),
        replace(base, distortion=base.distortion * 0.5),
        replace(base, lens=torch.tensor([FISHEYE])),
        base.resized(torch.tensor([[24, 10]])),
    ]
    _, known = grid_rays(base, 0)
    for other in changed:
        pixel = pixel_grid(other, 0)
        _, found = grid_rays(other, 0)
        assert (found - rays_through(other, torch.zeros(len(pixel), dtype=torch.int64), pixel)[1]).abs().max() <= 1e-14
        assert found.shape != known.shape or (found - known).abs().max() > 1e-4


def test_rays_of_a_view_are_made_on_the_device() -> None:
    cameras = rig(*MIXED)
    expected = grid_rays(cameras, 1)
    with pretend_cuda():
        found = grid_rays(cameras, 1, CUDA)
        assert all(x.device == CUDA for x in found)
        assert all(torch.equal(a, b.cpu()) for a, b in zip(expected, found, strict=True))
