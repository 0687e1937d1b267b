"""Gaussians that show the sky, wherever training has put them.

Between the twigs of a bare crown a training puts the sky at the depth of the twigs, and nothing in a file tells it
from them. In a view it has the colours of the sure sky nearby: Gaussians far out and above the horizon. So pixels
above the horizon are compared with the mean of the sure sky in the smallest window that holds enough of it, and what
they say is carried back to the Gaussians by their weights. Walls are darker than an overcast sky, and have another
hue than a blue one.

Shapes: views of H W pixels.
"""

from typing import Annotated

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..io.images import srgb_to_linear
from ..ops.rasterise.rendering import Pinhole
from .sky import LUMA

_SURE_SHARE = 0.7
"""Of sure Gaussians in a pixel of the sure sky."""
_MIN_VIEW_SHARE = 0.01
"""Of a view: where less of it shows the sure sky, nothing is compared."""
_MIN_TRUNK_LUMA = 0.5
"""Luma of the sure sky over its median: what is darker are trees on it."""
_SKY_RADII = (4, 8, 16, 32, 64, 128, 256)
"""Of the windows, in pixels of a view 320 wide."""
_ENOUGH_SKY_PIXELS = 20.0
"""Of the sure sky in a window."""
_LUMA_RANGE = (0.6, 0.8)
"""Luma over that of the sure sky, from where nothing to where all of a pixel is taken as sky: white walls under an
overcast sky have 0.4 to 0.6 (by eye).
"""
_CHROMA_RANGE = (0.10, 0.16)
"""Sum of the differences of the shares of red, green and blue, from where all to where nothing is (by eye)."""
MIN_SKY_HEIGHT = 0.02
"""Sine of the height above the horizon of what may be the sky (by eye)."""
_GROWTHS = 4
"""Times that the sky is followed from what is sure of it."""
_GROWN_LIKENESS = 0.95
"""Likeness of what is taken as sure then (by eye)."""
_BLUE_RATIO = 1.5
"""Blue over red of a clear sky, at least (by eye)."""
_LUMA_PARTS = np.array(LUMA, np.float32)


def sky_pixels(
    image: Annotated[Tensor, "H W 3"],
    sure: Annotated[Tensor, "H W"],
    camera: Pinhole,
    up: Annotated[Tensor, "3"],
) -> tuple[Annotated[Tensor, "H W"], Annotated[Tensor, "H W"]]:
    """Likeness of the pixels of a view to the sky, in [0, 1], and the same where a blue sky is followed over the view:
    it grows darker and bluer with its height. Of a grey one walls would be taken, too.

    `image` is sRGB in [0, 1]; `sure` the share of each pixel that Gaussians show which lie where only the sky is.
    """
    colour = srgb_to_linear(image).cpu().numpy()
    known = (sure > _SURE_SHARE).cpu().numpy()
    above = (heights(camera, up) > MIN_SKY_HEIGHT).cpu().numpy()
    like = _likeness(colour, known)
    followed = like
    if known.any() and _is_blue(colour[known].mean(0)):
        for _ in range(_GROWTHS):
            known = known | (above & (followed > _GROWN_LIKENESS))
            followed = _likeness(colour, known)
    return torch.from_numpy(like * above).to(image), torch.from_numpy(followed * above).to(image)


def _is_blue(colour: NDArray[np.float32]) -> bool:
    return bool(colour[2] > _BLUE_RATIO * colour[0])


def heights(camera: Pinhole, up: Annotated[Tensor, "3"]) -> Annotated[Tensor, "H W"]:
    """Sines of the heights of the pixels' rays above the horizon."""
    k = camera.intrinsics.float()
    y, x = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    ray = torch.stack([(x - k[0, 2]) / k[0, 0], (y - k[1, 2]) / k[1, 1], torch.ones_like(x)], -1)
    there = camera.world_to_camera[:3, :3].float() @ up.float()
    sines: Tensor = torch.nn.functional.normalize(ray, dim=-1) @ there
    return sines


def _likeness(colour: NDArray[np.float32], sure: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Likeness of each pixel of linear light to the sure sky around it [H W], in [0, 1]."""
    none = np.zeros(sure.shape, np.float32)
    if sure.mean() < _MIN_VIEW_SHARE:
        return none
    luma = colour @ _LUMA_PARTS
    sure = sure & (luma > _MIN_TRUNK_LUMA * np.median(luma[sure]))
    expected = np.zeros_like(colour)
    left = np.ones(sure.shape, np.bool_)
    for radius in _SKY_RADII:
        reach = max(1, round(radius * sure.shape[1] / 320))
        size = (2 * reach + 1, 2 * reach + 1)
        amount = cv2.blur(sure.astype(np.float32), size, borderType=cv2.BORDER_CONSTANT)
        mean = cv2.blur(np.where(sure[..., None], colour, 0), size, borderType=cv2.BORDER_CONSTANT)
        told = left & (amount * size[0] * size[1] > _ENOUGH_SKY_PIXELS)
        expected[told] = mean[told] / amount[told][:, None]
        left &= ~told
    ratio = luma / np.maximum(expected @ _LUMA_PARTS, 1e-3)
    chroma = np.abs(_chromaticity(colour) - _chromaticity(expected)).sum(-1)
    bright = np.clip((ratio - _LUMA_RANGE[0]) / (_LUMA_RANGE[1] - _LUMA_RANGE[0]), 0, 1)
    same = np.clip((_CHROMA_RANGE[1] - chroma) / (_CHROMA_RANGE[1] - _CHROMA_RANGE[0]), 0, 1)
    return np.where(left, none, (bright * same).astype(np.float32))


def _chromaticity(colour: NDArray[np.float32]) -> NDArray[np.float32]:
    """Red, green and blue over their sum."""
    shares: NDArray[np.float32] = colour / np.maximum(colour.sum(-1, keepdims=True), 1e-3)
    return shares
