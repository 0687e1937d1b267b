"""Contact sheets: pictures in rows and columns, a name above each column and before each row."""

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from torch import Tensor

from ..io.images import Picture, to_uint8

__all__ = ["contact_sheet"]

_BAR, _MARGIN, _GAP = 18, 62, 3
"""Pixels above the columns, before the rows, and between pictures."""
_INK, _PAPER = (40, 40, 40), 255


def contact_sheet(rows: Mapping[str, Sequence[Tensor]], columns: Sequence[str], *, height: int) -> Picture:
    """Pictures [H W 3] in [0, 1] by row, each as tall as `height` pixels; a row may be shorter than there are columns.

    Columns are as wide as their widest picture.
    """
    drawn = {name: [_scaled(to_uint8(image), height) for image in row] for name, row in rows.items()}
    widths = [max((row[i].shape[1] for row in drawn.values() if i < len(row)), default=0) for i in range(len(columns))]
    edges = [_MARGIN + sum(widths[:i]) + i * _GAP for i in range(len(columns) + 1)]
    page = np.full((_BAR + len(drawn) * (height + _GAP), edges[-1], 3), _PAPER, dtype=np.uint8)
    for left, name in zip(edges, columns, strict=False):
        _write(page, name, (left + 1, _BAR - 5))
    for k, (name, row) in enumerate(drawn.items()):
        top = _BAR + k * (height + _GAP)
        _write(page, name, (2, top + height // 2))
        for left, picture in zip(edges, row, strict=False):
            page[top : top + height, left : left + picture.shape[1]] = picture
    return page


def _scaled(picture: Picture, height: int) -> Picture:
    width = max(1, round(picture.shape[1] * height / picture.shape[0]))
    smaller = height < picture.shape[0]
    return np.asarray(
        cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA if smaller else cv2.INTER_CUBIC), dtype=np.uint8
    )


def _write(page: Picture, text: str, at: tuple[int, int]) -> None:
    cv2.putText(page, text.encode("ascii", "replace").decode(), at, cv2.FONT_HERSHEY_SIMPLEX, 0.36, _INK, 1, cv2.LINE_AA)
