"""Backgrounds that stand still, told by matches; masks for what is not to be used."""

import sqlite3
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from fprf.datamanagers.images import load_mask
from fprf.errors import DataError, UsageError
from fprf.reconstruction.masks import gather_masks
from fprf.reconstruction.motion import still_share
from fprf.reconstruction.scene_folder import PAIR_FACTOR, SceneFolder, State


def database(path: Path, shifts: list[float]) -> Path:
    """Images whose features lie at the same places, but for a share of them shifted; all match all."""
    drawn = np.random.default_rng(0)
    places = drawn.uniform(0, 300, (40, 2)).astype(np.float32)
    base = sqlite3.connect(path)
    base.executescript(
        """CREATE TABLE keypoints (image_id INTEGER PRIMARY KEY, rows INTEGER, cols INTEGER, data BLOB);
        CREATE TABLE two_view_geometries (pair_id INTEGER PRIMARY KEY, rows INTEGER, cols INTEGER, data BLOB);"""
    )
    for number, shift in enumerate(shifts, 1):
        moved = np.zeros((40, 6), np.float32)
        moved[:, :2] = places
        moved[:, 0] += shift
        base.execute("INSERT INTO keypoints VALUES (?, 40, 6, ?)", (number, moved.tobytes()))
    matches = np.arange(40, dtype=np.uint32)[:, None].repeat(2, 1)
    for first in range(1, len(shifts) + 1):
        for second in range(first + 1, len(shifts) + 1):
            pair = first * PAIR_FACTOR + second
            base.execute("INSERT INTO two_view_geometries VALUES (?, 40, 2, ?)", (pair, matches.tobytes()))
    base.execute("INSERT INTO two_view_geometries VALUES (?, 3, 2, ?)", (9, b""))
    base.commit()
    base.close()
    return path


def test_a_background_that_stands_still_is_told_from_a_walk(tmp_path: Path) -> None:
    assert still_share(database(tmp_path / "turntable.db", [0.0, 0.3, 0.1, 0.4])) == 1
    assert still_share(database(tmp_path / "walk.db", [0.0, 5.0, 11.0, 18.0])) == 0
    assert still_share(database(tmp_path / "both.db", [0.0, 0.1, 30.0, 60.0])) == pytest.approx(1 / 6)
    assert still_share(tmp_path / "absent.db") == 0
    (tmp_path / "other.db").write_bytes(b"no database" * 99)
    assert still_share(tmp_path / "other.db") == 0


def scene(root: Path) -> tuple[SceneFolder, State]:
    state = State()
    for k in range(3):
        state.images[f"turn_{k}.jpg"] = {"sha256": str(k), "width": 24, "height": 16, "lens": ["", 0.0, 0]}
    return SceneFolder(root), state


def mask(path: Path, columns: int, size: tuple[int, int] = (24, 16)) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.zeros((size[1], size[0]), np.uint8)
    pixels[:, :columns] = 255
    Image.fromarray(pixels).save(path)


@pytest.mark.parametrize("name", ["turn_{}.png", "turn_{}.jpg.png", "turn_{}_mask.png", "mask_turn_{}.png"])
def test_masks_go_into_the_scene_where_colmap_and_training_find_them(tmp_path: Path, name: str) -> None:
    place, state = scene(tmp_path / "scene")
    for k in range(3):
        mask(tmp_path / "masks" / name.format(k), 4 + k)
    gather_masks(tmp_path / "masks", place, state)
    for k in range(3):
        assert load_mask(place.masks / f"turn_{k}.jpg.png").sum() == (4 + k) * 16
    before = dict(state.masks)
    assert len(before) == 3
    (tmp_path / "masks" / name.format(1)).unlink()
    gather_masks(tmp_path / "masks", place, state)
    assert sorted(path.name for path in place.masks.iterdir()) == ["turn_0.jpg.png", "turn_2.jpg.png"]
    gather_masks(None, place, state)
    assert not list(place.masks.iterdir()) and state.masks == {}


def test_masks_of_other_names_and_shapes_are_refused(tmp_path: Path) -> None:
    place, state = scene(tmp_path / "scene")
    with pytest.raises(UsageError, match="holds no images"):
        gather_masks(tmp_path / "absent", place, state)
    mask(tmp_path / "masks" / "other.png", 3)
    with pytest.raises(UsageError, match=r"other\.png"):
        gather_masks(tmp_path / "masks", place, state)
    mask(tmp_path / "masks" / "turn_1.png", 3, size=(16, 24))
    with pytest.raises(DataError, match=r"turn_1\.png"):
        gather_masks(tmp_path / "masks", place, state)
