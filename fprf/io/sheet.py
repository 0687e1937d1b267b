"""Several pictures as one: thumbnails of a scene's regions with what they take from references, or a view in several styles."""

import math
from collections.abc import Sequence
from typing import Annotated, NamedTuple

import cv2
import numpy as np
from torch import Tensor

from ..errors import DataError
from .images import Picture, checked, resized
from .maps import palette

_SIDE = 240
"""Width of a tile in pixels; pictures are enlarged or reduced to it."""
_LINE, _GAP, _BAR = 17, 8, 6
_INK, _PAPER, _FAINT = (30, 32, 36), (250, 250, 248), (215, 216, 218)
_OUTLINE = (255, 214, 10)
_COLUMNS = 4


class Tile(NamedTuple):
    """A picture with lines of text below."""

    picture: Picture
    lines: tuple[str, ...]
    shares: tuple[float, ...] = ()
    """Of each reference, drawn as a bar in their colours; what is missing to 1 stays pale."""


def highlight(picture: Picture, inside: Annotated[Tensor, "H W"]) -> Picture:
    """A picture in which one part keeps its colours, with an outline, and the rest is dim and grey.

    `inside` lies in [0, 1], at any size.
    """
    height, width = checked(picture).shape[:2]
    share = np.clip(cv2.resize(inside.detach().cpu().float().numpy(), (width, height), interpolation=cv2.INTER_LINEAR), 0, 1)
    # Outside half as bright and without colour, mixed by the share; then the edge of what is more than half inside.
    grey = cv2.cvtColor(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2RGB).astype(np.float32)
    dim = 0.35 * grey + 40
    mixed = np.asarray(dim + (picture - dim) * share[..., None]).clip(0, 255).astype(np.uint8)
    edges, _ = cv2.findContours((share > 0.5).astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    return np.asarray(cv2.drawContours(mixed, edges, -1, _OUTLINE, 1), dtype=np.uint8)


def contact_sheet(tiles: Sequence[Tile]) -> Picture:
    """The tiles in rows of four, in their order. Letters beyond ASCII are shown as '?'."""
    if not tiles:
        return np.full((_GAP, _GAP, 3), _PAPER, dtype=np.uint8)
    drawn = [_tile(tile) for tile in tiles]
    columns = min(_COLUMNS, len(drawn))
    height = max(len(each) for each in drawn)
    rows = math.ceil(len(drawn) / columns)
    page = np.full((rows * (height + _GAP) + _GAP, columns * (_SIDE + _GAP) + _GAP, 3), _PAPER, np.uint8)
    for i, each in enumerate(drawn):
        top, left = _GAP + (i // columns) * (height + _GAP), _GAP + (i % columns) * (_SIDE + _GAP)
        page[top : top + len(each), left : left + _SIDE] = each
    return page


def _tile(tile: Tile) -> Picture:
    height, width = checked(tile.picture).shape[:2]
    picture = resized(tile.picture, _SIDE, max(1, round(height * _SIDE / width)))
    below = np.full((_BAR + _LINE * len(tile.lines) + _GAP, _SIDE, 3), _PAPER, dtype=np.uint8)
    # A bar of the references' shares, one after the other; what is missing to 1 stays pale.
    if tile.shares:
        below[:_BAR] = _FAINT
        edge = 0.0
        colours = (palette(len(tile.shares)) * 255).round().int().tolist()
        for share, colour in zip(tile.shares, colours, strict=True):
            below[:_BAR, round(edge * _SIDE) : round((edge + share) * _SIDE)] = colour
            edge += share
    # As much of each line as the tile is wide.
    for i, line in enumerate(tile.lines):
        text, scale, font = line.encode("ascii", "replace").decode(), 0.42, cv2.FONT_HERSHEY_SIMPLEX
        while text and cv2.getTextSize(text, font, scale, 1)[0][0] > _SIDE - 2:
            text = text[:-1]
        cv2.putText(below, text, (1, _BAR + _LINE * i + 14), font, scale, _INK, 1, cv2.LINE_AA)
    return np.concatenate([picture, below])


_SEAM = 2
"""Pixels of the line between pictures."""


def side_by_side(pictures: Sequence[Picture]) -> Picture:
    """The pictures from left to right, with a thin line between them. Raises DataError where their heights differ."""
    if len({checked(picture).shape[0] for picture in pictures}) != 1:
        raise DataError(f"pictures of heights {[picture.shape[0] for picture in pictures]} cannot lie beside each other")
    line = np.full((pictures[0].shape[0], _SEAM, 3), 255, np.uint8)
    parts = [part for picture in pictures for part in (line, picture)][1:]
    return np.concatenate(parts, axis=1)
