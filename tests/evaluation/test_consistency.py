"""Frames against each other: what is consistent scores nothing, faults score by their size."""

import math
from dataclasses import replace

import pytest
import torch

from fprf.errors import DataError, NumericsError
from fprf.evaluation.metrics import WarpError, warp
from fprf.rendering.cameras import Cameras, pixel_grid, rays_through
from fprf.rendering.paths import look_at, pinhole

WIDTH, HEIGHT = 48, 36


def row_of_cameras(count: int, step: float = 0.1) -> Cameras:
    """Side by side at z = 3, all looking at the origin."""
    x = (torch.arange(count, dtype=torch.float64) - (count - 1) / 2) * step
    position = torch.stack([x, 0.2 * x, torch.full_like(x, 3.0)], -1)
    pose = look_at(position, torch.zeros_like(position), torch.tensor([0.0, 1, 0], dtype=torch.float64))
    cameras = pinhole(pose, width=WIDTH, height=HEIGHT, fov=math.degrees(2 * math.atan(HEIGHT / 2 / 50)))
    return replace(cameras, centre=torch.tensor([[24.3, 17.6]], dtype=torch.float64).repeat(count, 1))


def paint(points: torch.Tensor) -> torch.Tensor:
    """Colours of a place: smooth, within [0, 1]."""
    x, y, z = points.unbind(-1)
    return torch.stack([0.5 + 0.4 * torch.sin(x), 0.5 + 0.4 * torch.cos(1.3 * y), 0.5 + 0.3 * torch.sin(x + z)], -1)


def seen(cameras: Cameras, view: int, *, plate: bool = False) -> tuple[torch.Tensor, torch.Tensor]:
    """Image and distance of the plane z = 0, with a small white plate at z = 1.5 before it if asked for."""
    pixel = pixel_grid(cameras, view)
    origin, direction = rays_through(cameras, torch.full((len(pixel),), view), pixel)
    distance = -origin[:, 2] / direction[:, 2]
    colour = paint(origin + direction * distance[:, None])
    if plate:
        near = (1.5 - origin[:, 2]) / direction[:, 2]
        hit = (origin + direction * near[:, None])[:, :2].abs().amax(-1) < 0.2
        distance = torch.where(hit, near, distance)
        colour = torch.where(hit[:, None], torch.ones_like(colour), colour)
    return colour.reshape(HEIGHT, WIDTH, 3).float(), distance.reshape(HEIGHT, WIDTH).float()


def consistency(
    images: list[torch.Tensor], depths: list[torch.Tensor], cameras: Cameras, pairs: list[tuple[int, int]]
) -> dict[str, float | int | None]:
    error = WarpError(cameras)
    for a, b in pairs:
        error.add(a, b, images[a], images[b], depths[a], depths[b])
    return error.summary()


@pytest.mark.parametrize("lens", [0, 1, 2])
def test_a_plane_warps_exactly_to_interpolation(lens: int) -> None:
    cameras = row_of_cameras(2, step=0.6)
    bent = torch.tensor([0.05, -0.01, 0, 0, 1e-3, -1e-3] if lens == 1 else [0.02, 0, 0, 0, 0, 0], dtype=torch.float64)
    cameras = replace(cameras, lens=torch.full((2,), lens), distortion=(bent * (lens > 0)).repeat(2, 1))
    (image_a, depth_a), (image_b, depth_b) = seen(cameras, 0), seen(cameras, 1)
    found, valid = warp(image_b, depth_a, depth_b, cameras, 0, 1)
    assert float(valid.float().mean()) > 0.8
    # One pixel is 0.06 of the scene; bilinear error <= 0.4 * 1.3^2 * 0.06^2 / 8 per axis.
    assert float((found - image_a)[valid].abs().max()) < 1e-3
    assert float((image_b - image_a)[valid].abs().max()) > 0.05
    assert float(found[~valid].abs().max()) == 0


def test_what_is_hidden_or_outside_is_not_compared() -> None:
    cameras = row_of_cameras(2, step=0.6)
    (image_a, depth_a), (image_b, depth_b) = (seen(cameras, view, plate=True) for view in (0, 1))
    found, valid = warp(image_b, depth_a, depth_b, cameras, 0, 1)
    difference = (found - image_a).abs().amax(-1)
    # The plate is at half the distance: what mixes in beside its edge is at most 2 * 2 % of it before depths disagree.
    assert float(valid.float().mean()) > 0.7
    assert float(difference[valid].max()) < 0.04
    _, ignored = warp(image_b, depth_a, torch.full_like(depth_b, 0.0), cameras, 0, 1)
    assert not bool(ignored.any())
    # Without the occlusion test white would show: a depth of b that lies about it lets it through.
    (plane_a, way_a), (_, way_b) = seen(cameras, 0), seen(cameras, 1)
    fooled, shown = warp(image_b, way_a, way_b, cameras, 0, 1)
    assert float((fooled - plane_a)[shown].abs().max()) > 0.2


def test_a_consistent_path_scores_zero_and_flicker_its_own_size() -> None:
    cameras = row_of_cameras(10, step=0.05)
    views = [seen(cameras, view) for view in range(10)]
    images, depths = [image for image, _ in views], [depth for _, depth in views]
    pairs = [[(t, t + gap) for t in range(10 - gap)] for gap in (1, 7)]
    rows = [consistency(images, depths, cameras, each) for each in pairs]
    assert [row["pairs"] for row in rows] == [9, 3]
    for row in rows:
        assert row["rmse"] is not None and row["rmse"] < 1e-3
        assert row["relative"] is not None and row["relative"] < 5e-3
        assert row["valid_share"] is not None and row["valid_share"] > 0.8
    # Every other frame brighter by 0.1: short pairs differ by exactly that, as do pairs 7 apart.
    flicker = [image + 0.1 * (index % 2) for index, image in enumerate(images)]
    for each in pairs:
        assert consistency(flicker, depths, cameras, each)["rmse"] == pytest.approx(0.1, abs=1e-3)


def test_the_relative_error_does_not_reward_dullness() -> None:
    cameras = row_of_cameras(2, step=0.3)
    views = [seen(cameras, view) for view in range(2)]
    depths = [depth for _, depth in views]
    draws = [torch.Generator().manual_seed(index) for index in range(2)]
    noisy = [image + 0.1 * torch.randn(image.shape, generator=draw) for (image, _), draw in zip(views, draws, strict=True)]
    dull = [0.5 + 0.1 * (image - 0.5) for image in noisy]
    rich_row, dull_row = (consistency(images, depths, cameras, [(0, 1)]) for images in (noisy, dull))
    assert dull_row["rmse"] == pytest.approx(0.1 * rich_row["rmse"], rel=1e-4)
    assert dull_row["relative"] == pytest.approx(rich_row["relative"], rel=1e-4)
    unrelated = [torch.rand(HEIGHT, WIDTH, 3, generator=draw) for draw in draws]
    still = replace(cameras, pose=cameras.pose[:1].repeat(2, 1, 1))
    assert consistency(unrelated, depths[:1] * 2, still, [(0, 1)])["relative"] == pytest.approx(math.sqrt(2), rel=0.05)
    flat = [torch.full((HEIGHT, WIDTH, 3), 0.5)] * 2
    assert consistency(flat, depths, cameras, [(0, 1)])["relative"] is None


def test_what_does_not_fit_is_named() -> None:
    cameras = row_of_cameras(2)
    image, depth = seen(cameras, 0)
    with pytest.raises(DataError, match="view 1: the image is 48x35, its camera 48x36"):
        warp(image[:-1], depth, depth, cameras, 0, 1)
    with pytest.raises(DataError, match="view 0: the depth is 36x48"):
        warp(image, depth.T, depth, cameras, 0, 1)
    with pytest.raises(NumericsError):
        consistency([image * math.nan] * 2, [depth] * 2, cameras, [(0, 0)])
