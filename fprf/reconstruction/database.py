"""Reading COLMAP's database, an SQLite file, while COLMAP may be writing it. Nothing here writes."""

import contextlib
import sqlite3
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

__all__ = ["Tables", "counts", "descriptors"]

_MAX_IMAGES = 2147483647
"""A pair of images is stored as _MAX_IMAGES * smaller id + larger id."""


class Tables:
    """What a database says of images, by their names. Raises sqlite3.Error for what is no database of COLMAP's."""

    def __init__(self, path: Path) -> None:
        with _reading(path) as base:
            self.ids: dict[str, int] = dict(base.execute("SELECT name, image_id FROM images"))
            self.features: dict[int, int] = dict(base.execute("SELECT image_id, rows FROM keypoints"))
            rows = base.execute("SELECT pair_id, rows FROM two_view_geometries").fetchall()
        names = {id_: name for name, id_ in self.ids.items()}
        self.matches: dict[tuple[str, str], int] = {}
        for pair, count in rows:
            a, b = divmod(pair, _MAX_IMAGES)
            if a in names and b in names:
                self.matches[names[a], names[b]] = count

    def features_of(self, name: str) -> int:
        """Features found in an image; 0 for one that is not there."""
        return self.features.get(self.ids.get(name, -1), 0)

    def partners(self, name: str, least: int) -> int:
        """Images that share at least `least` verified matches with an image."""
        return sum(count >= least for pair, count in self.matches.items() if name in pair)


def counts(path: Path) -> tuple[int, int]:
    """Images with features and pairs that were tried so far; zeros while the database cannot be read."""
    with contextlib.suppress(sqlite3.Error, OSError), _reading(path) as base:
        features = base.execute("SELECT COUNT(*) FROM keypoints").fetchone()[0]
        return int(features), int(base.execute("SELECT COUNT(*) FROM two_view_geometries").fetchone()[0])
    return 0, 0


def descriptors(path: Path, name: str) -> NDArray[np.uint8]:
    """SIFT descriptors [N 128] of an image; none for an image without."""
    with _reading(path) as base:
        row = base.execute(
            "SELECT rows, cols, data FROM descriptors JOIN images USING (image_id) WHERE name = ?", (name,)
        ).fetchone()
    if row is None or not row[0]:
        return np.zeros((0, 128), np.uint8)
    return np.frombuffer(row[2], np.uint8).reshape(row[0], row[1])


@contextlib.contextmanager
def _reading(path: Path) -> Iterator[sqlite3.Connection]:
    base = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True, timeout=5)
    try:
        yield base
    finally:
        base.close()
