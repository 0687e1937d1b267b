"""Scores of pictures and of films against their definitions, LPIPS against its authors; held-out views and
fitted poses.
"""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from ssim_oracle import noise, ssim_oracle
from tiny_world import World
from torch import Tensor

from fprf.datamanagers.images import Image, load_image
from fprf.errors import DataError, NumericsError
from fprf.evaluation.metrics import PSNR_CAP, WarpError, image_metrics, judge, lpips, psnr, ssim, warp
from fprf.io.images import to_uint8, write_image
from fprf.rendering.cameras import Cameras, pixel_grid, rays_through
from fprf.rendering.paths import look_at, pinhole
from fprf.training import views
from fprf.training.camera_optimizers import moved_cameras, rotated
from fprf.training.views import render_view


def test_psnr_of_identical_images_is_the_cap_and_nothing_is_above() -> None:
    image = noise(8, 8).double()
    assert psnr(image, image) == PSNR_CAP == psnr(image, image + 1e-9)
    assert psnr(image, image + 2e-5) < PSNR_CAP
    assert psnr(torch.zeros(2, 2, 3), torch.ones(2, 2, 3)) == 0.0


def test_ssim_agrees_with_the_definition() -> None:
    a = noise(17, 19)
    for b in (noise(17, 19, 1), (0.7 * a + 0.3 * noise(17, 19, 2)), a * 0.8, 1 - a):
        assert ssim(a, b) == pytest.approx(ssim_oracle(a.double().numpy(), b.double().numpy()), abs=1e-5)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_what_is_not_finite_is_no_score(value: float) -> None:
    broken = noise(12, 12)
    broken[5, 5, 1] = value
    for metric in (psnr, ssim):
        with pytest.raises(NumericsError, match="not finite"):
            metric(broken, noise(12, 12))


def test_exposure_and_white_balance_cost_nothing_of_the_corrected_psnr() -> None:
    draw = torch.Generator().manual_seed(0)
    truth = 0.1 + 0.5 * torch.rand(30, 40, 3, generator=draw)
    render = truth + 0.02 * torch.randn(30, 40, 3, generator=draw)
    before = image_metrics(render, truth)
    darker = image_metrics(render * torch.tensor([0.5, 0.7, 0.6]), truth)
    assert darker["psnr"] < 20 < before["psnr"]
    # 1e-3: rounding, and the least that the clamp to [0, 1] moves.
    assert before["psnr"] <= before["cc_psnr"] == pytest.approx(darker["cc_psnr"], abs=1e-3)
    assert image_metrics(torch.zeros_like(truth), truth)["cc_psnr"] == pytest.approx(
        psnr(torch.zeros_like(truth), truth)
    )


def test_what_a_mask_leaves_out_does_not_count() -> None:
    """Any change there leaves PSNR as it is, and SSIM but for windows that reach into it: those see the same
    in both images.
    """
    draw = torch.Generator().manual_seed(0)
    truth = torch.rand(40, 30, 3, generator=draw)
    where = torch.zeros(40, 30, dtype=torch.bool)
    where[:, :20] = True
    render = (truth + 0.1 * torch.randn(40, 30, 3, generator=draw)).clamp(0, 1)
    spoilt = torch.where(where[..., None], render, torch.rand(40, 30, 3, generator=draw))
    assert image_metrics(render, truth, where) == image_metrics(spoilt, truth, where)
    assert image_metrics(render, truth, where)["psnr"] == pytest.approx(psnr(render[:, :20], truth[:, :20]))
    assert image_metrics(render, truth, torch.ones_like(where)) == pytest.approx(image_metrics(render, truth))
    with pytest.raises(DataError, match="leaves nothing"):
        image_metrics(render, truth, torch.zeros_like(where))


def picture(height: int, width: int, phase: float) -> Tensor:
    """Smooth waves of colour and a disc [H W 3]."""
    y, x = torch.meshgrid(torch.linspace(0, 1, height), torch.linspace(0, 1, width), indexing="ij")
    waves = (
        torch.stack(
            [torch.sin(9 * x + phase), torch.sin(7 * y - phase), torch.cos(5 * (x + y) * (1 + phase))], -1
        )
        / 2
        + 0.5
    )
    disc = ((x - 0.6) ** 2 + (y - 0.4) ** 2 < 0.05)[..., None]
    return torch.where(disc, 1 - waves, waves)


def noisy(image: Tensor) -> Tensor:
    steps = torch.arange(image.numel(), dtype=torch.float64)
    return (
        image + 0.3 * torch.frac(torch.sin(steps * 12.9898) * 43758.5453).reshape(image.shape).float()
    ).clamp(0, 1)


STORED = {
    "other colours": (picture(64, 96, 0.0), picture(64, 96, 0.5), 0.266698),
    "nearly the same": (picture(127, 90, 0.0), picture(127, 90, 0.1), 0.031176),
    "noise": (picture(100, 100, 0.2), noisy(picture(100, 100, 0.2)), 0.494266),
    "grey": (picture(64, 64, 0.0), torch.full((64, 64, 3), 0.5), 0.945153),
}
"""Two images and what `lpips` 0.1.4 of PyPI said: net alex, version 0.1, its own heads."""


@pytest.mark.parametrize("name", STORED)
def test_numbers_are_those_of_the_authors_package(name: str) -> None:
    a, b, expected = STORED[name]
    assert lpips(a, b) == pytest.approx(expected, abs=1e-3)
    assert lpips(b, a) == pytest.approx(lpips(a, b), rel=1e-5)
    assert lpips(a, a) == 0


def test_only_what_counts_is_judged() -> None:
    a = picture(96, 96, 0.0)
    b = a.clone()
    where = torch.zeros(96, 96, dtype=torch.bool)
    b[:, :30] = 0
    where[:, 64:] = True
    assert lpips(a, b, ~where) > 0.1 > 10 * lpips(a, b, where)
    assert lpips(a, b, torch.ones_like(where)) == pytest.approx(lpips(a, b), rel=1e-6)


@pytest.mark.parametrize("size", [(1, 1), (12, 48), (30, 31)])
def test_small_images_are_judged_too(size: tuple[int, int]) -> None:
    assert 0 < lpips(torch.zeros(*size, 3), torch.ones(*size, 3)) < 2


def test_images_that_cannot_be_compared_are_refused() -> None:
    with pytest.raises(DataError, match="one size"):
        lpips(torch.zeros(32, 32, 3), torch.zeros(32, 33, 3))
    with pytest.raises(NumericsError):
        lpips(torch.full((32, 32, 3), math.nan), torch.zeros(32, 32, 3))


def test_metrics_are_those_of_the_renders(world: World) -> None:
    trained = world.load()
    scene = world.prepared.scene
    told: list[Any] = []
    images: dict[int, Image] = {}

    def save(view: int, image: Image) -> None:
        images[view] = image
        told.append("saved")

    metrics = judge(trained, trained.known, scene, trained.known.test, lambda *of: told.append(of[:2]), save)
    assert told == [(0, 2), "saved", (1, 2), "saved", (2, 2)], "each as it is made"
    assert metrics["views"] == 2 and metrics["per_view"].keys() == {"0000", "0008"}
    assert tuple(images) == trained.known.test
    for view, image in images.items():
        again = render_view(
            trained.model, trained.known.facts, trained.known.cameras, view, trained.config.render
        )
        assert (to_uint8(again.rgb) == image).all()
        truth = torch.from_numpy(load_image(scene.paths[view], (32, 24))).float() / 255
        wanted = image_metrics(again.rgb, truth) | {"used_share": 1.0}
        assert metrics["per_view"][scene.paths[view].stem] == wanted
    assert metrics["psnr"] == pytest.approx(sum(v["psnr"] for v in metrics["per_view"].values()) / 2)
    assert metrics["rays_per_second"] == pytest.approx(2 * 24 * 32 / metrics["render_seconds"])
    assert metrics["seconds_per_view"] == pytest.approx(metrics["render_seconds"] / 2)
    assert 0 < metrics["lpips"] < 2
    assert metrics["consistency"]["pairs"] == 1 and 0 < metrics["kept_samples_share"] <= 1


def test_a_turned_view_comes_back(world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its image is what the scene looks like from where it was; the fit starts a little beside."""
    trained = world.load()
    view = trained.known.test[0]
    cameras = trained.known.cameras
    config = trained.config.render
    truth = render_view(trained.model, trained.known.facts, cameras, view, config).rgb
    write_image(tmp_path / "truth.png", to_uint8(truth))
    paths = list(world.prepared.scene.paths)
    paths[view] = tmp_path / "truth.png"
    pose = cameras.pose.clone()
    turn = torch.tensor([[0.0, 0.0, 0.03]], dtype=torch.float64)
    for axis in range(3):
        pose[view, :, axis] = rotated(pose[view, :, axis][None], turn)[0]
    wrong = replace(trained, known=replace(trained.known, cameras=replace(cameras, pose=pose)))
    before = {name: t.clone() for name, t in trained.model.state_dict().items()}
    monkeypatch.setattr(views, "FIT_STEPS", 60)
    moves = wrong.fit_poses(replace(world.prepared.scene, paths=tuple(paths)), [view], lambda *of: None)
    found = replace(wrong, known=replace(wrong.known, cameras=moved_cameras(wrong.known.cameras, moves)))

    def error(run: object) -> float:
        known = run.known  # type: ignore[attr-defined]
        return float(
            (render_view(trained.model, known.facts, known.cameras, view, config).rgb - truth).square().mean()
        )

    assert error(found) < 0.5 * error(wrong)
    others = [k for k in range(len(pose)) if k != view]
    assert torch.equal(found.known.cameras.pose[others], pose[others])
    assert all(torch.equal(t, before[name]) for name, t in trained.model.state_dict().items())


WIDTH = 48
HEIGHT = 36


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
    return torch.stack(
        [0.5 + 0.4 * torch.sin(x), 0.5 + 0.4 * torch.cos(1.3 * y), 0.5 + 0.3 * torch.sin(x + z)], -1
    )


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
    bent = torch.tensor(
        [0.05, -0.01, 0, 0, 1e-3, -1e-3] if lens == 1 else [0.02, 0, 0, 0, 0, 0], dtype=torch.float64
    )
    cameras = replace(cameras, lens=torch.full((2,), lens), distortion=(bent * (lens > 0)).repeat(2, 1))
    (image_a, depth_a) = seen(cameras, 0)
    (image_b, depth_b) = seen(cameras, 1)
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
    # The plate is at half the distance: what mixes in beside its edge is at most 2 * 2 % of it before depths
    # disagree.
    assert float(valid.float().mean()) > 0.7
    assert float(difference[valid].max()) < 0.04
    _, ignored = warp(image_b, depth_a, torch.full_like(depth_b, 0.0), cameras, 0, 1)
    assert not bool(ignored.any())
    # Without the occlusion test white would show: a depth of b that lies about it lets it through.
    (plane_a, way_a) = seen(cameras, 0)
    (_, way_b) = seen(cameras, 1)
    fooled, shown = warp(image_b, way_a, way_b, cameras, 0, 1)
    assert float((fooled - plane_a)[shown].abs().max()) > 0.2


def test_a_consistent_path_scores_zero_and_flicker_its_own_size() -> None:
    cameras = row_of_cameras(10, step=0.05)
    views = [seen(cameras, view) for view in range(10)]
    images = [image for image, _ in views]
    depths = [depth for _, depth in views]
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
    noisy = [
        image + 0.1 * torch.randn(image.shape, generator=draw)
        for (image, _), draw in zip(views, draws, strict=True)
    ]
    dull = [0.5 + 0.1 * (image - 0.5) for image in noisy]
    rich_row, dull_row = (consistency(images, depths, cameras, [(0, 1)]) for images in (noisy, dull))
    assert dull_row["rmse"] == pytest.approx(0.1 * rich_row["rmse"], rel=1e-4)
    assert dull_row["relative"] == pytest.approx(rich_row["relative"], rel=1e-4)
    unrelated = [torch.rand(HEIGHT, WIDTH, 3, generator=draw) for draw in draws]
    still = replace(cameras, pose=cameras.pose[:1].repeat(2, 1, 1))
    assert consistency(unrelated, depths[:1] * 2, still, [(0, 1)])["relative"] == pytest.approx(
        math.sqrt(2), rel=0.05
    )
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
