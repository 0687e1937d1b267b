"""The town: its tracer against one ray at a time, colours that views agree on, its folder on disk."""

import json
import math

import cv2
import numpy as np
import pytest
import torch

from benchmarks.town import write
from benchmarks.town.layout import build_town
from benchmarks.town.palettes import PALETTES, palette
from benchmarks.town.render import cast, colours, directions, geometry, render, shadowed, walk
from benchmarks.town.shapes import Cylinder, Ellipsoid, Material, Polyhedron
from benchmarks.town.surface import SKY
from benchmarks.town.write import TownSettings, cached_town, is_town, read_truth, write_town
from fprf.datamanagers.parsers.config import parse_scene
from fprf.errors import DataError
from fprf.plugins.encoders.frozen import street

TOWN = build_town(0)


def slow_enter(shape, o, d):
    """Entry distance of one ray in plain floats, inf where it misses."""
    if isinstance(shape, Polyhedron):
        start = -math.inf
        stop = math.inf
        for n, offset in zip(shape.normals, shape.offsets, strict=True):
            room = offset - sum(float(n[i]) * o[i] for i in range(3))
            slope = sum(float(n[i]) * d[i] for i in range(3))
            if slope == 0:
                if room < 0:
                    return math.inf
            elif slope < 0:
                start = max(start, room / slope)
            else:
                stop = min(stop, room / slope)
        return start if 1e-4 < start <= stop else math.inf
    if isinstance(shape, Ellipsoid):
        p, q = (
            [(v[i] - w[i]) / shape.radii[i] for i in range(3)] for v, w in ((o, shape.centre), (d, (0, 0, 0)))
        )
    else:
        p = [(v[i] - w[i]) / shape.radius for i in range(2) for v, w in ((o, shape.centre),)]
        q = [d[i] / shape.radius for i in range(2)]
    a = sum(v * v for v in q)
    b = 2 * sum(v * w for v, w in zip(p, q, strict=True))
    c = sum(v * v for v in p) - 1
    if b * b - 4 * a * c <= 0:
        return math.inf
    t = (-b - math.sqrt(b * b - 4 * a * c)) / (2 * a)
    if isinstance(shape, Cylinder) and not shape.low[2] <= o[2] + t * d[2] <= shape.high[2]:
        return math.inf
    return t if t > 1e-4 else math.inf


def test_depth_and_face_are_those_of_a_plain_loop():
    town = build_town(3)
    rng = np.random.default_rng(3)
    for view in walk(seed=3, views=5, width=40, height=30):
        d = np.stack(directions(view, 1), -1)
        distance, face = cast(town, view, directions(view, 1), 1)
        for row, column in zip(rng.integers(0, 30, 24), rng.integers(0, 40, 24), strict=True):
            place = view.pose[:, 3].tolist()
            way = d[row, column].tolist()
            ground = -place[2] / way[2] if way[2] < 0 else math.inf
            slow = min(ground, *(slow_enter(shape, place, way) for shape in town.shapes))
            assert distance[row, column] == pytest.approx(slow, rel=1e-10)
            assert (face[row, column] < 0) == (slow == math.inf)
        # Every ray meets its flat face from outside, on its plane and within its extent.
        flat = (face > 0) & ~town.faces.curve[face].any(-1)
        u, v, origin = (part[face[flat]] for part in (town.faces.u, town.faces.v, town.faces.origin))
        normal = np.cross(u, v)
        at = view.pose[:, 3] + distance[flat][:, None] * d[flat] - origin
        assert flat.sum() > 100 and ((normal * d[flat]).sum(1) < 0).all()
        assert np.abs((at * normal).sum(1)).max() < 1e-9
        within = np.stack([(at * u).sum(1), (at * v).sum(1)], 1)
        assert (within > -1e-9).all() and (within < town.faces.extent[face[flat]] + 1e-9).all()


def test_shadows_are_those_of_a_plain_loop():
    rng = np.random.default_rng(5)
    points = np.column_stack([rng.uniform(-5, 40, 150), rng.uniform(-8, 8, 150), rng.uniform(0, 3, 150)])
    sun = np.array([-0.5, -0.6, 0.6])
    sun /= np.linalg.norm(sun)
    leafy = np.array([TOWN.faces.material[k] == Material.FOLIAGE for k in TOWN.first])
    solid, leaves = shadowed(TOWN, points, sun, leafy)
    for k, p in enumerate(points.tolist()):
        hits = np.array([slow_enter(shape, p, sun.tolist()) < math.inf for shape in TOWN.shapes])
        assert (solid[k], leaves[k]) == (bool((hits & ~leafy).any()), bool((hits & leafy).any()))
    assert 0.1 < (solid | leaves).mean() < 0.9


def test_views_agree_on_colours():
    """What two cameras both see has the same colour in both, up to the pixels' footprints."""
    big = walk(seed=0, views=40, width=120, height=90)
    a = big[2]
    b = big[3]
    one, two = (colours(TOWN, view, palette("day"), 1) for view in (a, b))
    points, seen = world(a, geometry(TOWN, a)[0])
    row, column, distance = project(b, points)
    there = geometry(TOWN, b)[0][row, column]
    both = (row >= 0) & (np.abs(there - distance) < 0.02 * there)
    assert both.sum() > 1000
    difference = np.abs(one[seen] - two[row, column])[both].mean(1)
    assert np.median(difference) < 0.02 and difference.mean() < 0.05


def test_the_pictures_that_encoders_are_measured_on_are_the_towns():
    town = build_town(0)
    views = walk(seed=0, views=len(PALETTES), width=160, height=128)
    pictures = [render(town, view, look).rgb for view, look in zip(views, PALETTES.values(), strict=True)]
    assert np.array_equal((street() * 255).round().byte().permute(0, 2, 3, 1).numpy(), np.stack(pictures))


def test_towns_are_functions_of_their_seed():
    for field in ("material", "tint", "origin", "extent"):
        a, b, c = (getattr(build_town(seed).faces, field) for seed in (1, 1, 2))
        assert np.array_equal(a, b)
        assert not np.array_equal(a, c)
    first, same, other = (walk(seed=s, views=4, width=8, height=8) for s in (1, 1, 2))
    assert all(np.array_equal(a.pose, b.pose) for a, b in zip(first, same, strict=True))
    assert not any(np.array_equal(a.pose, b.pose) for a, b in zip(first, other, strict=True))


def world(view, depth):
    """Points [N 3] at finite depths, and the mask of these [H W]."""
    seen = np.isfinite(depth)
    return view.pose[:, 3] + np.stack(directions(view, 1), -1)[seen] * depth[seen][:, None], seen


def project(view, points):
    """Row, column and distance of points [N 3]; row -1 where they lie outside the image."""
    off = points - view.pose[:, 3]
    local = off @ view.pose[:, :3]
    with np.errstate(divide="ignore", invalid="ignore"):
        x = view.focal * local[:, 0] / -local[:, 2] + view.width / 2
        y = -view.focal * local[:, 1] / -local[:, 2] + view.height / 2
        inside = (local[:, 2] < -0.05) & (x >= 0) & (y >= 0) & (x < view.width) & (y < view.height)
        row = np.where(inside, np.floor(y), -1).astype(int)
        column = np.where(inside, np.floor(x), -1).astype(int)
    return row, column, np.linalg.norm(off, axis=1)


SMALL = {"seed": 2, "palette": "autumn", "views": 9, "width": 24, "height": 18}
TINY = {**SMALL, "views": 2}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("towns") / "town"
    write_town(path, **SMALL)
    return path


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    return tmp_path / "cache" / "fprf"


def test_files_are_the_pictures(folder):
    town = build_town(2)
    views = walk(seed=2, views=9, width=24, height=18)
    for k in (0, 7):
        shot = render(town, views[k], palette("autumn"))
        assert np.array_equal(cv2.imread(str(folder / f"images/{k:04d}.png"))[..., ::-1], shot.rgb)
        depth, kinds = read_truth(folder, k)
        assert np.array_equal(depth, shot.depth) and np.array_equal(kinds, shot.labels)
        assert np.array_equal(np.isinf(depth), kinds == SKY)


def test_points_lie_on_surfaces(folder):
    with np.load(folder / "points.npz") as stored:
        xyz = stored["xyz"]
        rgb = stored["rgb"]
    assert xyz.shape == rgb.shape and len(xyz) > 7 * 100 and xyz[:, 2].min() > -0.01
    assert (xyz.dtype, rgb.dtype) == (np.float32, np.uint8)
    row, column, distance = project(walk(seed=2, views=9, width=24, height=18)[1], xyz[: write._POINTS])
    np.testing.assert_allclose(distance, read_truth(folder, 1)[0][row, column], rtol=1e-4)


def test_a_damaged_folder_is_rendered_again(tmp_path):
    path = tmp_path / "town"
    write_town(path, **TINY)
    (path / "images/0001.png").unlink()
    write_town(path, **TINY)
    assert (path / "images/0001.png").is_file()
    write_town(path, **{**TINY, "palette": "night"})
    assert json.loads((path / "palette.json").read_text())["name"] == "night"
    assert [p.name for p in tmp_path.iterdir()] == ["town"]


def test_somebody_elses_folder_is_left_alone(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(DataError, match="not a town"):
        write_town(tmp_path, **SMALL)
    assert [p.name for p in tmp_path.iterdir()] == ["notes.txt"]
    assert not is_town(tmp_path)


def test_the_cached_town_is_rendered_once(cache, monkeypatch):
    folder = cached_town(**TINY)
    assert folder == cache / f"town-{TownSettings(**TINY).key}" / "town"
    scene = parse_scene(folder, 1, None)
    assert scene.name == "town" and len(scene.cameras) == 2
    assert (scene.train.tolist(), scene.test.tolist()) == ([1], [0])
    assert scene.points is not None
    assert scene.cameras.size.tolist() == [[24, 18]] * 2
    poses = np.stack([view.pose for view in walk(seed=2, views=2, width=24, height=18)])
    torch.testing.assert_close(scene.cameras.pose, torch.from_numpy(poses), atol=1e-12, rtol=0)
    monkeypatch.setattr(write, "_fill", lambda *_: pytest.fail("rendered again"))
    assert cached_town(**TINY) == folder
