"""Rays that are drawn through points of the reconstruction."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tiny_world import World

from fprf.datamanagers.config import RayBatchesConfig
from fprf.errors import ConfigError
from fprf.interfaces import DataManager
from fprf.rendering.cameras import rays_through


def manager(world: World, folder: Path, share: float, **fields: object) -> DataManager:
    """Of the tiny town, whose points any view may see."""
    config = RayBatchesConfig(rays=64, depth_share=share)
    scene = fields.pop("scene", replace(world.prepared.scene, seen=None))
    return config.build(scene=scene, content=None, semantic=None, dim=4, cache=folder, seed=3, **fields)  # type: ignore[arg-type]


def test_marked_rays_pass_their_points_at_the_distance_told(world: World, tmp_path: Path) -> None:
    scene = world.prepared.scene
    assert scene.points is not None
    batch = manager(world, tmp_path, 0.25).batch(7)
    assert batch.distance is not None
    known = torch.isfinite(batch.distance)
    assert known.tolist() == [False] * 48 + [True] * 16
    origin, direction = rays_through(scene.cameras, batch.view[known], batch.pixel[known])
    end = origin + direction * batch.distance[known].double()[:, None]
    # Points lie anywhere in the pixel, rays in its middle: half a diagonal of a pixel away at most.
    apart = torch.cdist(end, scene.points).amin(1)
    pixel = batch.distance[known].double() / scene.cameras.focal[batch.view[known], 0]
    assert bool((apart <= 0.75 * pixel + 1e-6).all())


def test_colours_are_those_of_the_pixels(world: World, tmp_path: Path) -> None:
    found = manager(world, tmp_path, 0.5)
    batch = found.batch(1)
    for view, pixel, rgb in zip(batch.view.tolist(), batch.pixel.long().tolist(), batch.rgb, strict=True):
        assert torch.equal(found.image(view)[pixel[1], pixel[0]], rgb)
    assert torch.isin(batch.view, world.prepared.scene.train).all()


def test_a_batch_stays_a_function_of_its_step(world: World, tmp_path: Path) -> None:
    one, other = manager(world, tmp_path, 0.25), manager(world, tmp_path, 0.25)
    a, b, c = one.batch(5), other.batch(5), other.batch(6)
    assert a.distance is not None and b.distance is not None
    assert torch.equal(a.pixel, b.pixel) and torch.equal(a.distance[48:], b.distance[48:])
    assert not torch.equal(a.pixel, c.pixel)
    plain = manager(world, tmp_path, 0.0).batch(5)
    assert plain.distance is None and torch.equal(plain.pixel[:48], a.pixel[:48]), "the other rays are what they were"


def test_without_points_there_are_no_marks(world: World, tmp_path: Path) -> None:
    bare = replace(world.prepared.scene, points=None, seen=None)
    assert manager(world, tmp_path, 0.25, scene=bare).batch(0).distance is None


def test_points_of_a_reconstruction_count_where_two_views_saw_them(world: World, tmp_path: Path) -> None:
    scene = world.prepared.scene
    first, second = scene.train.tolist()[:2]
    held = int(scene.test[0])
    both = torch.tensor([[first, 0], [second, 0]])
    alone = torch.tensor([[first, point] for point in range(1, 50)] + [[held, point] for point in range(1, 50)])
    marks = manager(world, tmp_path, 0.5, scene=replace(scene, seen=torch.cat([both, alone]))).batch(0)
    expected = manager(world, tmp_path, 0.5, scene=replace(scene, seen=both)).batch(0)
    assert marks.distance is not None and expected.distance is not None
    torch.testing.assert_close(marks.distance, expected.distance, equal_nan=True)
    assert manager(world, tmp_path, 0.5, scene=replace(scene, seen=alone)).batch(0).distance is None


def test_a_block_is_marked_where_it_learns(world: World, tmp_path: Path) -> None:
    def left(view: int) -> torch.Tensor:
        mask = torch.zeros(24, 32, dtype=torch.bool)
        mask[:, :12] = True
        return mask

    batch = manager(world, tmp_path, 0.5, seen=left).batch(2)
    assert batch.distance is not None and bool((batch.pixel[:, 0] < 12).all())


def test_shares_lie_between_none_and_all() -> None:
    for share in (-0.1, 1.5):
        with pytest.raises(ConfigError, match=r"datamanager\.depth_share"):
            RayBatchesConfig(depth_share=share)
