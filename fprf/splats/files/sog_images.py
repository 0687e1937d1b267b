"""Numbers as the lossless images of a SOG capture: rows of pixels, codebooks, and the palette of harmonics."""

from collections.abc import Mapping
from typing import Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from . import base
from .base import Floats

ByteImage: TypeAlias = NDArray[np.uint8]

CODEBOOK_NUMBERS = 256
"""Numbers of a codebook: what a byte tells apart."""
ENTRIES_PER_ROW = 64
"""Entries of the palette a row."""
MAX_PALETTE_ENTRIES = 1 << 16
"""Entries of a palette at most: what a label of 16 bits tells apart."""
_CODEBOOK_STEPS = 12
"""Steps of Lloyd's algorithm: further ones change no byte that is seen (by eye)."""


def lossless_webp(picture: ByteImage) -> bytes:
    """Lossless, colours of transparent pixels among it where OpenCV can."""
    options = [cv2.IMWRITE_WEBP_QUALITY, 101]
    mode = getattr(cv2, "IMWRITE_WEBP_LOSSLESS_MODE", None)
    if mode is not None:
        options = [mode, cv2.IMWRITE_WEBP_LOSSLESS_PRESERVE_COLOR]
    done, data = cv2.imencode(".webp", cv2.cvtColor(picture, cv2.COLOR_RGBA2BGRA), options)
    assert done
    return bytes(data.tobytes())


def picture_of_rows(rows: NDArray[np.integer[Any]], shape: tuple[int, int]) -> ByteImage:
    """Rows [N C] as RGBA pixels, opaque where C = 3."""
    pixels = np.full((shape[0] * shape[1], 4), 255, np.uint8)
    pixels[: len(rows), : rows.shape[1]] = rows
    return pixels.reshape(*shape, 4)


def palette_picture(index: NDArray[np.integer[Any]]) -> ByteImage:
    """Entries [E K-1 3] in rows of 64."""
    entries, coefficients, _ = index.shape
    return picture_of_rows(
        index.reshape(-1, 3), (-(-entries // ENTRIES_PER_ROW), ENTRIES_PER_ROW * coefficients)
    )


def quantized(values: Floats, about: Mapping[str, Any]) -> tuple[NDArray[np.int64], dict[str, Any]]:
    """Values [... 3] as bytes, and what meta.json says of them: a new codebook, or new ranges (version 1)."""
    said = dict(about)
    values = base.finite(values)
    if "codebook" in said:
        book = _codebook(values.ravel())
        said["codebook"] = book.tolist()
        return np.searchsorted((book[1:] + book[:-1]) / 2, values), said
    whole = isinstance(said["mins"], (int, float))
    if whole:
        axes = tuple(range(values.ndim))
    else:
        axes = tuple(range(values.ndim - 1))
    low = values.min(axes)
    high = values.max(axes)
    index = base.steps(base.shares(values, low, high), 255)
    if whole:
        return index, said | {"mins": float(low), "maxs": float(high)}
    return index, said | {
        "mins": [*low.tolist(), *said["mins"][3:]],
        "maxs": [*high.tolist(), *said["maxs"][3:]],
    }


def _codebook(values: Floats) -> Floats:
    """256 increasing numbers near to all values (Lloyd's algorithm on a line), float32 in float64."""
    # Sums of sorted values give the mean of any stretch of them at once.
    ordered = np.sort(values)
    total = np.concatenate([[0.0], np.cumsum(ordered)])
    ranks = np.rint(np.linspace(0, len(ordered) - 1, CODEBOOK_NUMBERS)).astype(np.int64)
    # Half by rank and half by distance: rare far values are not left out. Gaps cost no more than one number.
    widest = float(np.ptp(np.percentile(ordered, (10, 90)))) / CODEBOOK_NUMBERS
    along = np.concatenate([[0.0], np.cumsum(np.minimum(np.diff(ordered), widest or np.inf))])
    book = (ordered[ranks] + np.interp(np.linspace(0, along[-1], CODEBOOK_NUMBERS), along, ordered)) / 2
    for _ in range(_CODEBOOK_STEPS):
        edges = np.concatenate([[0], np.searchsorted(ordered, (book[1:] + book[:-1]) / 2), [len(ordered)]])
        inside = np.diff(edges)
        book = np.where(inside > 0, np.diff(total[edges]) / np.maximum(inside, 1), book)
    return np.maximum.accumulate(book.astype(np.float32)).astype(np.float64)


def palette_labels(rows: Floats) -> NDArray[np.int64]:
    """At most 65536 groups of like rows [N C]: each its own where there are no more, else halves of halves.

    A group is cut at the median of the column that varies most in it.
    """
    if len(rows) <= MAX_PALETTE_ENTRIES:
        return np.arange(len(rows))
    labels = np.zeros(len(rows), np.int64)
    for level in range(16):
        groups = 1 << level
        # The variance of each column within each group.
        spread = label_means(rows**2, labels, groups) - label_means(rows, labels, groups) ** 2
        order = np.lexsort((rows[np.arange(len(rows)), spread.argmax(1)[labels]], labels))
        starts = np.searchsorted(labels[order], np.arange(groups))
        sizes = np.diff([*starts, len(rows)])
        rank = np.arange(len(rows)) - starts[labels[order]]
        labels[order] = 2 * labels[order] + (2 * rank >= sizes[labels[order]])
    return np.unique(labels, return_inverse=True)[1]


def label_means(rows: Floats, labels: NDArray[np.int64], count: int) -> Floats:
    """Mean row of each label; 0 where there is none."""
    inside = np.maximum(np.bincount(labels, minlength=count), 1)
    parts = []
    for column in rows.T:
        parts.append(np.bincount(labels, column, count))
    return np.stack(parts, 1) / inside[:, None]
