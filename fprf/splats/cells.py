"""Large scenes in cells: boxes that are trained apart and whose union is the scene.

The space is bisected along the principal axes of the reconstruction's points, so that the points of each cell were seen about
equally often; cells at the outside are unbounded. A cell learns from the windows of photographs that show its points and a
border around it. It starts from Gaussians of the whole scene: those that its windows show explain what lies outside, and are
dropped in the end. A cell's cost follows from its windows alone, and it can be trained on any machine, in any order (compare
VastGaussian, Lin et al. 2024).
"""

import math
from dataclasses import dataclass, replace
from typing import Annotated, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..datamanagers.scene import Scene, find_sightings
from ..errors import ConfigError
from ..ops.rasterise import lift
from .gaussians import Gaussians
from .initial import spatial_order
from .levels import in_view
from .photographs import cover

Number = TypeVar("Number", bound=np.generic)
Window = tuple[int, int, int, int]
"""Left, top, width, height in pixels."""
_BORDER = 0.05
"""Of the cell's width to each side, from which it learns as well."""
_SEEN = 8
"""Points of a cell that a view shows, at least, where the cell learns from it."""
_OWN = 0.15
"""Share of the points in a window that are the cell's own, at least."""
_LEAST, _ROOM = 64, 6
"""Least width and height of a window; pixels around the points in it."""
_OUTLIERS = 0.01
_DEVIATIONS = 3.0
"""A Gaussian is shown as far as so many standard deviations from its mean."""
_RUN, _LOOKED, _COARSER, _WEIGHT = 256, 40, 4, 0.003
"""Gaussians that are looked for together; windows that are drawn to see what they show, at most, evenly over all; the part of
their size at which they are; the least that the weights of a Gaussian in all pixels of one sum to."""


@dataclass(frozen=True, kw_only=True)
class Cell:
    """A box of space, half open, in the frame of the cut, and what it is learnt from."""

    frame: Annotated[Tensor, "3 3"]
    """Rows are axes, float64: coordinates are `frame @ point`."""
    low: Annotated[Tensor, "3"]
    high: Annotated[Tensor, "3"]
    border: Annotated[Tensor, "3"]
    """Width of what it learns around it."""
    windows: dict[int, Window]
    """Photographs that it learns from, by view."""

    def holds(self, points: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N"]:
        """True for points inside."""
        local = points.double() @ self.frame.T
        return ((local >= self.low) & (local < self.high)).all(1)

    def around(self, points: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N"]:
        """True for points inside and in the border."""
        local = points.double() @ self.frame.T
        return ((local >= self.low - self.border) & (local < self.high + self.border)).all(1)

    def scene(self, scene: Scene) -> Scene:
        """The scene that the cell sees: its windows are the training views."""
        views = torch.tensor(list(self.windows), dtype=torch.int64)
        window = torch.tensor(list(self.windows.values()), dtype=torch.int64)
        centre, size = scene.cameras.centre.clone(), scene.cameras.size.clone()
        centre[views] -= window[:, :2]
        size[views] = window[:, 2:]
        cameras = replace(scene.cameras, centre=centre, size=size)
        return replace(scene, cameras=cameras, train=views)

    def shown(self, scene: Scene, gaussians: Gaussians, near: float) -> Annotated[Tensor, "N"]:
        """True for Gaussians that a window shows, and for all in the cell and its border.

        What others hide, and what covers next to nothing, is not shown, so their number does not grow with the scene.
        """
        cameras = self.scene(scene).cameras
        visible = self.around(gaussians.means)
        order, centre, radius = _runs(gaussians)
        means, quaternions, log_scales = (x[order] for x in (gaussians.means, gaussians.quaternions, gaussians.log_scales))
        logits = gaussians.logits[order]
        logits.view(-1)[len(gaussians) :] = -math.inf  # the last one, repeated
        shown = torch.zeros(order.shape, dtype=torch.bool)
        views = list(self.windows)
        for view in views[:: -(-len(views) // _LOOKED)]:
            camera = cover(cameras.select(torch.tensor([view])).scaled(_COARSER), 0, near)[0]
            runs = torch.from_numpy(in_view(camera, centre, radius)[1]).nonzero()[:, 0]
            mean, quaternion, log_scale = (x[runs].flatten(0, 1) for x in (means, quaternions, log_scales))
            ones = torch.ones(camera.height, camera.width, 1)
            weights = lift(mean, quaternion, log_scale, logits[runs].flatten(), camera, ones, antialiased=True)
            shown[runs] |= weights.view(-1, _RUN) > _WEIGHT
        visible[order[shown]] = True
        return visible

    def cut(self, view: int, image: NDArray[Number]) -> NDArray[Number]:
        """The window of an image [H W ...] of a view."""
        left, top, width, height = self.windows[view]
        return image[top : top + height, left : left + width]


def _runs(
    gaussians: Gaussians,
) -> tuple[Annotated[Tensor, "B R"], Annotated[NDArray[np.float64], "B 3"], Annotated[NDArray[np.float64], "B"]]:
    """Indices of Gaussians near to each other, the last ones repeated, with balls around what they show."""
    order = torch.from_numpy(spatial_order(gaussians.means.double().numpy()))
    order = torch.nn.functional.pad(order[None], (0, -len(order) % _RUN), mode="replicate").view(-1, _RUN)
    means = gaussians.means.double()[order]
    centre = (means.amin(1) + means.amax(1)) / 2
    reach = _DEVIATIONS * gaussians.log_scales.amax(1).double().exp()
    radius = ((means - centre[:, None]).norm(dim=2) + reach[order]).amax(1)
    return order, centre.numpy(), radius.numpy()


def cut(scene: Scene, count: int) -> list[Cell]:
    """`count` cells, each with about as many sightings of points. Raises ConfigError where the points do not allow that."""
    sightings = find_sightings(scene)
    if sightings is None or len(sightings.view) < _SEEN * count:
        raise ConfigError(
            f"cells: {scene.name} has too few points of a reconstruction for {count} cells; train it in one piece"
        )
    ends = torch.searchsorted(sightings.view, torch.arange(len(scene.cameras) + 1))
    centred = sightings.point - sightings.point.mean(0)
    frame = torch.linalg.eigh(centred.T @ centred).eigenvectors.T.flip(0).contiguous()
    local = sightings.point @ frame.T
    cells = []
    for low, high in _bisected(local, torch.full((3,), -math.inf).double(), torch.full((3,), math.inf).double(), count):
        inside = ((local >= low) & (local < high)).all(1)
        own = local[inside]
        first, last = _extent(own)
        border = _BORDER * (last - first)
        near = ((local >= low - border) & (local < high + border)).all(1)
        windows: dict[int, Window] = {}
        for view in torch.unique(sightings.view[near]).tolist():
            of_view = slice(int(ends[view]), int(ends[view + 1]))
            pixel = sightings.pixel[of_view][near[of_view]]
            if len(pixel) < _SEEN:
                continue
            width, height = scene.cameras.size[view].tolist()
            first, last = _extent(pixel)
            left, wide = _interval(float(first[0]), float(last[0]), width)
            top, tall = _interval(float(first[1]), float(last[1]), height)
            x, y = sightings.pixel[of_view].unbind(1)
            shown = (x >= left) & (x < left + wide) & (y >= top) & (y < top + tall)
            if int((inside[of_view] & shown).sum()) >= _OWN * int(shown.sum()):
                windows[view] = (left, top, wide, tall)
        if not windows:
            raise ConfigError(f"cells: no view shows {_SEEN} points of one of {count} cells; take fewer")
        cells.append(Cell(frame=frame, low=low, high=high, border=border, windows=windows))
    return _widened(cells, scene)


def _widened(cells: list[Cell], scene: Scene) -> list[Cell]:
    """The same cells with the outermost windows of each photograph reaching its edges: few points lie there, but it shows."""
    widened: list[dict[int, Window]] = [{} for _ in cells]
    for view in sorted({view for cell in cells for view in cell.windows}):
        own = [k for k, cell in enumerate(cells) if view in cell.windows]
        window = np.array([cells[k].windows[view] for k in own])
        first, last = window[:, :2], window[:, :2] + window[:, 2:]
        first = np.where(first == first.min(0), 0, first)
        last = np.where(last == last.max(0), scene.cameras.size[view].numpy(), last)
        for k, (left, top), (width, height) in zip(own, first.tolist(), (last - first).tolist(), strict=True):
            widened[k][view] = (left, top, width, height)
    return [replace(cell, windows=windows) for cell, windows in zip(cells, widened, strict=True)]


def _bisected(
    local: Annotated[Tensor, "O 3"], low: Annotated[Tensor, "3"], high: Annotated[Tensor, "3"], count: int
) -> list[tuple[Tensor, Tensor]]:
    """Boxes with equal numbers of rows in each, cut across the longest side of what is in them."""
    if count == 1:
        return [(low, high)]
    inside = local[((local >= low) & (local < high)).all(1)]
    first, last = _extent(inside)
    axis = int((last - first).argmax())
    at = float(np.quantile(inside[:, axis].numpy(), (count // 2) / count))
    middle_high, middle_low = high.clone(), low.clone()
    middle_high[axis] = middle_low[axis] = at
    return _bisected(local, low, middle_high, count // 2) + _bisected(local, middle_low, high, count - count // 2)


def _extent(values: Annotated[Tensor, "N K"]) -> tuple[Annotated[Tensor, "K"], Annotated[Tensor, "K"]]:
    """Quantiles between which nearly all rows lie."""
    low, high = np.quantile(values.numpy(), (_OUTLIERS, 1 - _OUTLIERS), axis=0)
    return torch.from_numpy(low), torch.from_numpy(high)


def _interval(first: float, last: float, size: int) -> tuple[int, int]:
    """Start and length of a part of [0, size) around [first, last], at least `_LEAST` long where there is room."""
    start = max(0, math.floor(first) - _ROOM)
    length = min(max(math.ceil(last) + _ROOM - start, _LEAST), size)
    return min(start, size - length), length
