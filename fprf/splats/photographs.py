"""Photographs as Gaussians are trained on: read, brought to pinholes, and reduced by steps of two.

Images are [H W 3], 8 bits, sRGB; masks [H W].
"""

from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..datamanagers.images import Image, load_images, load_mask
from ..datamanagers.scene import ParsedScene
from ..memory import free_memory
from ..ops.photometric import WINDOW
from ..ops.rasterise.gsplat import target_on, usable
from ..ops.rasterise.rendering import Pinhole
from ..ops.rasterise.training import Floats, Target, target_of
from .blur import blurred_views
from .config import GaussiansConfig
from .pinholes import drawn_as, undistorted

Masks = dict[int, NDArray[np.bool_]]
"""Masks [H W] by view."""
_MAX_TARGET_BYTES = 1 << 31
"""Bytes of photographs in the rasteriser's layout, some ten times as large as 8-bit pixels, that are kept
between steps; by eye.
"""
_MAX_DEVICE_MEMORY_SHARE = 0.3
"""Share of a CUDA device's free memory that they may take there; by eye: the rest is for Gaussians."""
_MIN_HALVED_PIXELS = 120
"""Longer side of photographs that are halved no further; by eye."""
_MIN_LEVELS = 2
"""Levels of any photographs, however small: training begins with reduced ones."""
_MIN_MASK_VALUE = 254
"""A mask of 8 bits without its lens is true above this: where nothing false was mixed in."""
_MIN_MASK_SHARE = 0.999
"""A pixel of a reduced mask is true above this share: where all pixels that it holds are, but for rounding."""


class PhotographLevel(Mapping[int, Target]):
    """Training views at one scale, by view; their sizes may differ."""

    blurred: frozenset[int] = frozenset()
    """Views that are blurred at this scale."""


class _Straightened(NamedTuple):
    """A photograph for the rasteriser's camera, as 8-bit pixels."""

    camera: Pinhole
    image: Image
    valid: NDArray[np.bool_] | None
    """Pixels that count; None = all."""
    sky: NDArray[np.bool_] | None
    """Pixels of sky; None = not known."""


class _TargetCache(OrderedDict[tuple[int, int], Target]):
    """Targets by scale and view, the least recently used first; all scales of a scene share it."""

    def __init__(self, room: int) -> None:
        super().__init__()
        self.room = room
        self.bytes = 0

    def add(self, key: tuple[int, int], target: Target) -> None:
        """Keep a target; where there is no room, those go that were used longest ago."""
        self[key] = target
        self.bytes += _bytes(target)
        while self.bytes > self.room and len(self) > 1:
            self.bytes -= _bytes(self.popitem(last=False)[1])


class _ReducedLevel(PhotographLevel):
    """Views at 1/2^k of their size, brought into the rasteriser's layout when a step asks for them."""

    def __init__(
        self,
        views: Mapping[int, _Straightened],
        k: int,
        kept: _TargetCache,
        blurred: frozenset[int],
        make: Callable[..., Target],
    ) -> None:
        self.views = views
        self.k = k
        self.kept = kept
        self.blurred = blurred
        self.make = make

    def __iter__(self) -> Iterator[int]:
        return iter(self.views)

    def __len__(self) -> int:
        return len(self.views)

    def __getitem__(self, view: int) -> Target:
        # What was used lately is still there.
        key = (self.k, view)
        if key in self.kept:
            self.kept.move_to_end(key)
            return self.kept[key]
        # Each size is reduced from the full one, so that errors do not add up; the camera shrinks with the
        # image.
        camera, image, valid, sky = self.views[view]
        width = max(1, camera.width >> self.k)
        height = max(1, camera.height >> self.k)
        shrink = torch.tensor([[width / camera.width], [height / camera.height], [1.0]], dtype=torch.float64)
        small = camera._replace(intrinsics=camera.intrinsics * shrink, width=width, height=height)
        size = (width, height)
        colours: Floats = np.divide(image, 255, dtype=np.float32)
        if self.k:
            colours = np.asarray(cv2.resize(colours, size, interpolation=cv2.INTER_AREA), np.float32)
        target = self.make(small, colours, _resized(valid, size), _resized(sky, size))
        self.kept.add(key, target)
        return target


def _bytes(target: Target) -> int:
    """Memory of a target's arrays and tensors."""
    total = 0
    for part in (*target, *(target.there or ())):
        if isinstance(part, np.ndarray | Tensor):
            total += part.nbytes
    return total


def load_photographs(
    config: GaussiansConfig, scene: ParsedScene, views: list[int]
) -> tuple[dict[int, Image], Masks, Masks]:
    """Images of views, then the masks that say where they count, and those that say where they show sky, of
    views with one.
    """
    images = dict(zip(views, load_images(scene, config.background, views), strict=True))
    masks: Masks = {}
    skies: Masks = {}
    if config.masks:
        masks = _load_masks(scene.masks, images)
        # Without surroundings nothing could show the sky but what floats before it.
        if config.surroundings:
            skies = _load_masks(scene.sky_masks, images)
    return images, masks, skies


def _load_masks(paths: tuple[Path | None, ...], images: Mapping[int, Image]) -> Masks:
    """Masks of the views with an image, at its size; `paths` of all views, or none."""
    found: Masks = {}
    if not paths:
        return found
    for view, image in images.items():
        path = paths[view]
        if path is not None:
            found[view] = load_mask(path, image.shape[1::-1])
    return found


def make_levels(
    scene: ParsedScene,
    images: Mapping[int, Image],
    masks: Masks,
    near: float,
    skies: Masks | None = None,
    *,
    device: torch.device | None = None,
) -> list[PhotographLevel]:
    """The training views at their own size, at half of it and so on, until the longer side has less than 240
    pixels.

    A view counts where its mask, if it has one, is true; where that in `skies` is true it shows sky. They are
    made for the CPU, or for a CUDA `device` on which gsplat trains.
    """
    views = scene.train.tolist()
    straightened: dict[int, _Straightened] = {}
    for view in views:
        straightened[view] = _straighten(scene, view, images[view], masks, skies or {}, near)
    count = _level_count([each.camera for each in straightened.values()])
    blurred = blurred_views(scene.cameras, {view: images[view] for view in views}, count)
    make: Callable[..., Target] = target_of
    kept = _TargetCache(_MAX_TARGET_BYTES)
    if device is not None and usable(device):
        make = partial(target_on, device)
        kept = _TargetCache(int(_MAX_DEVICE_MEMORY_SHARE * (free_memory(device) or 0)))
    levels: list[PhotographLevel] = []
    for k in range(count):
        levels.append(_ReducedLevel(straightened, k, kept, blurred[k], make))
    return levels


def _straighten(
    scene: ParsedScene, view: int, photograph: Image, masks: Masks, skies: Masks, near: float
) -> _Straightened:
    """A photograph and its masks as `drawn_as` shows them: what lies beyond a lens's picture does not count."""
    camera = drawn_as(scene.cameras, view, near)
    image, valid = undistorted(scene.cameras, view, photograph, camera)

    def mask_of(masks: Masks) -> NDArray[np.bool_] | None:
        if view not in masks:
            return None
        grey = masks[view].astype(np.uint8) * 255
        return np.asarray(undistorted(scene.cameras, view, grey, camera)[0] > _MIN_MASK_VALUE)

    mask = mask_of(masks)
    if valid is None:
        valid = mask
    elif mask is not None:
        valid = valid & mask
    return _Straightened(camera, image, valid, mask_of(skies))


def _level_count(cameras: list[Pinhole]) -> int:
    """Levels that the largest photograph is worth, at which the smallest still holds SSIM's window."""
    longest = max(max(each.width, each.height) for each in cameras)
    shortest = min(min(each.width, each.height) for each in cameras)
    halvings = min((longest // _MIN_HALVED_PIXELS).bit_length(), (shortest // WINDOW).bit_length())
    return max(_MIN_LEVELS, halvings)


def _resized(mask: NDArray[np.bool_] | None, size: tuple[int, int]) -> NDArray[np.bool_] | None:
    """A mask at a size (width, height): pixels all of which it holds."""
    if mask is None or mask.shape[::-1] == size:
        return mask
    share = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return np.asarray(share > _MIN_MASK_SHARE)
