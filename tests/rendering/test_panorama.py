import math

import pytest
import torch

from fprf.rendering.cameras import Cameras, pixel_grid, project, rays_through, sees
from fprf.rendering.lens import PANORAMA
from fprf.rendering.paths import eye_strips, look_at, panoramas, pinhole

UP = torch.tensor([0.0, 0, 2], dtype=torch.float64)


def looking(*target: float) -> Cameras:
    place = torch.tensor([[1.0, 2, 3]], dtype=torch.float64)
    aim = place + torch.tensor([target], dtype=torch.float64)
    return pinhole(look_at(place, aim, UP), width=40, height=30, fov=50)


def rays(cameras: Cameras, view: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    pixel = pixel_grid(cameras, view)
    return rays_through(cameras, torch.full((len(pixel),), view), pixel)


def test_pixels_are_angles() -> None:
    camera = panoramas(looking(1, 0, 0.4), 64, UP)
    assert camera.lens.tolist() == [PANORAMA] and camera.size.tolist() == [[64, 32]]
    _, direction = rays(camera)
    direction = direction.view(32, 64, 3)
    longitude = ((torch.arange(64) + 0.5) / 64 - 0.5) * 2 * math.pi
    latitude = (0.5 - (torch.arange(32) + 0.5) / 32) * math.pi
    # It looks along +x, level; right is -y, up is +z.
    expected = torch.stack(
        [
            latitude.cos()[:, None] * longitude.cos(),
            -latitude.cos()[:, None] * longitude.sin(),
            latitude.sin()[:, None].expand(32, 64),
        ],
        -1,
    )
    assert torch.allclose(direction, expected.double(), atol=1e-6)


def test_all_directions_come_back_to_their_pixels() -> None:
    camera = panoramas(looking(0.3, 1, -0.2), 48, UP)
    pixel, view = pixel_grid(camera, 0), torch.zeros(48 * 24, dtype=torch.int64)
    origin, direction = rays_through(camera, view, pixel)
    back, _ = project(camera, view, origin + 7 * direction)
    assert torch.allclose(back, pixel, atol=1e-9) and bool(sees(camera, view, pixel).all())
    assert torch.allclose(direction.norm(dim=-1), torch.ones(len(pixel), dtype=torch.float64))
    # Every part of the sphere is covered alike, per solid angle.
    weight = torch.cos((pixel[:, 1] / 24 - 0.5) * math.pi)
    assert (weight[:, None] * direction).sum(0).norm() / weight.sum() < 1e-9


@pytest.mark.parametrize("target", [(0.0, 0.0, 1.0), (0.0, 0.0, -1.0)])
def test_a_camera_that_looks_along_up_still_gives_a_level_one(target: tuple[float, float, float]) -> None:
    camera = panoramas(looking(*target), 16, UP)
    assert torch.allclose(camera.pose[0, :, 1], UP / 2, atol=1e-9)
    assert float(torch.linalg.det(camera.pose[0, :, :3])) == pytest.approx(1)


def test_eyes_look_where_the_panorama_does_from_a_circle() -> None:
    camera = panoramas(looking(1, 0, 0), 30, UP)
    _, whole = rays(camera)
    for offset in (-0.03, 0.03):
        strips = eye_strips(camera, offset)
        assert strips.size[:, 0].sum() == 30 and set(strips.size[:, 1].tolist()) == {15}
        columns, places = [], []
        for k in range(len(strips)):
            origin, direction = rays(strips, k)
            columns.append(direction.view(15, -1, 3))
            places.append(origin[0])
        assert torch.allclose(torch.cat(columns, 1).reshape(-1, 3), whole, atol=1e-12)
        for place, column in zip(places, columns, strict=True):
            away = place - camera.pose[0, :, 3]
            ahead = torch.nn.functional.normalize(column[7].mean(0) * torch.tensor([1.0, 1, 0]), dim=0)
            assert float(away.norm()) == pytest.approx(0.03)
            right = torch.linalg.cross(ahead, torch.tensor([0.0, 0, 1], dtype=torch.float64))
            assert torch.allclose(away, offset * right, atol=1e-9), "the eye is beside where it looks"
