"""Photographs as Gaussians learn from them: first points and surroundings, lenses, targets made again."""

import math
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from fprf.datamanagers.images import load_images
from fprf.datamanagers.scene import ParsedScene
from fprf.rendering.cameras import Cameras, grid_rays, ideal_cameras, project
from fprf.rendering.paths import pinhole
from fprf.splats import initial, photographs, pinholes
from fprf.splats.config import GaussiansConfig
from fprf.splats.drawing import draw
from fprf.splats.gaussians import Gaussians
from fprf.splats.initial import initial_points
from fprf.splats.photographs import load_photographs, make_levels
from fprf.splats.pinholes import camera_of
from fprf.splats.scene import SplatScene
from fprf.splats.setup import scene_scale
from fprf.training.prepare import read_scene


def test_matches_between_views_give_points_on_the_surface() -> None:
    """Views of a textured plane z = 0: what is triangulated lies in it."""
    draws = np.random.default_rng(1)
    texture = np.kron(draws.integers(0, 256, (60, 60, 3)), np.ones((8, 8, 1))).astype(np.uint8)
    count = 4
    width = 200
    height = 160
    focal = 180.0
    pose = torch.eye(4, dtype=torch.float64)[:3].repeat(count, 1, 1)
    pose[:, 0, 3], pose[:, 2, 3] = torch.linspace(-0.3, 0.3, count, dtype=torch.float64), 3.0
    cameras = pinhole(pose, width=width, height=height, fov=math.degrees(2 * math.atan(height / 2 / focal)))
    x, y = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    u, v = ((along * 3 / focal) * 100 + 240 for along in (x, y))
    images = {
        view: texture[v.astype(int), (u + 100 * float(pose[view, 0, 3])).astype(int)] for view in range(count)
    }
    train = torch.arange(count)
    scene = ParsedScene(
        name="plane", paths=(Path("a"),) * count, cameras=cameras, train=train, test=train[:0]
    )
    found, origin = initial_points(scene, images, 1000, draws)
    assert origin == "points matched between views" and len(found.position) > 100
    assert np.median(np.abs(found.position[:, 2])) < 0.03


def test_points_begin_where_there_are_none(scene: ParsedScene) -> None:
    bare = replace(scene, points=None, seen=None)
    found, origin = initial_points(bare, dict(enumerate(load_images(bare))), 500, np.random.default_rng(0))
    assert origin == "random points" and len(found.position) == 500 and np.isfinite(found.position).all()
    assert found.colour.min() >= 0 and found.colour.max() <= 1


def test_a_lens_moves_pixels_where_projection_says(scene: ParsedScene) -> None:
    """A dot drawn through `cover` and `distorted` lies where the lens maps its place; `undistorted` brings it
    back.
    """
    distortion = torch.zeros(len(scene.paths), 6, dtype=torch.float64)
    distortion[:, 0] = -0.2
    distortion[:, 1] = 1e-6
    cameras = replace(scene.cameras, distortion=distortion, lens=torch.ones_like(scene.cameras.lens))
    cameras = cameras.resized(torch.tensor([[160, 120]]).expand(len(cameras), 2))
    pose = cameras.pose[0]
    local = torch.tensor([0.32, 0.22, -1.0], dtype=torch.float64)
    place = pose[:, :3] @ local + pose[:, 3]
    pixel, _ = project(cameras, torch.tensor([0]), place[None])
    straight, _ = project(
        replace(cameras, lens=torch.zeros_like(cameras.lens)), torch.tensor([0]), place[None]
    )
    assert (pixel - straight).norm() > 1
    turn = torch.tensor([[1.0, 0, 0, 0]])
    size = torch.full((1, 3), -4.0)
    dot = Gaussians(place[None].float(), turn, size, torch.full((1,), 4.0), torch.ones(1, 1, 3))
    camera, where = pinholes.cover(cameras, 0, 0.01)
    assert where is not None
    drawn = pinholes.distorted(draw(dot, camera).image, where)
    x, y = torch.meshgrid(torch.arange(160) + 0.5, torch.arange(120) + 0.5, indexing="xy")

    def middle(image: torch.Tensor) -> torch.Tensor:
        weight = image.sum(-1).clamp_min(0)
        return torch.stack([(x * weight).sum(), (y * weight).sum()]) / weight.sum()

    assert (middle(drawn) - pixel[0]).norm() < 0.1
    bytes_ = (drawn.clamp(0, 1) * 255).byte().numpy()
    back, inside = pinholes.undistorted(cameras, 0, bytes_, camera_of(cameras, 0))
    assert inside is not None and 0.8 < inside.mean() < 1.01
    assert (middle(torch.from_numpy(back).float()) - straight[0]).norm() < 0.15
    # With k1 alone it is drawn where it lies, at once.
    cameras.distortion[:] = torch.tensor([0.1, 0, 0, 0, 0, 0])
    camera, where = pinholes.cover(cameras, 0, 0.01)
    assert where is None and camera.k1 == pytest.approx(0.1)
    assert (
        middle(draw(dot, camera).image) - project(cameras, torch.tensor([0]), place[None])[0][0]
    ).norm() < 0.1
    same, everywhere = pinholes.undistorted(cameras, 0, bytes_, camera)
    assert same is bytes_ and everywhere is None


def test_a_lens_that_folds_back_in_the_corners_is_drawn_through_a_pinhole() -> None:
    cameras = ideal_cameras(torch.eye(3, 4, dtype=torch.float64)[None], 60.0, (80, 64))
    cameras.lens[:] = 1
    for k1, direct in ((-0.1, True), (-0.4, False)):
        cameras.distortion[:, 0] = k1
        camera, place = pinholes.cover(cameras, 0, 0.01)
        assert (camera.k1 == k1) == (place is None) == direct


def absent() -> Any:
    raise AssertionError("nobody asked for semantics")


def test_depths_through_a_lens_are_along_the_rays_of_its_pixels() -> None:
    """A wall across the axis: its depth along a ray is its distance over the ray's share along the axis."""
    turn = torch.tensor([[1.0, 0, 0, 0]])
    size = torch.log(torch.tensor([[50.0, 50.0, 1e-3]]))
    wall = Gaussians(torch.tensor([[0.0, 0, -4]]), turn, size, torch.full((1,), 9.0), torch.ones(1, 1, 3))
    cameras = ideal_cameras(torch.eye(3, 4, dtype=torch.float64)[None], 60.0, (80, 64))
    cameras.lens[:] = 1
    cameras.distortion[:, 0] = 0.2
    ahead = -grid_rays(cameras, 0)[1][:, 2].view(64, 80)
    for k2 in (0.0, 1e-9):
        cameras.distortion[:, 1] = k2
        shown = SplatScene(wall, False, cameras, ("one",), absent, absent, 80).render(cameras, 0)
        assert torch.allclose(shown.depth.double(), 4 / ahead, rtol=2e-3)


def test_surroundings_fill_what_no_photograph_shows(scene: ParsedScene) -> None:
    """All directions have a Gaussian far away: grey photographs give grey surroundings, in and out of
    view.
    """
    images = {view: np.full((24, 32, 3), 102, np.uint8) for view in scene.train.tolist()}
    points = initial.Points(np.zeros((1, 3)), np.zeros((1, 3), np.float32))
    far = initial.surroundings(scene, images, points, 200)
    centre = scene.cameras.pose[scene.train][:, :, 3].mean(0).numpy()
    direction = (far.position - centre) / np.linalg.norm(far.position - centre, axis=1, keepdims=True)
    assert np.abs(direction.mean(0)).max() < 0.02 and np.allclose(far.colour, 0.4)
    assert (np.linalg.norm(far.position - centre, axis=1) > 5 * np.linalg.norm(centre)).all()


def test_means_move_by_what_views_see_not_by_how_far_apart_they_are(scene: ParsedScene) -> None:
    """Two copies of a scene far from each other are learnt at the rate of one."""
    apart = torch.tensor([1000.0, 0.0, 0.0], dtype=torch.float64)
    pose = scene.cameras.pose
    moved = torch.cat([pose[:, :, :3], (pose[:, :, 3] + apart)[:, :, None]], 2)
    columns = {each.name: torch.cat([getattr(scene.cameras, each.name)] * 2) for each in fields(Cameras)}
    both = Cameras(**{**columns, "pose": torch.cat([pose, moved])})
    assert scene.points is not None
    train = torch.cat([scene.train, scene.train + len(pose)])
    twice = replace(
        scene, cameras=both, train=train, points=torch.cat([scene.points, scene.points + apart]), seen=None
    )
    assert scene_scale(twice) < 1.5 * scene_scale(replace(scene, seen=None))
    assert scene_scale(replace(twice, points=None)) > 500


@pytest.mark.parametrize("lens", [1, 2])
@pytest.mark.parametrize("k", [(0.0, 0.0, 0.0), (-0.3, 0.1, 0.0), (0.2, -0.05, 0.01)])
def test_a_pinhole_covers_all_that_a_lens_shows(lens: int, k: tuple[float, float, float]) -> None:
    """No pixel lies outside of the pinhole's image or in its border of two pixels, and some reach that on
    each side.
    """
    cameras = ideal_cameras(torch.eye(3, 4, dtype=torch.float64)[None], 60.0, (80, 64))
    distortion = torch.tensor([[*k, 0.0, 0.001, -0.001]], dtype=torch.float64)
    cameras = replace(cameras, distortion=distortion, lens=torch.tensor([lens]))
    camera, place = pinholes.cover(cameras, 0, 0.01)
    assert place is not None
    low = place.amin((0, 1))
    high = torch.tensor([camera.width, camera.height]) - place.amax((0, 1))
    assert (low >= 2).all() and (high >= 2).all() and (low < 3).all() and (high < 3).all()


def test_targets_made_again_are_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """Photographs that did not fit into what is kept between steps."""
    config = GaussiansConfig(data=Path("garden"), downscale=8)
    scene = read_scene(config)
    images, masks, skies = load_photographs(config, scene, scene.train.tolist())
    whole = make_levels(scene, images, masks, 0.01, skies)
    first = [[level[view] for view in level] for level in whole]
    monkeypatch.setattr(photographs, "_MAX_TARGET_BYTES", 1)
    for level, before in zip(make_levels(scene, images, masks, 0.01, skies), first, strict=True):
        for view, old in zip(level, before, strict=True):
            for a, b in zip(level[view], old, strict=True):
                assert a is b is None or (a == b if isinstance(a, int) else (a == b).all())  # type: ignore[union-attr]
