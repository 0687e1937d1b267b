"""Which images are matched with each other. Pairs are of numbers, the smaller one first, sorted, each once."""

from collections.abc import Sequence
from typing import Annotated, TypeAlias

import numpy as np
from numpy.typing import NDArray

__all__ = ["Pair", "exhaustive", "merged", "sequential", "similar"]

Pair: TypeAlias = tuple[int, int]


def exhaustive(count: int) -> list[Pair]:
    """All with all: count (count - 1) / 2."""
    return [(a, b) for a in range(count) for b in range(a + 1, count)]


def sequential(count: int, overlap: int) -> list[Pair]:
    """Each with the next `overlap` ones, and with those at distances 2, 4, 8, ... up to 2 ** overlap."""
    steps = sorted({*range(1, overlap + 1), *(2**k for k in range(overlap + 1))})
    return [(a, a + step) for a in range(count) for step in steps if a + step < count]


def similar(vectors: Annotated[NDArray[np.float32], "V X"], nearest: int) -> list[Pair]:
    """Each with those whose unit vectors are most like its own, by cosine; an image without a vector (all 0) with none."""
    likeness = vectors @ vectors.T
    empty = ~vectors.any(axis=1)
    likeness[empty] = likeness[:, empty] = -np.inf
    np.fill_diagonal(likeness, -np.inf)
    count = min(nearest, max(0, len(vectors) - 1))
    best = np.argsort(-likeness, axis=1, kind="stable")[:, :count]
    found = {(min(a, b), max(a, b)) for a, row in enumerate(best.tolist()) for b in row if np.isfinite(likeness[a, b])}
    return sorted(found)


def merged(*parts: Sequence[Pair]) -> list[Pair]:
    """Pairs of any of the parts."""
    return sorted({pair for part in parts for pair in part})
