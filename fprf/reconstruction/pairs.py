"""Which pairs of images are matched: in order, or those that look alike.

Which images look alike is told before they are matched by one vector each (VLAD, Jégou et al., 2010), from a
vocabulary of the scene's own features: descriptors are assigned to visual words, k-means centres of a sample
of all; the differences to the centres are summed word by word, tamed by a square root and scaled to length 1,
word by word and altogether.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from .scene_folder import reading

Pair: TypeAlias = tuple[int, int]
Descriptors = Annotated[NDArray[np.uint8], "N 128"]
Words = Annotated[NDArray[np.float32], "W 128"]
Reader = Callable[[int], Descriptors]

VISUAL_WORDS = 64
"""Words of a vocabulary: as VLAD's authors take, whose figures change little from 16 to 256."""
_VOCABULARY_DESCRIPTORS = 40_000
"""Descriptors that the words are made of: 600 a word. By eye."""
_MAX_VECTOR_DESCRIPTORS = 2000
"""Descriptors of an image, evenly taken, that its vector is made of: more change it little. By eye."""
_MAX_KMEANS_ROUNDS = 12
"""Rounds of k-means: words need not be exact. By eye."""
_MIN_LENGTH = 1e-12
"""Lengths are divided by no less: a word without descriptors has none."""


def descriptors(path: Path, name: str) -> NDArray[np.uint8]:
    """SIFT descriptors [N 128] of an image; none for an image without."""
    with reading(path) as base:
        row = base.execute(
            "SELECT rows, cols, data FROM descriptors JOIN images USING (image_id) WHERE name = ?", (name,)
        ).fetchone()
    if row is None or not row[0]:
        return np.zeros((0, 128), np.uint8)
    return np.frombuffer(row[2], np.uint8).reshape(row[0], row[1])


def sequential_pairs(count: int, overlap: int) -> list[Pair]:
    """Each with the next `overlap` ones, and with those at distances 2, 4, 8, ... up to 2 ** overlap."""
    steps = sorted({*range(1, overlap + 1), *(2**k for k in range(overlap + 1))})
    found: list[Pair] = []
    for a in range(count):
        for step in steps:
            if a + step < count:
                found.append((a, a + step))
    return found


def similar_pairs(vectors: Annotated[NDArray[np.float32], "V X"], nearest: int) -> list[Pair]:
    """Each with those whose unit vectors are most like its own, by cosine; an image without a vector (all 0)
    with none.
    """
    # Cosines, without those of images with themselves and of images that nothing is known of.
    likeness = vectors @ vectors.T
    empty = ~vectors.any(axis=1)
    likeness[empty] = likeness[:, empty] = -np.inf
    np.fill_diagonal(likeness, -np.inf)
    count = min(nearest, max(0, len(vectors) - 1))
    best = np.argsort(-likeness, axis=1, kind="stable")[:, :count]
    pairs = set()
    for a, row in enumerate(best.tolist()):
        for b in row:
            if np.isfinite(likeness[a, b]):
                pairs.add((min(a, b), max(a, b)))
    return sorted(pairs)


def build_vocabulary(read: Reader, count: int, number: int, seed: int = 0) -> Words:
    """`number` visual words, or fewer where there are fewer descriptors; `read(i)` gives those of image i of
    `count`.
    """
    # A sample of all descriptors, as many of each image.
    rng = np.random.default_rng(seed)
    each = max(1, _VOCABULARY_DESCRIPTORS // max(1, count))
    parts = []
    for image in range(count):
        features = read(image)
        parts.append(features[rng.permutation(len(features))[:each]])
    if parts:
        sample = np.concatenate(parts).astype(np.float32)
    else:
        sample = np.zeros((0, 128), np.float32)
    if len(sample) <= number:
        return sample
    # cv2 draws from a generator of its own.
    stop = (cv2.TERM_CRITERIA_MAX_ITER | cv2.TERM_CRITERIA_EPS, _MAX_KMEANS_ROUNDS, 1e-3)
    cv2.setRNGSeed(seed)
    start = rng.permutation(len(sample))[:number]
    # k-means begins with some of the descriptors as centres: cv2 takes them as the labels of all.
    labels = np.argmin(_distances(sample, sample[start]), axis=1).astype(np.int32)[:, None]
    centres = cv2.kmeans(sample, number, labels, stop, 1, cv2.KMEANS_USE_INITIAL_LABELS)[2]
    return np.asarray(centres, dtype=np.float32)


def vlad_vectors(read: Reader, count: int, vocabulary: Words) -> Annotated[NDArray[np.float32], "V X"]:
    """A unit vector an image; 0 for an image without descriptors."""
    result = np.zeros((count, vocabulary.size), np.float32)
    for image in range(count):
        features = read(image)
        some = features[:: -(-len(features) // _MAX_VECTOR_DESCRIPTORS) or 1].astype(np.float32)
        if not len(some) or not len(vocabulary):
            continue
        # Differences to the nearest word, summed word by word, tamed, and scaled to length 1 word by word and
        # altogether.
        nearest = np.argmin(_distances(some, vocabulary), axis=1)
        sums = np.zeros_like(vocabulary)
        np.add.at(sums, nearest, some - vocabulary[nearest])
        sums = np.sign(sums) * np.sqrt(np.abs(sums))
        sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), _MIN_LENGTH)
        flat = sums.reshape(-1)
        result[image] = flat / max(float(np.linalg.norm(flat)), _MIN_LENGTH)
    return result


def _distances(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.float32]:
    """Squared distances less a constant of each row."""
    distances: NDArray[np.float32] = (b * b).sum(1)[None] - 2 * (a @ b.T)
    return distances
