"""What a cell of Gaussians sees: its windows of photographs, and the Gaussians of the whole scene that they show.

A cell starts from Gaussians of the whole scene: those that its windows show explain what lies outside, and are dropped in the
end. See `blocks.partition` for how cells are cut.
"""

import math
from dataclasses import replace
from typing import Annotated, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..datamanagers.scene import Scene
from ..ops.rasterise import lift
from ..types import Cell
from .gaussians import Gaussians
from .initial import spatial_order
from .levels import in_view
from .photographs import cover

Number = TypeVar("Number", bound=np.generic)
_DEVIATIONS = 3.0
"""A Gaussian is shown as far as so many standard deviations from its mean."""
_RUN, _LOOKED, _COARSER, _WEIGHT = 256, 40, 4, 0.003
"""Gaussians that are looked for together; windows that are drawn to see what they show, at most, evenly over all; the part of
their size at which they are; the least that the weights of a Gaussian in all pixels of one sum to."""


def scene_in_windows(scene: Scene, cell: Cell) -> Scene:
    """The scene that a cell sees: its windows are the training views."""
    views = torch.tensor(list(cell.windows), dtype=torch.int64)
    window = torch.tensor(list(cell.windows.values()), dtype=torch.int64)
    centre, size = scene.cameras.centre.clone(), scene.cameras.size.clone()
    centre[views] -= window[:, :2]
    size[views] = window[:, 2:]
    return replace(scene, cameras=replace(scene.cameras, centre=centre, size=size), train=views)


def crop(cell: Cell, images: dict[int, NDArray[Number]]) -> dict[int, NDArray[Number]]:
    """A cell's windows of images [H W ...] by view."""
    cropped = {}
    for view, image in images.items():
        left, top, width, height = cell.windows[view]
        cropped[view] = image[top : top + height, left : left + width]
    return cropped


def shown_in_windows(scene: Scene, cell: Cell, gaussians: Gaussians, near: float) -> Annotated[Tensor, "N"]:
    """True for Gaussians that a window shows, and for all in the cell and its border.

    What others hide, and what covers next to nothing, is not shown, so their number does not grow with the scene.
    """
    cameras = scene_in_windows(scene, cell).cameras
    visible = cell.around(gaussians.means)
    # Runs [B R] of Gaussians near to each other, the last one repeated, with balls around what they show: most windows
    # show few of them.
    order = torch.from_numpy(spatial_order(gaussians.means.double().numpy()))
    order = torch.nn.functional.pad(order[None], (0, -len(order) % _RUN), mode="replicate").view(-1, _RUN)
    means, quaternions, log_scales = (x[order] for x in (gaussians.means, gaussians.quaternions, gaussians.log_scales))
    centre = (means.double().amin(1) + means.double().amax(1)) / 2
    reach = _DEVIATIONS * log_scales.amax(2).double().exp()
    radius = ((means.double() - centre[:, None]).norm(dim=2) + reach).amax(1)
    logits = gaussians.logits[order]
    logits.view(-1)[len(gaussians) :] = -math.inf  # the repeated ones
    # Draw the runs in view of each window, coarsely, and keep what weighs anything there.
    shown = torch.zeros(order.shape, dtype=torch.bool)
    views = list(cell.windows)
    for view in views[:: -(-len(views) // _LOOKED)]:
        camera = cover(cameras.select(torch.tensor([view])).scaled(_COARSER), 0, near)[0]
        runs = torch.from_numpy(in_view(camera, centre.numpy(), radius.numpy())[1]).nonzero()[:, 0]
        mean, quaternion, log_scale = (x[runs].flatten(0, 1) for x in (means, quaternions, log_scales))
        ones = torch.ones(camera.height, camera.width, 1)
        weights = lift(mean, quaternion, log_scale, logits[runs].flatten(), camera, ones, antialiased=True)
        shown[runs] |= weights.view(-1, _RUN) > _WEIGHT
    visible[order[shown]] = True
    return visible
