"""One step of training Gaussians on compiled kernels, without torch; and how to have them compiled by another process.

Numba keeps what it compiled in its cache. `python -m fprf.ops.rasterise_training BANDS PART` puts there what half of a step
needs, in three seconds; a command starts these first and has its kernels when it has read its images.
"""

import subprocess
import sys
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from . import photometric, rasterise_gradient_kernels, rasterise_kernels
from .rasterise_kernels import FIXED, SIDE, SLOTS
from .simd import LANES

Floats = np.ndarray[Any, np.dtype[np.float32]]


_PARTS = "forward", "backward"


class Target(NamedTuple):
    """One photograph at one size, as the kernels take it."""

    width: int
    height: int
    camera: Floats
    planes: Floats
    """Colours in [0, 1], [3, H16, W16] flat with `photometric.slack`."""
    blurred: Floats
    """Blurred photographs, as SSIM needs them (`photometric.blurred`)."""
    valid: Floats | None
    """1 where the photograph counts, 0 elsewhere, in the shape of the gradient; None = everywhere."""
    sky: Floats | None = None
    """1 where the photograph shows sky, 0 elsewhere, [H16, W16] flat; None = not known."""


class Learnt(NamedTuple):
    """Measurements of a step, taken before it moved anything."""

    l1: float
    ssim: float
    image: Floats
    """Planes like those of the target, times the factors."""
    pull: Annotated[Floats, "3"]
    """Gradient of the loss by the logarithms of the factors."""
    of_camera: Annotated[NDArray[np.float64], "6"]
    """Gradient of the loss by a turn of the camera about its own centre (radians about the camera's axes) and by a shift of
    that centre (world axes)."""


def learn(
    blocks: Floats,
    moments: tuple[Floats, Floats, Floats],
    count: int,
    bands: int,
    splats: Floats,
    target: Target,
    *,
    background: tuple[float, float, float],
    ssim: float,
    rates: Floats,
    factors: Annotated[Floats, "3"] | None = None,
) -> Learnt:
    """Render `count` Gaussians, compare, and move them by a step of Adam. Where the loss is not finite nothing is changed.

    `moments` are the first, the second and the weight in it (`rasterise_gradient_kernels.adam`). `splats` is room for SLOTS
    numbers a Gaussian; `ssim` the share of 1 - SSIM in the loss; renders are multiplied by `factors`, one a channel, before
    they are compared.
    """
    width, height, camera, planes, blurred, valid, _ = target
    entries, out, left = _render(blocks, count, bands, splats, target, background)
    shown, pull = _exposed(out, target, factors), np.zeros(3, np.float32)
    l1, similar, slope = photometric.loss(shown, planes, blurred, width, height, ssim)
    if not np.isfinite(l1 + similar):
        return Learnt(l1, similar, shown, pull, np.zeros(6))
    if valid is not None:
        slope *= valid
    if factors is not None:
        area = _area(target)
        channels = slope[: 3 * area].reshape(3, area)
        pull[:] = np.einsum("ca,ca->c", channels, shown[: 3 * area].reshape(3, area))
        channels *= factors[:, None]
    gradients = rasterise_gradient_kernels.composite_back(
        3, entries, splats, splats, SLOTS, 6, width, height, out, left, slope, np.zeros_like(left)
    )
    of_camera = rasterise_gradient_kernels.adam(blocks, *moments, count, bands, camera, gradients, entries.first_slot, rates)
    return Learnt(l1, similar, shown, pull, of_camera)


def errors(
    blocks: Floats,
    count: int,
    bands: int,
    splats: Floats,
    target: Target,
    background: tuple[float, float, float],
    factors: Annotated[Floats, "3"] | None = None,
) -> Annotated[Floats, "count 3"]:
    """Sums over the pixels of a view of each Gaussian's weight: times |render - photograph|, where there is sky, and of all."""
    entries, out, _ = _render(blocks, count, bands, splats, target, background)
    area = _area(target)
    apart = np.abs(_exposed(out, target, factors) - target.planes)[: 3 * area]
    if target.valid is not None:
        apart *= target.valid[: 3 * area]
    pixels, sums = np.zeros(8 * area, np.float32), np.empty((count, 8), np.float32)
    pixels[:area], pixels[2 * area : 3 * area] = apart.reshape(3, area).sum(0), 1
    if target.sky is not None:
        pixels[area : 2 * area] = target.sky
    summed = rasterise_gradient_kernels.lift(entries, splats, target.width, target.height, pixels)
    rasterise_gradient_kernels.lift_values(summed, entries.first_slot, count, sums.reshape(-1), 8, 0, 8)
    return sums[:, :3]


def _area(target: Target) -> int:
    """Padded pixels of a plane."""
    return -(-target.width // SIDE) * SIDE * -(-target.height // SIDE) * SIDE


def _exposed(image: Floats, target: Target, factors: Annotated[Floats, "3"] | None) -> Floats:
    """A render times the factors of its channels, a copy; itself where there are none."""
    if factors is None:
        return image
    area, shown = _area(target), image.copy()
    shown[: 3 * area].reshape(3, area)[:] *= factors[:, None]
    return shown


def _render(
    blocks: Floats, count: int, bands: int, splats: Floats, target: Target, background: tuple[float, float, float]
) -> tuple[rasterise_kernels.Entries, Floats, Floats]:
    width, height = target.width, target.height
    rasterise_kernels.project(blocks, count, bands, target.camera, width, height, splats)
    entries = rasterise_kernels.bins(splats, count, width, height)
    out, left = np.zeros(len(target.planes), np.float32), np.empty(len(target.planes) // 3, np.float32)
    behind = np.array(background, np.float32)
    rasterise_kernels.composite(3, entries, splats, splats, SLOTS, 6, behind, width, height, out, left)
    return entries, out, left


def compile_beside(bands: int) -> "list[subprocess.Popen[bytes]]":
    """Start compilation in two other processes, to be waited for before `learn`; none where numba's cache holds something."""
    cache = Path(rasterise_gradient_kernels.cache_path(bands))
    if any(cache.glob(f"{rasterise_gradient_kernels.__name__.rpartition('.')[2]}*.nbi")):
        return []
    quiet = subprocess.DEVNULL
    line = [sys.executable, "-m", __name__, str(bands)]
    return [subprocess.Popen([*line, part], stdin=quiet, stdout=quiet, stderr=quiet) for part in _PARTS]


def _compile(bands: int, part: str) -> None:
    size, rows = LANES, FIXED + 3 * bands
    camera = np.array([1, 0, 0, 0, 1, 0, 0, 0, 1, *[0] * 10, -1, 1, -1, 1, 1, 0], np.float32)
    planes, left = np.zeros(3 * size * size + photometric.slack(size), np.float32), np.zeros((size, size), np.float32)
    blocks, first, second, splats = np.zeros((4, rows * LANES), np.float32)
    nothing = np.zeros(0, np.int32)
    entries = rasterise_kernels.Entries(
        np.zeros(2, np.int32), nothing, nothing, nothing, np.zeros(size + LANES + 1, np.int32), nothing
    )
    if part == "forward":
        rasterise_kernels.project(blocks, size, bands, camera, size, size, splats)
        entries = rasterise_kernels.bins(splats, size, size, size)
        rasterise_kernels.composite(3, entries, splats, splats, SLOTS, 6, camera[:3], size, size, planes, left.reshape(-1))
    else:
        slope = photometric.loss(planes, planes, photometric.blurred(planes, size, size), size, size, 0.2)[2]
        gradients = rasterise_gradient_kernels.composite_back(
            3, entries, splats, splats, SLOTS, 6, size, size, planes, left.reshape(-1), slope, left.reshape(-1)
        )  # fmt: skip
        rasterise_gradient_kernels.adam(
            blocks, first, second, splats, size, bands, camera, gradients, entries.first_slot, np.zeros(rows, np.float32)
        )  # fmt: skip


if __name__ == "__main__":
    _compile(int(sys.argv[1]), sys.argv[2])
