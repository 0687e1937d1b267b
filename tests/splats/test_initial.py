"""Points that Gaussians begin with: matched between views, or random."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from benchmarks.town.write import write_town
from fprf.datamanagers.images import load_images
from fprf.datamanagers.parsers.config import parse_scene
from fprf.datamanagers.scene import Scene
from fprf.rendering.paths import pinhole
from fprf.splats.initial import initial_points


def test_matches_between_views_give_points_on_the_surface() -> None:
    """Views of a textured plane z = 0: what is triangulated lies in it."""
    draws = np.random.default_rng(1)
    texture = np.kron(draws.integers(0, 256, (60, 60, 3)), np.ones((8, 8, 1))).astype(np.uint8)
    count, width, height, focal = 4, 200, 160, 180.0
    pose = torch.eye(4, dtype=torch.float64)[:3].repeat(count, 1, 1)
    pose[:, 0, 3], pose[:, 2, 3] = torch.linspace(-0.3, 0.3, count, dtype=torch.float64), 3.0
    cameras = pinhole(pose, width=width, height=height, fov=math.degrees(2 * math.atan(height / 2 / focal)))
    x, y = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    u, v = ((along * 3 / focal) * 100 + 240 for along in (x, y))
    images = {view: texture[v.astype(int), (u + 100 * float(pose[view, 0, 3])).astype(int)] for view in range(count)}
    train = torch.arange(count)
    scene = Scene(name="plane", paths=(Path("a"),) * count, cameras=cameras, train=train, test=train[:0])
    found, origin = initial_points(scene, images, 1000, draws)
    assert origin == "points matched between views" and len(found.position) > 100
    assert np.median(np.abs(found.position[:, 2])) < 0.03


def test_points_begin_where_there_are_none(tmp_path: Path) -> None:
    write_town(tmp_path / "town", seed=0, palette="day", views=10, width=32, height=24)
    bare = replace(parse_scene(tmp_path / "town", 1, None), points=None, seen=None)
    found, origin = initial_points(bare, dict(enumerate(load_images(bare))), 500, np.random.default_rng(0))
    assert origin == "random points" and len(found.position) == 500 and np.isfinite(found.position).all()
    assert found.colour.min() >= 0 and found.colour.max() <= 1
