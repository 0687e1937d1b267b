"""Pairs of images, COLMAP's database and reports; the town's poses by the real COLMAP."""

import shutil
import sqlite3
import sys
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.town.write import write_town
from fprf.cli import main as cli
from fprf.datamanagers.parsers.config import parse_scene
from fprf.io.video import write_video
from fprf.reconstruction.pairs import largest_features, sequential_pairs, shared_features, similar_pairs
from fprf.reconstruction.scene_folder import MatchTables, count_rows, report, tried_pairs

MOST = 2147483647
TRIED = (("a", "sub/c"), ("sub/c", "lonely"), ("a", "odd"), ("sub/c", "odd"))


def misses(found: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """How far poses [V 3 4] are from the truth after the similarity that brings their places closest
    (Umeyama, 1991).

    Largest distance as a share of the diagonal of the true places' box, and largest angle in degrees.
    """
    a, b = (poses[:, :, 3] - poses[:, :, 3].mean(0) for poses in (found, truth))
    u, d, vt = np.linalg.svd(b.T @ a / len(a))
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    turn = u * sign @ vt
    scale = (d * sign).sum() / (a**2).sum(1).mean()
    away = np.linalg.norm(scale * a @ turn.T - b, axis=1) / np.linalg.norm(np.ptp(b, axis=0))
    cosine = (np.einsum("ij,vjk,vik->v", turn, found[:, :, :3], truth[:, :, :3]) - 1) / 2
    return float(away.max()), float(np.degrees(np.arccos(cosine.clip(-1, 1))).max())


@pytest.fixture
def database(tmp_path: Path) -> Path:
    """Images a, sub/c and odd fit by 30 matches; b has no features, lonely fits one by 5, too few."""
    path = tmp_path / "the database.db"
    base = sqlite3.connect(path)
    base.executescript(
        """CREATE TABLE images (image_id INTEGER PRIMARY KEY, name TEXT, camera_id INTEGER);
        CREATE TABLE keypoints (image_id INTEGER, rows INTEGER, cols INTEGER, data BLOB);
        CREATE TABLE descriptors (image_id INTEGER, rows INTEGER, cols INTEGER, data BLOB);
        CREATE TABLE two_view_geometries (pair_id INTEGER PRIMARY KEY, rows INTEGER);
        INSERT INTO images VALUES (1, 'a', 1), (2, 'b', 1), (5, 'sub/c', 1), (9, 'lonely', 1), (10, 'odd', 1);
        INSERT INTO keypoints VALUES (1, 70, 6, ''), (2, 0, 6, ''), (5, 60, 6, ''), (9, 50, 6, ''), (10, 40, 6, '');"""
    )
    # The third of a's features is the largest, the first the next: its frame is turned and mirrored.
    frames = np.array([[0, 0, 0, 3, 3, 0], [0, 0, 1, 0, 0, 2], [0, 0, 4, 1, 1, -4]], np.float32)
    described = np.arange(3 * 128, dtype=np.uint8).reshape(3, 128)
    base.execute("UPDATE keypoints SET rows = 3, data = ? WHERE image_id = 1", (frames.tobytes(),))
    base.execute("INSERT INTO descriptors VALUES (1, 3, 128, ?)", (described.tobytes(),))
    pairs = {(1, 5): 30, (5, 9): 5, (1, 10): 30, (5, 10): 30, (7, 8): 50}
    base.executemany(
        "INSERT INTO two_view_geometries VALUES (?, ?)", [(a * MOST + b, n) for (a, b), n in pairs.items()]
    )
    base.commit()
    base.close()
    return path


def test_progress_and_descriptors(database: Path, tmp_path: Path) -> None:
    assert count_rows(database) == (5, 5)
    described = np.arange(3 * 128, dtype=np.uint8).reshape(3, 128)
    assert np.array_equal(largest_features(database, "a", 2), described[[2, 0]])
    assert np.array_equal(largest_features(database, "a", 9), described[[2, 0, 1]])
    assert largest_features(database, "b", 9).shape == (0, 128)
    assert tried_pairs(database) == {frozenset(each) for each in TRIED}
    assert count_rows(tmp_path / "absent.db") == (0, 0) and not (tmp_path / "absent.db").exists()
    (tmp_path / "other.db").write_bytes(b"no database at all" * 99)
    assert count_rows(tmp_path / "other.db") == (0, 0)
    with pytest.raises(sqlite3.Error):
        MatchTables(tmp_path / "other.db")


def test_every_image_has_its_reason(database: Path) -> None:
    images = dict.fromkeys(["a", "apart", "b", "sub/c", "lonely", "odd"])
    state = {
        "source": "/photos",
        "images": images,
        "dropped": {"x.jpg": "the JPEG is truncated"},
        "seconds": {},
    }
    figures = {"points": 10, "error_pixels": 0.5, "track_length": 3.0}
    models = [{"images": ["a"], **figures}, {"images": ["sub/c", "elsewhere"], **figures}]
    content = report(state, "exhaustive", MatchTables(database), models, "1.0")
    assert content["images"] == {"given": 7, "used": 6, "posed": 1} and content["parts"] == [1, 2]
    rows = [(drop["step"], drop["image"], drop["reason"]) for drop in content["dropped"]]
    told = [
        ("choosing", "x.jpg"),
        ("features", "apart"),
        ("features", "b"),
        ("matching", "lonely"),
        ("mapping", "sub/c"),
    ]
    assert [row[:2] for row in rows] == [*told, ("mapping", "odd")]
    assert rows[0][2] == "the JPEG is truncated" and "no other image" in rows[3][2]
    assert rows[4][2] == "in part 2 (2 images), apart from the rest; take views in between"
    assert rows[5][2] == "fits 2 images, but no pose was found for it"


def proper(pairs: list[tuple[int, int]], count: int) -> bool:
    return all(0 <= a < b < count for a, b in pairs) and pairs == sorted(set(pairs))


@settings(deadline=None)
@given(st.integers(0, 30), st.integers(1, 12))
def test_sequential_reaches_neighbours_and_powers_of_two(count: int, overlap: int) -> None:
    pairs = sequential_pairs(count, overlap)
    assert proper(pairs, count)
    apart = {*range(1, overlap + 1), *(2**k for k in range(overlap + 1))}
    assert {b - a for a, b in pairs} == {step for step in apart if step < count}


@settings(deadline=None)
@given(st.integers(0, 20), st.integers(1, 8), st.integers(0, 99))
def test_similar_finds_those_that_share_most(count: int, nearest: int, seed: int) -> None:
    order = 1 + np.random.default_rng(seed).permutation(count * count)
    drawn = np.triu(order.reshape(count, count), 1)
    shared = drawn + drawn.T
    pairs = similar_pairs(shared, nearest)
    assert proper(pairs, count)
    for a in range(count):
        others = sorted((b for b in range(count) if b != a), key=lambda b: -shared[a, b])
        assert all((min(a, b), max(a, b)) in pairs for b in others[:nearest])


def test_a_walk_that_comes_back_is_closed() -> None:
    """Forty images in a row share many features with the next ones; the last ten see what the first ten saw."""
    place = np.array([*range(40), *range(10)])
    apart = np.abs(place[:, None] - place[None])
    shared = np.where(apart < 5, 100 - 20 * apart, 0)
    again = np.abs(np.arange(50)[:, None] - np.arange(50)[None]) >= 40
    shared[again] //= 6  # seen from the other side: fewer than any of the nearest four
    np.fill_diagonal(shared, 0)
    pairs = similar_pairs(shared, 4)
    closing = [(a, b) for a, b in pairs if b - a >= 40]
    assert len(closing) >= 6 and len(pairs) < 50 * 4
    lonely = np.zeros((5, 5), np.int64)
    assert similar_pairs(lonely, 3) == []


def test_shared_features_are_counted_as_one_by_one() -> None:
    """Eight places, three images of each: a place has features of its own, seen with noise and among
    others.
    """
    drawn = np.random.default_rng(0)
    images = [np.zeros((0, 128), np.uint8)]
    for _ in range(8):
        own = drawn.gamma(0.6, 40, (120, 128))
        for _ in range(3):
            seen = own[drawn.permutation(120)[:80]] + drawn.normal(0, 6, (80, 128))
            images.append(
                np.concatenate([seen, drawn.gamma(0.6, 40, (30, 128))]).clip(0, 255).astype(np.uint8)
            )
    told: list[tuple[int, int]] = []
    shared = shared_features(images, lambda done, total: told.append((done, total)))
    assert told[-1] == (25, 25) and np.array_equal(shared, shared.T)
    assert not shared[0].any() and not shared.diagonal().any()
    place = (np.arange(25) + 2) // 3
    same = (place[:, None] == place[None]) & (np.arange(25)[:, None] != np.arange(25)[None])
    assert shared[same].min() > 30 > 5 > shared[~same].max()
    # One pair, one feature at a time, in float64.
    a, b = (
        each.astype(np.float64) / np.linalg.norm(each.astype(np.float64), axis=1)[:, None]
        for each in images[1:3]
    )
    angle = np.arccos((a @ b.T).clip(-1, 1))
    count = 0
    for row in range(len(a)):
        first, second = np.argsort(angle[row])[:2]
        count += angle[row, first] < 0.8 * angle[row, second] and np.argmin(angle[:, first]) == row
    assert shared[1, 2] == count
    assert {(a, b) for a, b in similar_pairs(shared, 2)} == {(a, b) for a, b in np.argwhere(same) if a < b}


pytestmark = pytest.mark.skipif(find_spec("pycolmap") is None, reason="pycolmap is not installed (extra sfm)")


def process(town: Path, source: Path, *options: str) -> tuple[Path, dict[int, int]]:
    """The town's views through COLMAP, from photographs of a phone where `source` is a folder: the scene, and
    its view of each frame of the source.
    """
    views = [cv2.imread(str(path)) for path in sorted((town / "images").glob("*.png"))]
    if source.suffix:  # each view twice, the second time as a shaking hand takes it
        pairs = [
            cv2.cvtColor(frame, cv2.COLOR_BGR2RGB)
            for view in views
            for frame in (view, cv2.blur(view, (15, 1)))
        ]
        write_video(source, pairs, 12)
    else:
        source.mkdir()
        for k, view in enumerate(views):
            assert cv2.imwrite(str(source / f"{k:04d}.jpg"), view, [cv2.IMWRITE_JPEG_QUALITY, 92])
    scene = town.with_name("scene")
    assert cli.main(["process", str(source), "--output", str(scene), *options]) == 0
    assert "pycolmap" not in sys.modules
    found = parse_scene(scene, 1, None)
    return scene, {int(path.stem.removeprefix("frame_")): view for view, path in enumerate(found.paths)}


def test_a_few_small_photographs_find_their_poses(tmp_path: Path) -> None:
    """COLMAP itself, in processes of its own; the long test below asks for more."""
    write_town(tmp_path / "town", seed=0, palette="day", views=16, width=320, height=240)
    scene, views = process(tmp_path / "town", tmp_path / "phone")
    found = parse_scene(scene, 1, None)
    truth = parse_scene(tmp_path / "town", 1, None)
    away, degrees = misses(
        found.cameras.pose[list(views.values())].numpy(), truth.cameras.pose[list(views)].numpy()
    )
    assert len(views) >= 12 and away < 0.03 and degrees < 4


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize(("source", "each"), [("phone", 1), ("clip.mp4", 2)])
def test_poses_of_the_town_are_within_a_percent_of_the_truth(tmp_path: Path, source: str, each: int) -> None:
    write_town(tmp_path / "town", seed=0, palette="day", views=40, width=640, height=480)
    scene, views = process(tmp_path / "town", tmp_path / source, "--frames", "40")
    assert len(views) >= 38 and not any(number % each for number in views), (
        "the sharp ones, and nearly all of them"
    )
    found = parse_scene(scene, 1, None)
    truth = parse_scene(tmp_path / "town", 1, None)
    true = truth.cameras.pose[[number // each for number in views]].numpy()
    away, degrees = misses(found.cameras.pose[list(views.values())].numpy(), true)
    assert away < 0.01 and degrees < 0.5
    assert float(found.cameras.focal[0, 0] / truth.cameras.focal[0, 0]) == pytest.approx(1, abs=0.01)
    shutil.rmtree(scene / "sfm")
    assert len(parse_scene(scene, 1, None).paths) == len(views), "what is only needed to go on may go"
