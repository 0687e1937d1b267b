"""How alike images are, before they are matched: one vector each, from a vocabulary of the scene's own features.

VLAD (Jégou et al., 2010): descriptors are assigned to visual words, k-means centres of a sample of all; the differences to
the centres are summed word by word, tamed by a square root and scaled to length 1, word by word and altogether. Nothing has
to be downloaded.
"""

from collections.abc import Callable
from typing import Annotated

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["vectors", "words"]

_SAMPLE = 40_000
"""Descriptors that the words are made of, at most."""
_MOST = 2000
"""Descriptors of an image that its vector is made of, at most; taken evenly."""
_ROUNDS = 12

Descriptors = Annotated[NDArray[np.uint8], "N 128"]
Words = Annotated[NDArray[np.float32], "W 128"]
Reader = Callable[[int], Descriptors]


def words(read: Reader, count: int, number: int, seed: int = 0) -> Words:
    """`number` visual words, or fewer where there are fewer descriptors; `read(i)` gives those of image i of `count`."""
    rng = np.random.default_rng(seed)
    each = max(1, _SAMPLE // max(1, count))
    parts = []
    for image in range(count):
        found = read(image)
        parts.append(found[rng.permutation(len(found))[:each]])
    sample = np.concatenate(parts).astype(np.float32) if parts else np.zeros((0, 128), np.float32)
    if len(sample) <= number:
        return sample
    stop = (cv2.TERM_CRITERIA_MAX_ITER | cv2.TERM_CRITERIA_EPS, _ROUNDS, 1e-3)
    cv2.setRNGSeed(seed)
    start = rng.permutation(len(sample))[:number]
    labels = np.argmax(-_distances(sample, sample[start]), axis=1).astype(np.int32)[:, None]
    centres = cv2.kmeans(sample, number, labels, stop, 1, cv2.KMEANS_USE_INITIAL_LABELS)[2]
    return np.asarray(centres, dtype=np.float32)


def vectors(read: Reader, count: int, vocabulary: Words) -> Annotated[NDArray[np.float32], "V X"]:
    """A unit vector an image; 0 for an image without descriptors."""
    result = np.zeros((count, vocabulary.size), np.float32)
    for image in range(count):
        found = read(image)
        some = found[:: -(-len(found) // _MOST) or 1].astype(np.float32)
        if len(some) and len(vocabulary):
            result[image] = _vlad(some, vocabulary)
    return result


def _vlad(found: NDArray[np.float32], vocabulary: NDArray[np.float32]) -> NDArray[np.float32]:
    nearest = np.argmin(_distances(found, vocabulary), axis=1)
    sums = np.zeros_like(vocabulary)
    np.add.at(sums, nearest, found - vocabulary[nearest])
    sums = np.sign(sums) * np.sqrt(np.abs(sums))
    sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-12)
    flat: NDArray[np.float32] = sums.reshape(-1)
    return flat / max(float(np.linalg.norm(flat)), 1e-12)


def _distances(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.float32]:
    """Squared distances less a constant of each row."""
    distances: NDArray[np.float32] = (b * b).sum(1)[None] - 2 * (a @ b.T)
    return distances
