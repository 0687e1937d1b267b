import sqlite3
from pathlib import Path

import numpy as np
import pytest

from fprf.reconstruction.colmap import Tables, counts, descriptors

MOST = 2147483647


@pytest.fixture
def database(tmp_path: Path) -> Path:
    """Images a, b, c and e; b has no features; a-c fit by 30 matches, c-e by 5."""
    path = tmp_path / "the database.db"
    base = sqlite3.connect(path)
    base.executescript(
        """CREATE TABLE images (image_id INTEGER PRIMARY KEY, name TEXT, camera_id INTEGER);
        CREATE TABLE keypoints (image_id INTEGER, rows INTEGER, cols INTEGER, data BLOB);
        CREATE TABLE descriptors (image_id INTEGER, rows INTEGER, cols INTEGER, data BLOB);
        CREATE TABLE two_view_geometries (pair_id INTEGER PRIMARY KEY, rows INTEGER);
        INSERT INTO images VALUES (1, 'a', 1), (2, 'b', 1), (5, 'sub/c', 1), (9, 'e', 1);
        INSERT INTO keypoints VALUES (1, 70, 6, ''), (2, 0, 6, ''), (5, 60, 6, '');"""
    )
    base.execute("INSERT INTO descriptors VALUES (1, 2, 128, ?)", (bytes(range(128)) * 2,))
    base.executemany(
        "INSERT INTO two_view_geometries VALUES (?, ?)", [(1 * MOST + 5, 30), (5 * MOST + 9, 5), (7 * MOST + 8, 50)]
    )
    base.commit()
    base.close()
    return path


def test_what_is_known_of_images(database: Path) -> None:
    found = Tables(database)
    assert [found.features_of(name) for name in ("a", "b", "sub/c", "e", "absent")] == [70, 0, 60, 0, 0]
    assert found.matches == {("a", "sub/c"): 30, ("sub/c", "e"): 5}, "a pair of unknown images is left out"
    assert [found.partners(name, 15) for name in ("a", "b", "sub/c", "e")] == [1, 0, 1, 0]
    assert found.partners("sub/c", 5) == 2


def test_progress_and_descriptors(database: Path, tmp_path: Path) -> None:
    assert counts(database) == (3, 3)
    assert np.array_equal(descriptors(database, "a"), np.arange(128, dtype=np.uint8)[None].repeat(2, 0))
    assert descriptors(database, "b").shape == (0, 128)
    assert counts(tmp_path / "absent.db") == (0, 0) and not (tmp_path / "absent.db").exists()
    (tmp_path / "other.db").write_bytes(b"no database at all" * 99)
    assert counts(tmp_path / "other.db") == (0, 0)
    with pytest.raises(sqlite3.Error):
        Tables(tmp_path / "other.db")


def test_reading_while_another_writes(database: Path) -> None:
    base = sqlite3.connect(database)
    base.execute("PRAGMA journal_mode=WAL")
    base.execute("BEGIN IMMEDIATE")
    base.execute("INSERT INTO keypoints VALUES (9, 10, 6, '')")
    assert counts(database) == (3, 3)
    base.commit()
    assert counts(database) == (4, 3)
    base.close()
