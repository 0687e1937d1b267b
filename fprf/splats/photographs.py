"""Photographs as the rasteriser sees the world: through a pinhole, with what lies beyond a lens's picture
left out.

Shapes: views of H W pixels, pinholes of h w, which cover what their lenses show. Images are [H W 3], 8 bits,
sRGB; masks [H W]; pixel centres lie at +0.5. Camera axes of the rasteriser are OpenCV's (x right, y down, z
forward), those of `Cameras` OpenGL's.
"""

from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache, partial
from pathlib import Path
from typing import Annotated, NamedTuple

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
from ..rendering.cameras import (
    Cameras,
    Intrinsics,
    directions_of,
    intrinsics_of,
    pixel_grid,
    project,
    rays_through,
)
from .config import GaussiansConfig

Masks = dict[int, NDArray[np.bool_]]
"""Masks [H W] by view."""
_WIDEST = 4.0
"""Tangent of the widest angle that a pinhole shows: 76 degrees."""
_SHARPEST = cv2.INTER_LANCZOS4
"""Out of its lens and back into it a photograph of 135 x 240 pixels comes with 43 dB; by cubic interpolation
with 40.
"""
_KEPT = 1 << 31
_KEPT_THERE = 0.3
"""Bytes of photographs in the rasteriser's layout, some ten times as large as 8-bit pixels, that are kept
between steps; share of a CUDA device's free memory that they may take there.
"""
_DULL = 0.5
"""Share of the usual ratio below which a photograph counts as blurred."""
_BESIDE = 8
"""Photographs that one is compared with."""
_APART = 2
"""Halvings between the fine detail and the coarse."""
_SMALLEST = 4
"""Pixels of the shorter side from which on detail is measured."""
_FEWEST = 3
"""Photographs below which there is no saying what is usual."""


class Level(Mapping[int, Target]):
    """Training views at one scale, by view; their sizes may differ."""

    blurred: frozenset[int] = frozenset()
    """Views that are blurred at this scale."""


class _View(NamedTuple):
    """A photograph without its lens, as 8-bit pixels."""

    camera: Pinhole
    image: Image
    valid: NDArray[np.bool_] | None
    sky: NDArray[np.bool_] | None


class _Kept(OrderedDict[tuple[int, int], Target]):
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


class _Scaled(Level):
    """Views at 1/2^k of their size, brought into the rasteriser's layout when a step asks for them."""

    def __init__(
        self,
        views: Mapping[int, _View],
        k: int,
        kept: _Kept,
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
        key = self.k, view
        if key in self.kept:
            self.kept.move_to_end(key)
            return self.kept[key]
        camera, image, valid, sky = self.views[view]
        size = max(1, camera.width >> self.k), max(1, camera.height >> self.k)
        shrink = torch.tensor(
            [[size[0] / camera.width], [size[1] / camera.height], [1.0]], dtype=torch.float64
        )
        small = camera._replace(intrinsics=camera.intrinsics * shrink, width=size[0], height=size[1])
        # Each size is reduced from the full one, so that errors do not add up; the camera shrinks with the
        # image.
        colours: Floats = np.divide(image, 255, dtype=np.float32)
        reduced: Floats = (
            np.asarray(cv2.resize(colours, size, interpolation=cv2.INTER_AREA), np.float32)
            if self.k
            else colours
        )
        target = self.make(small, reduced, _resized(valid, size), _resized(sky, size))
        self.kept.add(key, target)
        return target


def _bytes(target: Target) -> int:
    return sum(
        part.nbytes for part in (*target, *(target.there or ())) if isinstance(part, np.ndarray | Tensor)
    )


def camera_of(cameras: Cameras, view: int, near: float = 0.01) -> Pinhole:
    """A view without its lens as the rasteriser takes it: OpenCV's axes, world to camera."""
    width, height = cameras.size[view].tolist()
    pose = cameras.pose[view]
    turn = (pose[:, :3] * torch.tensor([1.0, -1.0, -1.0], dtype=pose.dtype)).T
    world_to_camera = torch.eye(4, dtype=torch.float64)
    world_to_camera[:3, :3], world_to_camera[:3, 3] = turn, -turn @ pose[:, 3]
    return Pinhole(
        _intrinsics(cameras.focal[view], cameras.centre[view]), world_to_camera, width, height, near
    )


def undistorted(
    cameras: Cameras, view: int, image: Image, camera: Pinhole
) -> tuple[Image, NDArray[np.bool_] | None]:
    """Return the image of a pinhole camera at a view's place, and the part of it that the view shows; None =
    everywhere.

    The image is returned as it is where the view is a pinhole, which `camera` is then taken to be.
    """
    if int(cameras.lens[view]) == 0:
        return image, None
    pinhole = tuple(camera.intrinsics.flatten().tolist())
    x, y, inside = _places(intrinsics_of(cameras, view), pinhole, camera.width, camera.height)
    return np.asarray(cv2.remap(image, x, y, _SHARPEST, borderMode=cv2.BORDER_REPLICATE)), inside


@lru_cache(maxsize=2)
def _places(
    lens: Intrinsics, pinhole: tuple[float, ...], width: int, height: int
) -> tuple[Annotated[Floats, "h w"], Annotated[Floats, "h w"], Annotated[NDArray[np.bool_], "h w"]]:
    """Where a lens shows the pixels of a pinhole with an intrinsic matrix, as `cv2.remap` takes it, and which
    of them it shows.

    Most views of a capture look through one lens.
    """
    # Rays through the pixels of the pinhole, from OpenCV's axes to OpenGL's.
    x = torch.arange(width).double() + 0.5
    y = torch.arange(height).double() + 0.5
    grid = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1).view(-1, 2)
    matrix = torch.tensor(pinhole, dtype=torch.float64).view(3, 3)
    local = (grid - matrix[:2, 2]) / matrix.diagonal()[:2]
    points = torch.stack([local[:, 0], -local[:, 1], -torch.ones(len(local), dtype=torch.float64)], -1)
    # Where the lens maps them; what falls beyond the outermost pixel centres would only repeat the edge.
    pixel, _ = project(lens.camera(), torch.zeros(len(points), dtype=torch.int64), points)
    place = pixel.view(height, width, 2).numpy()
    inside = (
        np.isfinite(place).all(-1) & (place >= 0.5).all(-1) & (place <= np.array(lens.size) - 0.5).all(-1)
    )
    where = (np.nan_to_num(place, nan=-1e6) - 0.5).astype(np.float32)
    return np.ascontiguousarray(where[..., 0]), np.ascontiguousarray(where[..., 1]), inside


def covering(cameras: Cameras, view: int, near: float) -> Pinhole:
    """The pinhole camera that covers what a view shows: how far a lens reaches, its outermost pixels say."""
    plain = camera_of(cameras, view, near)
    if int(cameras.lens[view]) == 0:
        return plain
    reached = _outermost(intrinsics_of(cameras, view)) * cameras.focal[view]
    # The pinhole keeps the focal length, and has a border of two pixels to interpolate in.
    low = reached.amin(0).floor() - 2
    high = reached.amax(0).ceil() + 2
    wide, tall = (high - low).int().tolist()
    return plain._replace(intrinsics=_intrinsics(cameras.focal[view], -low), width=wide, height=tall)


def cover(cameras: Cameras, view: int, near: float) -> tuple[Pinhole, Annotated[Tensor, "H W 2"] | None]:
    """`covering`, and where each of the view's pixels lies in its image; None where the view is a pinhole
    itself.
    """
    camera = covering(cameras, view, near)
    if int(cameras.lens[view]) == 0:
        return camera, None
    width, height = cameras.size[view].tolist()
    tangent = _tangents(directions_of(intrinsics_of(cameras, view), torch.device("cpu")))
    return camera, (tangent * cameras.focal[view] + camera.intrinsics[:2, 2]).view(height, width, 2)


@lru_cache(maxsize=2)
def _outermost(lens: Intrinsics) -> Annotated[Tensor, "N 2"]:
    """Tangents of the rays through a lens's outermost pixels."""
    camera = lens.camera()
    (width, height) = lens.size
    grid = pixel_grid(camera, 0).view(height, width, 2)
    border = torch.cat([grid[0], grid[-1], grid[:, 0], grid[:, -1]])
    return _tangents(rays_through(camera, torch.zeros(len(border), dtype=torch.int64), border)[1])


def _tangents(direction: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N 2"]:
    """Tangents, in OpenCV's axes, of rays in OpenGL's: what lies behind the camera is put at the widest
    angle.
    """
    ahead = (-direction[:, 2]).clamp_min(1e-9)
    return torch.stack([direction[:, 0] / ahead, -direction[:, 1] / ahead], -1).clamp(-_WIDEST, _WIDEST)


def distorted(
    image: Annotated[Tensor, "h w C"], place: Annotated[Tensor, "H W 2"], *, linear: bool = False
) -> Annotated[Tensor, "H W C"]:
    """An image at the places of `cover`; `linear` for what must not swing over its edges."""
    x, y = np.ascontiguousarray((place.numpy() - 0.5).astype(np.float32).transpose(2, 0, 1))
    interpolation = cv2.INTER_LINEAR if linear else _SHARPEST
    sampled = cv2.remap(np.ascontiguousarray(image), x, y, interpolation, borderMode=cv2.BORDER_REPLICATE)
    return torch.from_numpy(np.atleast_3d(sampled))


def load_photographs(
    config: GaussiansConfig, scene: ParsedScene, views: list[int]
) -> tuple[dict[int, Image], Masks, Masks]:
    """Images of views, then the masks that say where they count, and those that say where they show sky, of
    views with one.
    """
    images = dict(zip(views, load_images(scene, config.background, views), strict=True))

    def load_masks(paths: tuple[Path | None, ...]) -> Masks:
        if paths and config.masks:
            named = {view: paths[view] for view in views}
        else:
            named = {}
        found = {}
        for view, path in named.items():
            if path is not None:
                found[view] = load_mask(path, images[view].shape[1::-1])
        return found

    # Without surroundings nothing could show the sky but what floats before it.
    return images, load_masks(scene.masks), load_masks(scene.sky_masks if config.surroundings else ())


def make_levels(
    scene: ParsedScene,
    images: Mapping[int, Image],
    masks: Masks,
    near: float,
    skies: Masks | None = None,
    *,
    device: torch.device | None = None,
) -> list[Level]:
    """The training views at their own size, at half of it and so on, until the longer side has less than 240
    pixels.

    A view counts where its mask, if it has one, is true; where that in `skies` is true it shows sky. They are
    made for the CPU, or for a CUDA `device` on which gsplat trains.
    """
    cameras = {view: covering(scene.cameras, view, near) for view in scene.train.tolist()}
    longest = max(max(each.width, each.height) for each in cameras.values())
    shortest = min(min(each.width, each.height) for each in cameras.values())
    count = max(
        2, min((longest // 120).bit_length(), (shortest // WINDOW).bit_length())
    )  # SSIM needs its window
    pixels: dict[int, _View] = {}

    def straightened(masks: Masks, view: int) -> NDArray[np.bool_] | None:
        if view not in masks:
            return None
        grey = masks[view].astype(np.uint8) * 255
        return np.asarray(undistorted(scene.cameras, view, grey, cameras[view])[0] > 254)

    for view, camera in cameras.items():
        # The photograph and its masks without their lens: what lies beyond the lens's picture does not count.
        image, valid = undistorted(scene.cameras, view, images[view], camera)
        mask = straightened(masks, view)
        sky = straightened(skies or {}, view)
        pixels[view] = _View(
            camera, image, mask if valid is None else valid if mask is None else valid & mask, sky
        )
    blurred = blurred_views(scene.cameras, {view: images[view] for view in cameras}, count)
    if device is None or not usable(device):
        kept = _Kept(_KEPT)
        make = target_of
    else:
        kept = _Kept(int(_KEPT_THERE * (free_memory(device) or 0)))
        make = partial(target_on, device)
    found: list[Level] = []
    for k in range(count):
        found.append(_Scaled(pixels, k, kept, blurred[k], make))
    return found


def detail(image: Image, scales: int) -> Annotated[NDArray[np.float64], "K"]:
    """Sharpness of an RGB image [H W 3] at scales k < K = `scales`; NaN where nothing is to be seen, and
    where it is too small.

    Blur takes the finest detail of a photograph and leaves the coarse. So their ratio,

        r_k = var(Laplacian at 1/2^k of the size) / var(Laplacian at 1/2^(k + 2)),

    says how sharp it is at a scale, whatever it shows: of eight photographs of llff_flower that were moved by
    7 to 13 pixels it falls to 0.23 to 0.32 of what is usual, of the sharp ones none below 0.79.
    """
    # A pyramid of halved sizes: the variance of the Laplacian at each is the detail that is left there.
    grey = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY).astype(np.float32)
    energy = np.full(scales + _APART, np.nan)
    for k in range(scales + _APART):
        if k:
            grey = np.asarray(
                cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), dtype=np.float32
            )
        if min(grey.shape) < _SMALLEST:
            break
        energy[k] = cv2.Laplacian(grey, cv2.CV_32F).var(dtype=np.float64)
    # In a flat picture there is no coarse detail to compare with, and the ratio says nothing.
    coarse = energy[_APART:]
    ratio = np.full(scales, np.nan)
    np.divide(energy[:scales], coarse, out=ratio, where=coarse > 1e-3)
    return ratio


def blurred_views(cameras: Cameras, images: Mapping[int, Image], scales: int) -> tuple[frozenset[int], ...]:
    """Views, of those with an image, that are blurred at each scale: at their size, at half of it and so on.

    `cameras` are of all views; images [H W 3] are 8 bits, sRGB. What is usual is the median of photographs
    taken near by in the same direction, so a softer camera is compared with itself, and nothing counts as
    blurred where all is.
    """
    views = list(images)
    if len(views) < _FEWEST:
        return (frozenset(),) * scales
    with ThreadPoolExecutor() as pool:
        ratio = np.stack(list(pool.map(lambda view: detail(images[view], scales), views)))
    # Near by means places in units of how far the cameras stand apart, and directions in radians.
    pose = cameras.pose[torch.tensor(views)].double()
    place = pose[:, :, 3]
    ahead = -pose[:, :, 2]
    spread = float((place - place.mean(0)).norm(dim=1).mean()) or 1.0
    blurred: list[set[int]] = [set() for _ in range(scales)]
    for row, view in enumerate(views):
        apart = (place - place[row]).norm(dim=1) / spread + (ahead - ahead[row]).norm(dim=1)
        apart[row] = torch.inf
        beside = apart.argsort()[: min(_BESIDE, len(views) - 1)].numpy()
        for k in range(scales):
            usual = ratio[beside, k]
            usual = usual[np.isfinite(usual)]
            if len(usual) and ratio[row, k] < _DULL * np.median(usual):
                blurred[k].add(view)
    return tuple(map(frozenset, blurred))


def _resized(mask: NDArray[np.bool_] | None, size: tuple[int, int]) -> NDArray[np.bool_] | None:
    """A mask at a size (width, height): pixels all of which it holds."""
    if mask is None or mask.shape[::-1] == size:
        return mask
    return np.asarray(cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.999)


def _intrinsics(focal: Annotated[Tensor, "2"], centre: Annotated[Tensor, "2"]) -> Annotated[Tensor, "3 3"]:
    out = torch.eye(3, dtype=torch.float64)
    out[[0, 1], [0, 1]], out[:2, 2] = focal.double(), centre.double()
    return out
