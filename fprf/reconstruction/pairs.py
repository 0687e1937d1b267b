"""Pairs of images to match: in order, or those that share features.

How many features two images share is estimated before they are matched by their largest ones alone (preemptive
matching: Wu, Towards Linear-Time Incremental Structure from Motion, 2013): 300 of each take a third of a
millisecond a pair. Of 1485 pairs of a drone's survey the 20 best of each image held 90 % of all verified
matches; 20 by VLAD 76 %, by GPS 76 %, by pooled tokens of DINOv2 71 % (benchmarks/results/process.json).
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, TypeAlias

import numpy as np
from numpy.typing import NDArray

from .scene_folder import reading

Pair: TypeAlias = tuple[int, int]
Descriptors = Annotated[NDArray[np.uint8], "N 128"]
Shared = Annotated[NDArray[np.int64], "V V"]

LARGEST_FEATURES = 300
"""Features of an image that are compared: 800 find hardly other pairs and take seven times as long."""
_MAX_ANGLE_RATIO = 0.8
"""Angle to the nearest descriptor over that to the second: Lowe's ratio test, as COLMAP has it."""
_FAR_NEIGHBOURS = 4
"""Partners of an image outside of its partners' partners: they close the loops of a walk. By eye."""
_MIN_FAR_SHARED = 8
"""Features that it shares with these, at least: of pairs that share so many nine in ten are true, of 12 nearly
all."""
_MIN_NORM = 1e-9
"""Descriptors are divided by no smaller norm."""


def largest_features(path: Path, name: str, count: int) -> Descriptors:
    """SIFT descriptors [N 128] of the `count` largest features of an image, or of all; none for an image without."""
    with reading(path) as base:
        row = base.execute(
            "SELECT k.rows, k.cols, k.data, d.data FROM keypoints k JOIN descriptors d USING (image_id) "
            "JOIN images USING (image_id) WHERE name = ?",
            (name,),
        ).fetchone()
    if row is None or not row[0]:
        return np.zeros((0, 128), np.uint8)
    # A keypoint is x, y and a 2 x 2 matrix, whose determinant is its area.
    keypoints = np.frombuffer(row[2], np.float32).reshape(row[0], row[1])
    area = np.abs(keypoints[:, 2] * keypoints[:, 5] - keypoints[:, 3] * keypoints[:, 4])
    largest = np.argsort(-area, kind="stable")[:count]
    return np.frombuffer(row[3], np.uint8).reshape(row[0], 128)[largest]


def sequential_pairs(count: int, overlap: int) -> list[Pair]:
    """Each with the next `overlap` ones, and with those at distances 2, 4, 8, ... up to 2 ** overlap."""
    steps = sorted({*range(1, overlap + 1), *(2**k for k in range(overlap + 1))})
    found: list[Pair] = []
    for a in range(count):
        for step in steps:
            if a + step < count:
                found.append((a, a + step))
    return found


def shared_features(images: Sequence[Descriptors], progress: Callable[[int, int], None]) -> Shared:
    """Counts of descriptors of any two images that are nearest to one another, and clearly nearer than the next;
    0 of an image with itself. `progress` is told (images done, all).
    """
    units = []
    for descriptors in images:
        values = descriptors.astype(np.float32)
        units.append(values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), _MIN_NORM))
    shared = np.zeros((len(units), len(units)), np.int64)
    for a, first in enumerate(units):
        progress(a, len(units))
        for b in range(a + 1, len(units)):
            shared[a, b] = _count_mutual(first, units[b])
    progress(len(units), len(units))
    return shared + shared.T


def _count_mutual(
    a: Annotated[NDArray[np.float32], "N 128"], b: Annotated[NDArray[np.float32], "M 128"]
) -> int:
    """Unit vectors of two sets that are nearest to one another, and pass the ratio test."""
    if len(a) == 0 or len(b) < 2:
        return 0
    cosine = a @ b.T
    rows = np.arange(len(a))
    nearest = cosine.argmax(axis=1)
    mutual = cosine.argmax(axis=0)[nearest] == rows
    best = cosine[rows, nearest]
    cosine[rows, nearest] = -1.0
    second = cosine.max(axis=1)
    clear = np.arccos(best.clip(-1, 1)) < _MAX_ANGLE_RATIO * np.arccos(second.clip(-1, 1))
    return int((mutual & clear).sum())


def similar_pairs(shared: Shared, nearest: int) -> list[Pair]:
    """Each image with the `nearest` ones that it shares most features with, and with a few beyond their partners;
    with none that it shares nothing with.
    """
    count = len(shared)
    linked = np.eye(count, dtype=bool)
    _link_best(linked, shared, nearest)
    # Images next to one another fill the lists of a walk; where it comes back, partners of partners end.
    reached = (linked.astype(np.float32) @ linked.astype(np.float32)) > 0
    _link_best(linked, np.where(reached | (shared < _MIN_FAR_SHARED), 0, shared), _FAR_NEIGHBOURS)
    first, second = np.nonzero(np.triu(linked, 1))
    return list(zip(first.tolist(), second.tolist(), strict=True))


def _link_best(linked: Annotated[NDArray[np.bool_], "V V"], shared: Shared, nearest: int) -> None:
    """Link each image with those that it shares most with; of equal ones with the first."""
    best = np.argsort(-shared, axis=1, kind="stable")[:, :nearest]
    for a, row in enumerate(best.tolist()):
        for b in row:
            if shared[a, b] > 0:
                linked[a, b] = True
                linked[b, a] = True
