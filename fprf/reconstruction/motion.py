"""Motion from image to image, by the verified matches in COLMAP's database."""

import contextlib
import sqlite3
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from .scene_folder import MIN_MATCHES, PAIR_FACTOR, reading

_MAX_STILL_PIXELS = 1.0
"""Shift of a match that stands still: features are found to a third of a pixel, and JPEG moves them a little."""


def still_share(path: Path) -> float:
    """Share of the matched pairs of images of which most verified matches lie at the same pixels; 0 without
    pairs.

    Pairs of a camera that moved share few pixels, whatever it moved past.
    """
    places: dict[int, NDArray[np.float32]] = {}
    still = 0
    pairs = 0
    with contextlib.suppress(sqlite3.Error), reading(path) as base:
        for number, rows, columns, data in base.execute("SELECT image_id, rows, cols, data FROM keypoints"):
            places[number] = np.frombuffer(data, np.float32).reshape(rows, columns)[:, :2]
        query = "SELECT pair_id, rows, data FROM two_view_geometries WHERE rows >= ?"
        for pair, rows, data in base.execute(query, (MIN_MATCHES,)):
            first, second = divmod(pair, PAIR_FACTOR)
            matches = np.frombuffer(data, np.uint32).reshape(rows, 2)
            pairs += 1
            still += _stands_still(places[first], places[second], matches)
    return still / pairs if pairs else 0.0


def _stands_still(
    first: Annotated[NDArray[np.float32], "N 2"],
    second: Annotated[NDArray[np.float32], "M 2"],
    matches: Annotated[NDArray[np.uint32], "K 2"],
) -> bool:
    """True where half of the matches lie at the same pixels."""
    shift = np.linalg.norm(first[matches[:, 0]] - second[matches[:, 1]], axis=1)
    return float(np.median(shift)) <= _MAX_STILL_PIXELS
