import math
from dataclasses import replace

import pytest
import torch

from fprf.errors import DataError, NumericsError
from fprf.evaluation.consistency import consistency, path_pairs, warp
from fprf.rendering.cameras import Cameras, pixel_grid, rays_through
from fprf.rendering.paths import look_at

WIDTH, HEIGHT = 48, 36


def row_of_cameras(count: int, step: float = 0.1) -> Cameras:
    """Side by side at z = 3, all looking at the origin."""
    x = (torch.arange(count, dtype=torch.float64) - (count - 1) / 2) * step
    position = torch.stack([x, 0.2 * x, torch.full_like(x, 3.0)], -1)
    pose = look_at(position, torch.zeros_like(position), torch.tensor([0.0, 1, 0], dtype=torch.float64))
    return Cameras(
        pose=pose,
        focal=torch.full((count, 2), 50.0, dtype=torch.float64),
        centre=torch.tensor([[24.3, 17.6]], dtype=torch.float64).repeat(count, 1),
        size=torch.tensor([[WIDTH, HEIGHT]]).repeat(count, 1),
        distortion=torch.zeros(count, 6, dtype=torch.float64),
        lens=torch.zeros(count, dtype=torch.int64),
    )


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


def test_a_view_warped_onto_itself_is_itself() -> None:
    cameras = row_of_cameras(1)
    image, depth = seen(cameras, 0)
    found = warp(image, depth, depth, cameras, 0, 0)
    assert bool(found.valid.all())
    torch.testing.assert_close(found.image, image, atol=1e-5, rtol=0)


@pytest.mark.parametrize("lens", [0, 1, 2])
def test_a_plane_warps_exactly_to_interpolation(lens: int) -> None:
    cameras = row_of_cameras(2, step=0.6)
    bent = torch.tensor([0.05, -0.01, 0, 0, 1e-3, -1e-3] if lens == 1 else [0.02, 0, 0, 0, 0, 0], dtype=torch.float64)
    cameras = replace(cameras, lens=torch.full((2,), lens), distortion=(bent * (lens > 0)).repeat(2, 1))
    (image_a, depth_a), (image_b, depth_b) = seen(cameras, 0), seen(cameras, 1)
    found = warp(image_b, depth_a, depth_b, cameras, 0, 1)
    assert float(found.valid.float().mean()) > 0.8
    # One pixel is 0.06 of the scene; bilinear error <= 0.4 * 1.3^2 * 0.06^2 / 8 per axis.
    assert float((found.image - image_a)[found.valid].abs().max()) < 1e-3
    assert float((image_b - image_a)[found.valid].abs().max()) > 0.05
    assert float(found.image[~found.valid].abs().max()) == 0


def test_what_is_hidden_or_outside_is_not_compared() -> None:
    cameras = row_of_cameras(2, step=0.6)
    (image_a, depth_a), (image_b, depth_b) = (seen(cameras, view, plate=True) for view in (0, 1))
    found = warp(image_b, depth_a, depth_b, cameras, 0, 1)
    difference = (found.image - image_a).abs().amax(-1)
    # The plate is at half the distance: what mixes in beside its edge is at most 2 * 2 % of it before depths disagree.
    assert float(found.valid.float().mean()) > 0.7
    assert float(difference[found.valid].max()) < 0.04
    ignored = warp(image_b, depth_a, torch.full_like(depth_b, 0.0), cameras, 0, 1)
    assert not bool(ignored.valid.any())
    # Without the occlusion test white would show: a depth of b that lies about it lets it through.
    plane = seen(cameras, 1)[1]
    fooled = warp(image_b, seen(cameras, 0)[1], plane, cameras, 0, 1)
    assert float((fooled.image - seen(cameras, 0)[0])[fooled.valid].abs().max()) > 0.2


def test_pixels_without_depth_are_not_compared() -> None:
    cameras = row_of_cameras(2)
    (image, depth_a), (_, depth_b) = seen(cameras, 0), seen(cameras, 1)
    for nothing in (0.0, -1.0, math.inf, math.nan):
        holed = depth_a.clone()
        holed[10:20, 10:20] = nothing
        found = warp(image, holed, depth_b, cameras, 0, 1)
        assert not bool(found.valid[10:20, 10:20].any()) and bool(found.valid[22:30, 22:30].all())
        back = warp(image, depth_a, holed, cameras, 0, 0)
        assert not bool(back.valid[12:18, 12:18].any()) and bool(torch.isfinite(back.image).all())


def test_views_that_look_away_share_nothing() -> None:
    cameras = row_of_cameras(2)
    pose = cameras.pose.clone()
    pose[1, :, :3] = pose[1, :, :3] @ torch.diag(torch.tensor([-1.0, 1, -1], dtype=torch.float64))
    image, depth = seen(cameras, 0)
    found = warp(image, depth, depth, replace(cameras, pose=pose), 0, 1)
    assert not bool(found.valid.any())
    row = consistency([image, image], [depth, depth], replace(cameras, pose=pose), [(0, 1)])
    assert row == {"rmse": None, "relative": None, "valid_share": 0.0, "pairs": 1}


def test_a_consistent_path_scores_zero_and_flicker_its_own_size() -> None:
    cameras = row_of_cameras(10, step=0.05)
    views = [seen(cameras, view) for view in range(10)]
    images, depths = [image for image, _ in views], [depth for _, depth in views]
    rows = [consistency(images, depths, cameras, path_pairs(10, gap)) for gap in (1, 7)]
    assert [row["pairs"] for row in rows] == [9, 3]
    for row in rows:
        assert row["rmse"] is not None and row["rmse"] < 1e-3
        assert row["relative"] is not None and row["relative"] < 5e-3
        assert row["valid_share"] is not None and row["valid_share"] > 0.8
    # Every other frame brighter by 0.1: short pairs differ by exactly that, as do pairs 7 apart.
    flicker = [image + 0.1 * (index % 2) for index, image in enumerate(images)]
    for gap in (1, 7):
        row = consistency(flicker, depths, cameras, path_pairs(10, gap))
        assert row["rmse"] == pytest.approx(0.1, abs=1e-3)


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
    with pytest.raises(DataError, match="1 images, 2 depths, 2 cameras"):
        consistency([image], [depth] * 2, cameras, [])
    with pytest.raises(DataError, match="view 1: the image is 48x35, its camera 48x36"):
        warp(image[:-1], depth, depth, cameras, 0, 1)
    with pytest.raises(DataError, match="view 0: the depth is 36x48"):
        warp(image, depth.T, depth, cameras, 0, 1)
    with pytest.raises(NumericsError, match="not finite"):
        consistency([image * math.nan] * 2, [depth] * 2, cameras, [(0, 0)])
