import pytest
import torch

from fprf.rendering.cameras import Cameras, normals, pixel_grid, rays_through
from fprf.rendering.paths import look_at, panoramas, pinhole


def camera(width: int = 40, height: int = 30) -> Cameras:
    place, aim = (torch.tensor([p], dtype=torch.float64) for p in ((0.0, 0, 2), (5.0, 1, 1)))
    return pinhole(look_at(place, aim, torch.tensor([0.0, 0, 1]).double()), width=width, height=height, fov=60)


def plane_depth(cameras: Cameras, normal: torch.Tensor, offset: float) -> torch.Tensor:
    """Distance along each ray to the plane normal . x = offset; infinite where it is missed."""
    pixel = pixel_grid(cameras, 0)
    origin, direction = rays_through(cameras, torch.zeros(len(pixel), dtype=torch.int64), pixel)
    depth = (offset - origin @ normal) / (direction @ normal)
    width, height = cameras.size[0].tolist()
    return torch.where(depth > 0, depth, torch.inf).view(height, width)


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (-1.0, 0.2, 0.1), (-0.6, 0.0, 0.8)])
def test_a_plane_has_its_normal_everywhere(normal: tuple[float, float, float]) -> None:
    unit = torch.nn.functional.normalize(torch.tensor(normal, dtype=torch.float64), dim=0)
    for cameras in (camera(), panoramas(camera(), 48, torch.tensor([0.0, 0, 1]).double())):
        depth = plane_depth(cameras, unit, float(unit @ torch.tensor([5.0, 0, 0], dtype=torch.float64)))
        found = normals(cameras, 0, depth)
        seen = found.norm(dim=-1) > 0
        assert int(seen.sum()) >= 0.9 * int(torch.isfinite(depth).sum())
        assert torch.allclose(found[seen], unit.float().expand_as(found[seen]), atol=1e-4)
        assert not found[~torch.isfinite(depth)].any()


@pytest.mark.parametrize("around", [False, True])
def test_whatever_the_depths_normals_face_the_camera(around: bool) -> None:
    cameras = panoramas(camera(), 48, torch.tensor([0.0, 0, 1]).double()) if around else camera()
    width, height = cameras.size[0].tolist()
    found = normals(cameras, 0, torch.rand(height, width, generator=torch.Generator().manual_seed(0)) * 3 + 0.1)
    pixel = pixel_grid(cameras, 0)
    _, direction = rays_through(cameras, torch.zeros(len(pixel), dtype=torch.int64), pixel)
    assert ((found.view(-1, 3).double() * direction).sum(-1) < 1e-6).all() and (found.norm(dim=-1) > 0.99).all()


@pytest.mark.parametrize("size", [1e-6, 1e6])
def test_units_do_not_matter(size: float) -> None:
    cameras, wall = camera(), torch.tensor([-0.8, 0.6, 0.0], dtype=torch.float64)
    offset = float(wall @ cameras.pose[0, :, 3]) - 2 * size
    found = normals(cameras, 0, plane_depth(cameras, wall, offset))
    assert torch.allclose(found, wall.float().expand_as(found), atol=1e-3 if size < 1 else 1e-5)


@pytest.mark.parametrize(("width", "height"), [(1, 9), (9, 1), (1, 1)])
def test_a_line_of_pixels_has_no_normals(width: int, height: int) -> None:
    assert torch.equal(normals(camera(width, height), 0, torch.ones(height, width)), torch.zeros(height, width, 3))


def test_an_edge_belongs_to_one_of_its_sides() -> None:
    cameras = camera()
    wall = torch.tensor([-1.0, 0, 0], dtype=torch.float64)
    depth = plane_depth(cameras, wall, -9.0)
    depth[:, :20] = plane_depth(cameras, wall, -4.0)[:, :20]
    found = normals(cameras, 0, depth)
    assert torch.allclose(found, wall.float().expand_as(found), atol=1e-4), "no slanted line where two walls seem to meet"


def test_what_is_not_known_is_nothing() -> None:
    cameras = camera()
    depth = torch.full((30, 40), 3.0)
    depth[5, 5], depth[6, 6], depth[7, 7] = 0.0, torch.nan, torch.inf
    depth[10, :] = torch.inf
    depth[12, :] = torch.inf
    found = normals(cameras, 0, depth)
    assert torch.isfinite(found).all() and not found[[5, 6, 7], [5, 6, 7]].any()
    assert not found[11].any(), "a single row has no neighbour below or above"
