"""Cells of Gaussians: the parts of a layout in the world, each with the windows of photographs that it learns from.

A cell learns from the windows that show its points and a border around it, so its cost follows from its windows
alone (compare VastGaussian, Lin et al. 2024). What no cell holds stays as the whole scene has it.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated

import numpy as np
import torch
from torch import Tensor

from ..datamanagers.scene import ParsedScene, Sightings, find_sightings
from ..errors import ConfigError
from ..rendering.space import Space
from ..types import Cell, Window
from .config import LayoutConfig
from .layouts import MIN_SIGHTINGS, extent
from .partition import open_space, site_of

BORDER_SHARE = 0.05
"""Border of a cell as a share of the width of what is seen in it; by eye."""
MIN_OWN_SHARE = 0.15
"""Share of the points in a window that are the cell's own, at least; by eye."""
MIN_WINDOW_PIXELS = 64
"""Least width and height of a window; by eye."""
WINDOW_MARGIN_PIXELS = 6
"""Pixels around the points in a window, at least; by eye."""


def cut_into_windows(scene: ParsedScene, layout: LayoutConfig) -> list[Cell]:
    """The cells of a layout that views show enough of; one alone means that the scene is not cut.

    Raises ConfigError where the points do not allow that.
    """
    sightings = find_sightings(scene)
    if sightings is None:
        raise ConfigError(
            f"cells: {scene.name} has too few points of a reconstruction for cells; train it in one piece"
        )
    space = open_space(scene, sightings, principal=layout.principal)
    if layout.principal:
        space = _exact(space)
    try:
        boxes = layout.build().cut(site_of(scene, space, sightings))
    except ConfigError as fault:
        raise ConfigError(f"cells: {scene.name} {fault}") from fault
    if len(boxes) == 1:
        return boxes
    cells = []
    for box in boxes:
        cell = _with_windows(_in_world(box, space), scene, sightings)
        if cell.windows:
            cells.append(cell)
    if not cells:
        raise ConfigError(
            f"cells: no view shows {MIN_SIGHTINGS} points of any of {len(boxes)} cells; take fewer"
        )
    return _widened(cells, scene)


def _exact(space: Space) -> Space:
    """The space about the world's own origin and in units of a power of two: what is cut there is the same to the
    bit in the world.
    """
    return replace(space, centre=(0.0, 0.0, 0.0), scale=2.0 ** round(math.log2(space.scale)))


def _in_world(box: Cell, space: Space) -> Cell:
    """A box of a space along the same axes, in world units and about the world's origin."""
    frame = torch.tensor(space.rotation, dtype=torch.float64)
    origin = frame @ torch.tensor(space.centre, dtype=torch.float64)
    return replace(
        box,
        low=box.low / space.scale + origin,
        high=box.high / space.scale + origin,
        border=box.border / space.scale,
        frame=frame,
    )


def _with_windows(cell: Cell, scene: ParsedScene, sightings: Sightings) -> Cell:
    """The cell with its own border, and the windows that show enough of it; without any where too little is
    seen.
    """
    # Sightings [O] come view by view; `ends` says where each view begins. `local` are their points along the
    # axes of the cells.
    ends = torch.searchsorted(sightings.view, torch.arange(len(scene.cameras) + 1))
    local = sightings.point @ cell.frame.T
    inside = ((local >= cell.low) & (local < cell.high)).all(1)
    if int(inside.sum()) < MIN_SIGHTINGS:
        return replace(cell, windows={})
    # The cell learns what lies within a border around it as well, so that nothing is missing at its faces.
    first, last = extent(local[inside])
    border = BORDER_SHARE * (last - first)
    near = ((local >= cell.low - border) & (local < cell.high + border)).all(1)
    # A view's window is around the points in the cell and its border, where enough of what it shows is the
    # cell's own.
    windows: dict[int, Window] = {}
    for view in torch.unique(sightings.view[near]).tolist():
        of_view = slice(int(ends[view]), int(ends[view + 1]))
        pixel = sightings.pixel[of_view][near[of_view]]
        if len(pixel) < MIN_SIGHTINGS:
            continue
        width, height = scene.cameras.size[view].tolist()
        first, last = extent(pixel)
        left, wide = _interval(float(first[0]), float(last[0]), width)
        top, tall = _interval(float(first[1]), float(last[1]), height)
        x, y = sightings.pixel[of_view].unbind(1)
        shown = (x >= left) & (x < left + wide) & (y >= top) & (y < top + tall)
        if int((inside[of_view] & shown).sum()) >= MIN_OWN_SHARE * int(shown.sum()):
            windows[view] = (left, top, wide, tall)
    return replace(cell, border=border, windows=windows)


def _widened(cells: Sequence[Cell], scene: ParsedScene) -> list[Cell]:
    """The cells with the outermost windows of each photograph up to its edges: few points lie there, but it
    shows.
    """
    widened: list[dict[int, Window]] = []
    for _ in cells:
        widened.append({})
    for view in sorted(set().union(*(cell.windows for cell in cells))):
        own = []
        for k, cell in enumerate(cells):
            if view in cell.windows:
                own.append(k)
        parts = []
        for k in own:
            parts.append(cells[k].windows[view])
        window = np.array(parts)
        lows = window[:, :2]
        highs = window[:, :2] + window[:, 2:]
        lows = np.where(lows == lows.min(0), 0, lows)
        highs = np.where(highs == highs.max(0), scene.cameras.size[view].numpy(), highs)
        for k, (left, top), (wide, tall) in zip(own, lows.tolist(), (highs - lows).tolist(), strict=True):
            widened[k][view] = (left, top, wide, tall)
    found: list[Cell] = []
    for cell, windows in zip(cells, widened, strict=True):
        found.append(replace(cell, windows=windows))
    return found


def _interval(first: float, last: float, size: int) -> tuple[int, int]:
    """Start and length of a part of [0, size) around [first, last], at least MIN_WINDOW_PIXELS long where there
    is room.
    """
    start = max(0, math.floor(first) - WINDOW_MARGIN_PIXELS)
    length = min(max(math.ceil(last) + WINDOW_MARGIN_PIXELS - start, MIN_WINDOW_PIXELS), size)
    return min(start, size - length), length


def held_apart(
    cells: Sequence[Cell], number: int, points: Annotated[Tensor, "N 3"]
) -> Annotated[Tensor, "N"]:
    """True for points that a cell holds and none before it: where cells overlap, each point is held once."""
    held = cells[number].holds(points)
    for earlier in cells[:number]:
        held &= ~earlier.holds(points)
    return held
