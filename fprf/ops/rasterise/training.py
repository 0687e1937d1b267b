"""3D Gaussians in training, on compiled kernels: parameters with Adam's moments, and a step of learning from
a photograph.

What the kernels want (padded blocks of parameters, planes of whole tiles, room for projections) is known here
and in the kernels alone. Whoever trains sees rows [N R] of parameters, one a Gaussian, in these columns:

    MEANS 0-2 · LOG_SCALES 3-5 (natural logarithms) · QUATERNION 6-9 (w x y z) · LOGIT 10 (of the opacity)
    HARMONICS 11-R (coefficient after coefficient, red green blue; those of degree 0 first)          R = 11 + 3 K

Numba keeps what it compiled in its cache. `python -m fprf.ops.rasterise.training BANDS PART` puts there what
half of a step needs, in three seconds; a command starts these first and has its kernels when it has read its
images.
"""

import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .. import photometric
from ..simd import LANES, aligned
from ..threads import sources
from . import TANGENT_MARGIN
from . import backward_kernels as backward
from . import forward_kernels as forward
from .layout import FIXED
from .tile_kernels import SIDE, SLOTS, Tiles

if TYPE_CHECKING:  # it imports torch, which compilation need not wait for
    from .gsplat import Photograph
    from .reference import Pinhole

Floats = np.ndarray[Any, np.dtype[np.float32]]

# Columns of parameters: as rows lie in a block (`layout`).
MEANS = slice(0, 3)  # world units
LOG_SCALES = slice(3, 6)  # natural logarithms
QUATERNION = slice(6, 10)  # w x y z
LOGIT = slice(10, 11)  # of the opacity
HARMONICS = slice(FIXED, None)
_UNUSED_LOGIT = -20
"""Logit of the opacity in rows that hold no Gaussian: they are never drawn."""


class Target(NamedTuple):
    """One photograph at one size, in the kernels' layout (see `target_of`)."""

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
    there: "Photograph | None" = None
    """The same on a CUDA device, in the place of planes, blurred, valid and sky; None = these."""

    @property
    def axes(self) -> Annotated[NDArray[np.float64], "3 3"]:
        """Rows: the camera's right, down and forward axes in the world."""
        return self.camera[:9].reshape(3, 3).astype(np.float64)

    @property
    def centre(self) -> Annotated[NDArray[np.float64], "3"]:
        """The camera's place in the world."""
        return self.camera[16:19].astype(np.float64)

    def seen_from(
        self, axes: Annotated[NDArray[np.float64], "3 3"], centre: Annotated[NDArray[np.float64], "3"]
    ) -> "Target":
        """The same photograph, taken with other axes from another place."""
        camera = self.camera.copy()
        camera[:9] = axes.reshape(-1)
        camera[9:12] = -axes @ centre
        camera[16:19] = centre
        return self._replace(camera=camera)

    def limited_to(self, mask: Annotated[NDArray[np.bool_], "H W"]) -> "Target":
        """The same photograph, of which only pixels of a mask count, as far as they did before."""
        if self.there is not None:
            return self._replace(there=self.there.limited_to(mask))
        valid = _planes(np.repeat(mask[..., None], 3, 2), 64)
        return self._replace(valid=valid if self.valid is None else valid * self.valid)

    @property
    def area(self) -> int:
        """Pixels of a plane: whole tiles."""
        return -(-self.width // SIDE) * SIDE * -(-self.height // SIDE) * SIDE


def target_of(
    camera: "Pinhole",
    colours: Annotated[Floats, "H W 3"],
    valid: Annotated[NDArray[np.bool_], "H W"] | None = None,
    sky: Annotated[NDArray[np.bool_], "H W"] | None = None,
    *,
    antialiased: bool = True,
) -> Target:
    """A photograph in [0, 1] with its camera; pixels that are not valid do not count. None = all are, no sky
    is known.
    """
    width = camera.width
    height = camera.height
    planes = _planes(colours, photometric.slack(width + -width % SIDE))
    used = None if valid is None or valid.all() else _planes(np.repeat(valid[..., None], 3, 2), 64)
    above = None if sky is None else _planes(sky[..., None], 0)
    blurred = photometric.blurred(planes, width, height)
    return Target(width, height, camera_array(camera, antialiased), planes, blurred, used, above)


def camera_array(camera: "Pinhole", antialiased: bool) -> Floats:
    """A camera as the kernels take it (see `forward_kernels`)."""
    fx, fy, cx, cy = (float(camera.intrinsics[k]) for k in ((0, 0), (1, 1), (0, 2), (1, 2)))
    pose = camera.world_to_camera.double().cpu()
    turn = pose[:3, :3]
    shift = pose[:3, 3]
    # J is taken at most 15 % of the image beyond its edges: further out the linear projection stretches
    # without bound.
    limits = [
        -cx / fx - TANGENT_MARGIN * camera.width / fx,
        (camera.width - cx) / fx + TANGENT_MARGIN * camera.width / fx,
        -cy / fy - TANGENT_MARGIN * camera.height / fy,
        (camera.height - cy) / fy + TANGENT_MARGIN * camera.height / fy,
    ]
    place = [*turn.flatten().tolist(), *shift.tolist(), fx, fy, cx, cy, *(-turn.T @ shift).tolist()]
    return np.array([*place, *limits, camera.near, float(antialiased), camera.k1], np.float32)


def _planes(image: NDArray[Any], behind: int) -> Floats:
    """An image [H W C] as the kernels take it, [C H16 W16] flat and float32, with so many zeros behind."""
    height, width, _ = image.shape
    padded = np.pad(image, ((0, -height % SIDE), (0, -width % SIDE), (0, 0))).transpose(2, 0, 1)
    return np.append(padded, np.zeros(behind, np.float32)).astype(np.float32, copy=False)


class Learnt(NamedTuple):
    """Measurements of a step, taken before it moved anything."""

    l1: float
    """Mean absolute error of the pixels that count."""
    ssim: float
    """Mean over all windows, also over pixels that do not count."""
    squared: float
    """Mean squared error of the pixels that count; NaN where none does."""
    pull: Annotated[Floats, "3"]
    """Gradient of the loss by the logarithms of the factors."""
    of_camera: Annotated[NDArray[np.float64], "6"]
    """Gradient of the loss by a turn of the camera about its own centre (radians about the camera's axes) and
    by a shift of that centre (world axes).
    """


class TrainableGaussians:
    """At most `room` Gaussians of K harmonics with Adam's moments; rows are those of the module's docstring.

    Moments are the first [N R], the second [N R] and the weight in the second [N], 1 - 0.99^k after k steps:
    what is seen for the first time moves as it would have in the first step (`backward_kernels.adam`).
    """

    def __init__(self, room: int, bands: int) -> None:
        self.bands = bands
        self.rows = FIXED + 3 * bands
        self.count = 0
        self._room = -(-room // LANES) * LANES
        # One array for each of parameters, first and second moment: [blocks, R, LANES], flat.
        self._blocks, self._first, self._second = (aligned(self.rows * self._room) for _ in range(3))
        self._weight = aligned(self._room)
        self._splats = aligned(self._room * SLOTS)
        self._sums = aligned(0)  # of a step, kept as fresh memory takes longer than a step's sums
        for part in (self._blocks, self._first, self._second, self._weight):
            part[:] = 0

    def start(
        self,
        parameters: Annotated[Floats, "N R"],
        first: Annotated[Floats, "N R"] | None = None,
        second: Annotated[Floats, "N R"] | None = None,
        weight: Annotated[Floats, "N"] | float = 0.0,
    ) -> None:
        """Begin with N <= `room` Gaussians and their moments, which are 0 where none are given."""
        self.count = len(parameters)
        for part, values in ((self._blocks, parameters), (self._first, first), (self._second, second)):
            part[:] = 0
            if part is self._blocks:  # rows without a Gaussian are never drawn, and are turned like nothing
                self._by_block(part)[:, QUATERNION.start] = 1
                self._by_block(part)[:, LOGIT] = _UNUSED_LOGIT
            if values is not None:
                self._put(part, np.arange(self.count), values)
        self._weight[:] = 0
        self._weight[: self.count] = weight

    def read(
        self, columns: slice = slice(None), index: NDArray[np.int64] | None = None
    ) -> Annotated[Floats, "M c"]:
        """A copy of some columns of the parameters, of all Gaussians or of some."""
        return self._read(self._blocks, columns, index)

    def moments(self) -> tuple[Annotated[Floats, "N R"], Annotated[Floats, "N R"], Annotated[Floats, "N"]]:
        """Copies of the first moments, the second ones, and the weights in the second."""
        return self._read(self._first), self._read(self._second), self._weight[: self.count].copy()

    def multiply(self, columns: slice, factor: float) -> None:
        """Multiply columns of the parameters of all Gaussians."""
        self._by_block(self._blocks)[: -(-self.count // LANES), columns] *= np.float32(factor)

    def limit_scales(self, most: Annotated[Floats, "M"], index: Annotated[NDArray[np.int64], "M"]) -> None:
        """Cut logarithms of standard deviations of some Gaussians that are above `most`."""
        scales = self._by_block(self._blocks)[:, LOG_SCALES]
        scales[index // LANES, :, index % LANES] = np.minimum(self.read(LOG_SCALES, index), most[:, None])

    def split(
        self,
        index: NDArray[np.int64],
        to: NDArray[np.int64],
        one: Annotated[Floats, "M R"],
        other: Annotated[Floats, "M R"],
    ) -> None:
        """Put `one` in the place of M Gaussians and `other` to `to`: in the place of others, or behind the
        last one.

        Both begin without a first moment and with half of the second, as the gradients of halves are half as
        large.
        """
        self._put(self._blocks, index, one)
        self._put(self._blocks, to, other)
        second = 0.5 * self._read(self._second, index=index)
        for place in (index, to):
            self._put(self._first, place, np.zeros_like(second))
            self._put(self._second, place, second)
        self._weight[to] = self._weight[index]
        self.count = max(self.count, int(to.max()) + 1)

    def reorder(self, order: Annotated[NDArray[np.int64], "N"]) -> None:
        """Sort all Gaussians: the i-th becomes what the order[i]-th was. Neighbours in space should be
        neighbours here.
        """
        # One after the other: a copy takes as much again.
        for part in (self._blocks, self._first, self._second):
            self._put(part, np.arange(self.count), self._read(part, index=order))
        self._weight[: self.count] = self._weight[order]

    def learn(
        self,
        target: Target,
        *,
        background: tuple[float, float, float],
        ssim: float,
        rates: Annotated[Floats, "R"],
        factors: Annotated[Floats, "3"] | None = None,
    ) -> Learnt:
        """Render, compare with a photograph, and move by a step of Adam. Where the loss is not finite nothing
        is changed.

        `ssim` is the share of 1 - SSIM in the loss, `rates` a learning rate a column; renders are multiplied
        by `factors`, one a channel, before they are compared.
        """
        width, height, camera, planes, blurred, valid, *_ = target
        # Render, expose, compare: the loss and its slope by every pixel.
        area = target.area
        pull = np.zeros(3, np.float32)
        tiles, out, left = self._render(target, background)
        shown = _exposed(out, area, factors)
        l1, similar, slope = photometric.loss(shown, planes, blurred, width, height, ssim)
        if not np.isfinite(l1 + similar):
            return Learnt(l1, similar, np.nan, pull, np.zeros(6))
        if valid is not None:
            slope *= valid
        if factors is not None:
            # Of a factor e^g the slope by g is that by the render times the render; of the render it is that
            # times the factor.
            channels = slope[: 3 * area].reshape(3, area)
            pull[:] = np.einsum("ca,ca->c", channels, shown[: 3 * area].reshape(3, area))
            channels *= factors[:, None]
        # Pixels to sums for each entry (Gaussian in a tile), and these to parameters, which are moved at
        # once.
        colours = forward.Channels(3, self._splats, SLOTS, 6)
        room = backward.sums_of(tiles)
        if len(self._sums) < room:
            self._sums = aligned(0)
            self._sums = aligned(room + room // 4)
        sums = backward.composite_back(tiles, colours, out, left, slope, np.zeros_like(left), self._sums)
        moments = self._first, self._second, self._weight
        of_camera = backward.adam(tiles, self._blocks, moments, self.bands, camera, sums, rates)
        if valid is None:
            tall = -(-height // SIDE) * SIDE
            wide = -(-width // SIDE) * SIDE
            apart = (shown - planes)[: 3 * area].reshape(3, tall, wide)[:, :height, :width]
            return Learnt(l1, similar, float(np.square(apart).mean()), pull, of_camera)
        l1, squared = _errors_where(shown[: 3 * area] - planes[: 3 * area], valid[: 3 * area])
        return Learnt(l1, similar, squared, pull, of_camera)

    def errors(
        self,
        target: Target,
        background: tuple[float, float, float],
        factors: Annotated[Floats, "3"] | None = None,
    ) -> Annotated[Floats, "N 3"]:
        """Sums over the pixels of a view of each Gaussian's weight: times |render - photograph|, where there
        is sky, and of all.
        """
        tiles, out, _ = self._render(target, background)
        area = target.area
        apart = np.abs(_exposed(out, area, factors) - target.planes)[: 3 * area]
        if target.valid is not None:
            apart *= target.valid[: 3 * area]
        # Three images to be carried back to the Gaussians, of the eight that the kernel takes at once.
        pixels = np.zeros(8 * area, np.float32)
        sums = np.empty((self.count, 8), np.float32)
        pixels[:area] = apart.reshape(3, area).sum(0)
        pixels[2 * area : 3 * area] = 1
        if target.sky is not None:
            pixels[area : 2 * area] = target.sky
        backward.lift_values(tiles, backward.lift(tiles, 8, pixels), sums.reshape(-1), 8, 0, 8, skipped=0)
        return sums[:, :3]

    def _render(self, target: Target, background: tuple[float, float, float]) -> tuple[Tiles, Floats, Floats]:
        """The Gaussians that a view sees, its planes of colours and its transmittance."""
        tiles = forward.see(
            self._blocks, self.count, self.bands, target.camera, target.width, target.height, self._splats
        )  # fmt: skip
        out = np.zeros(len(target.planes), np.float32)
        left = np.empty(len(target.planes) // 3, np.float32)
        colours = forward.Channels(3, self._splats, SLOTS, 6)
        forward.composite(tiles, colours, np.array(background, np.float32), out, left)
        return tiles, out, left

    def _by_block(self, part: Floats) -> Annotated[Floats, "B R L"]:
        return part.reshape(-1, self.rows, LANES)

    def _read(
        self, part: Floats, columns: slice = slice(None), index: NDArray[np.int64] | None = None
    ) -> Annotated[Floats, "M c"]:
        blocks = self._by_block(part)[:, columns]
        if index is None:
            return blocks.transpose(0, 2, 1).reshape(-1, blocks.shape[1])[: self.count].copy()
        return blocks[index // LANES, :, index % LANES]

    def _put(self, part: Floats, index: NDArray[np.int64], values: Annotated[Floats, "M R"]) -> None:
        self._by_block(part)[index // LANES, :, index % LANES] = values


def _errors_where(apart: Floats, valid: Floats) -> tuple[float, float]:
    """Mean absolute and mean squared difference of the pixels that count, flat planes; 0 and NaN where none does.

    `apart` is used up. Padding does not count.
    """
    count = float(valid.sum())
    if count == 0:
        return 0.0, np.nan
    apart *= valid
    squared = float(np.vdot(apart, apart)) / count
    np.abs(apart, out=apart)
    return float(apart.sum()) / count, squared


def _exposed(image: Floats, area: int, factors: Annotated[Floats, "3"] | None) -> Floats:
    """A render times the factors of its channels, a copy; itself where there are none."""
    if factors is None:
        return image
    shown = image.copy()
    shown[: 3 * area].reshape(3, area)[:] *= factors[:, None]
    return shown


def compile_beside(bands: int) -> "list[subprocess.Popen[bytes]]":
    """Start compilation in two other processes, to be waited for before `learn`; none where they did it
    already.
    """
    quiet = subprocess.DEVNULL
    line = [sys.executable, "-m", __name__, str(bands)]
    parts = [part for part in ("forward", "backward") if not _mark(bands, part).is_file()]
    return [subprocess.Popen([*line, part], stdin=quiet, stdout=quiet, stderr=quiet) for part in parts]


def _mark(bands: int, part: str) -> Path:
    """A file beside what was compiled from the text of today."""
    return Path(backward.cache_path(bands)) / f"compiled-{part}-{bands}-{sources()[:16]}"


def _compile(bands: int, part: str) -> None:
    """Run half of a step on nothing: a tile, and a block of Gaussians of which none is drawn; leave a
    mark.
    """
    camera = np.array([1, 0, 0, 0, 1, 0, 0, 0, 1, *[0] * 10, -1, 1, -1, 1, 1, 0, 0], np.float32)
    planes = np.zeros(3 * SIDE * SIDE + photometric.slack(SIDE), np.float32)
    left = np.zeros(SIDE * SIDE, np.float32)
    blocks, first, second, splats = np.zeros((4, (FIXED + 3 * bands) * LANES), np.float32)
    colours = forward.Channels(3, splats, SLOTS, 6)
    if part == "forward":
        tiles = forward.see(blocks, LANES, bands, camera, SIDE, SIDE, splats)
        forward.composite(tiles, colours, camera[:3], planes, left)
    else:
        slots = np.zeros(LANES + LANES + 1, np.int32)
        none = np.zeros(0, np.int32)
        tiles = Tiles(splats, LANES, SIDE, SIDE, np.zeros(2, np.int32), none, none, none, slots, none)
        slope = photometric.loss(planes, planes, photometric.blurred(planes, SIDE, SIDE), SIDE, SIDE, 0.2)[2]
        sums = backward.composite_back(tiles, colours, planes, left, slope, left)
        backward.adam(
            tiles,
            blocks,
            (first, second, splats),
            bands,
            camera,
            sums,
            np.zeros(FIXED + 3 * bands, np.float32),
        )
    mark = _mark(bands, part)
    if mark.parent.is_dir():  # numba may be told to keep nothing
        for old in mark.parent.glob(f"compiled-{part}-{bands}-*"):
            old.unlink(missing_ok=True)
        mark.touch()


if __name__ == "__main__":
    _compile(int(sys.argv[1]), sys.argv[2])
