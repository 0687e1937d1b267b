"""3D Gaussians on a CUDA device by gsplat (Ye et al. 2025): drawn with gradients, and trained.

gsplat computes what `rasterise_reference` defines, with two differences: it cuts alphas at 0.999 instead of
0.99, and a ray ends where 1/10000 of the light is left. It is imported when something is drawn, never before.
N, K, C, H, W and R are those of `rendering` and `training`.
"""

import functools
import importlib.util
import math
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from ..photometric import SSIM_C1, SSIM_C2, WINDOW, WINDOW_SIGMA
from ..simd import LANES
from . import ADAM_DECAYS, ADAM_EPSILON, BLUR, MAX_COORDINATE, MAX_LOG
from .layout import FIXED
from .reference import Pinhole, rasterise_reference
from .tile_kernels import SIDE
from .training import (
    HARMONICS,
    LOG_SCALES,
    LOGIT,
    MEANS,
    QUATERNION,
    Floats,
    Learnt,
    Target,
    TrainableGaussians,
    camera_array,
)

_PROPERTY_COLUMNS = (3, 3, 4, 1)
"""Columns of means, logarithms of scales, quaternions and logits; those of the harmonics follow."""
_UPRIGHT = 1e-15
"""Added to w of a quaternion, so that one without a length is drawn, as if it turned nothing."""


def usable(device: torch.device) -> bool:
    """True where gsplat draws on this device."""
    return device.type == "cuda" and obstacle(device) is None


@functools.cache
def obstacle(device: torch.device) -> str | None:
    """The reason why gsplat can't draw on a CUDA device; None where it has drawn a Gaussian there.

    gsplat compiles its kernels at the first use where its wheel has none, which takes minutes and CUDA's
    toolkit.
    """
    if importlib.util.find_spec("gsplat") is None:
        return "gsplat is not installed; `pip install 'fprf[cuda]'` installs it"
    camera = Pinhole(torch.eye(3), torch.eye(4), SIDE, SIDE)
    try:
        with torch.inference_mode(False), torch.enable_grad():
            means = torch.ones(1, 3, device=device, requires_grad=True)
            rest = (
                torch.ones(1, 4, device=device),
                torch.zeros(1, 3, device=device),
                torch.zeros(1, device=device),
            )
            values = torch.ones(1, 3, device=device)
            background = torch.zeros(3, device=device)
            image, _ = rasterise_gsplat(means, *rest, values, camera, background, antialiased=True)
            torch.autograd.grad(image.sum(), means)
    except (ImportError, AttributeError, OSError, RuntimeError) as fault:
        return f"gsplat does not work here: {' '.join(str(fault).split())[:200]}"
    return None


def rasterise_gsplat(
    means: Annotated[Tensor, "N 3"],
    quaternions: Annotated[Tensor, "N 4"],
    log_scales: Annotated[Tensor, "N 3"],
    logits: Annotated[Tensor, "N"],
    values: Annotated[Tensor, "N C"],
    camera: Pinhole,
    background: Annotated[Tensor, "C"],
    *,
    antialiased: bool,
) -> tuple[Annotated[Tensor, "H W C+1"], Annotated[Tensor, "H W"]]:
    """Composited values, the composited depth behind them, and the transmittance left, float32: as
    `rasterise_reference`.
    """
    if camera.k1 != 0:  # gsplat draws pinholes alone
        return rasterise_reference(
            means,
            quaternions,
            log_scales,
            logits,
            values,
            camera,
            background,
            antialiased=antialiased,
        )
    camera = camera._replace(
        intrinsics=camera.intrinsics.to(means), world_to_camera=camera.world_to_camera.to(means)
    )
    rows = torch.cat([means, log_scales, quaternions, logits[:, None], values], 1)
    image, opacity, _ = _render(rows, camera, background, bands=None, antialiased=antialiased, mode="RGB+D")
    return image, 1 - opacity


class _Guards(NamedTuple):
    """Bounds by which Gaussians that are not finite, or far beyond everything, are left out."""

    most: Annotated[Tensor, "R"]
    """Largest size of each column; what is larger, or NaN, is not drawn."""
    harmless: Annotated[Tensor, "R"]
    """Drawn in its place: at the origin, and transparent."""
    upright: Annotated[Tensor, "4"]


def _guards(columns: int, like: Tensor) -> _Guards:
    """Guards of rows with so many columns, of the dtype and on the device of a tensor."""
    most = np.full(columns, torch.finfo(like.dtype).max)
    harmless = np.zeros(columns)
    upright = np.zeros(4)
    most[MEANS] = most[QUATERNION] = MAX_COORDINATE
    most[LOG_SCALES] = most[LOGIT] = np.inf  # these are cut
    harmless[LOGIT] = -MAX_LOG
    harmless[QUATERNION.start] = 1
    upright[0] = _UPRIGHT
    return _Guards(*(torch.from_numpy(each).to(like) for each in (most, harmless, upright)))


def _render(
    rows: Annotated[Tensor, "N R"],
    camera: Pinhole,
    background: Annotated[Tensor, "C"],
    *,
    bands: int | None,
    antialiased: bool,
    mode: Literal["RGB", "RGB+D"],
    guards: _Guards | None = None,
) -> tuple[Annotated[Tensor, "H W C"], Annotated[Tensor, "H W"], Annotated[Tensor, "N"]]:
    """Image, opacity, and which Gaussians lie in view, for parameters in the columns of `training`.

    Behind the logits come harmonics of so many bands, or values where `bands` is None. What is not finite, or
    far beyond everything, is not drawn: it would spoil the gradients of all others.
    """
    from gsplat import rasterization

    guards = guards or _guards(rows.shape[1], rows)
    fine = (rows.detach().abs() <= guards.most).all(1, keepdim=True)
    means, log_scales, quaternions, logits, values = torch.split(
        torch.where(fine, rows, guards.harmless), [*_PROPERTY_COLUMNS, rows.shape[1] - FIXED], 1
    )
    image, opacity, about = rasterization(
        means=means.contiguous(),
        quats=quaternions + guards.upright,
        scales=log_scales.clamp(-MAX_LOG, MAX_LOG).exp(),
        opacities=logits[:, 0].clamp(-MAX_LOG, MAX_LOG).sigmoid(),
        colors=values.contiguous() if bands is None else values.reshape(-1, bands, 3),
        viewmats=camera.world_to_camera[None],
        Ks=camera.intrinsics[None],
        width=camera.width,
        height=camera.height,
        near_plane=camera.near,
        eps2d=BLUR,
        sh_degree=None if bands is None else math.isqrt(bands) - 1,
        packed=False,
        backgrounds=background[None],
        render_mode=mode,
        rasterize_mode="antialiased" if antialiased else "classic",
    )
    return image[0], opacity[0, ..., 0], (about["radii"][0] > 0).all(-1)


class Photograph(NamedTuple):
    """A photograph on a CUDA device."""

    colours: Annotated[Tensor, "3 H W"]
    valid: Annotated[Tensor, "H W"] | None
    """1 where it counts, 0 elsewhere; None = everywhere."""
    sky: Annotated[Tensor, "H W"] | None
    """1 where it shows sky, 0 elsewhere; None = not known."""

    def limited_to(self, mask: Annotated[NDArray[np.bool_], "H W"]) -> "Photograph":
        """The same, of which only pixels of a mask count, as far as they did before."""
        valid = torch.from_numpy(mask).to(self.colours)
        return self._replace(valid=valid if self.valid is None else valid * self.valid)


def target_on(
    device: torch.device,
    camera: Pinhole,
    colours: Annotated[Floats, "H W 3"],
    valid: Annotated[NDArray[np.bool_], "H W"] | None = None,
    sky: Annotated[NDArray[np.bool_], "H W"] | None = None,
    *,
    antialiased: bool = True,
) -> Target:
    """As `target_of`, for Gaussians in training on a CUDA device, to which the photograph is copied."""

    def there(image: NDArray[Any]) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(image)).to(device).float()

    photograph = Photograph(
        there(colours).permute(2, 0, 1).contiguous(),
        None if valid is None or valid.all() else there(valid),
        None if sky is None else there(sky),
    )
    nothing = np.zeros(0, np.float32)
    return Target(
        camera.width,
        camera.height,
        camera_array(camera, antialiased),
        nothing,
        nothing,
        None,
        there=photograph,
    )


class GsplatGaussians:
    """`TrainableGaussians` on a device, drawn by gsplat: the same methods, parameters, loss and optimiser.

    Whoever calls gives and gets arrays of host memory. A step waits for the device where gsplat does, and
    once for its figures.
    """

    def __init__(self, room: int, bands: int, device: torch.device) -> None:
        self.bands = bands
        self.rows = FIXED + 3 * bands
        self.device = device
        self.count = 0
        self._values = torch.zeros(room, self.rows, device=device)
        self._first = torch.zeros_like(self._values)
        self._second = torch.zeros_like(self._values)
        self._weight = torch.zeros(room, device=device)
        self._guards = _guards(self.rows, self._values)

    def start(
        self,
        parameters: Annotated[Floats, "N R"],
        first: Annotated[Floats, "N R"] | None = None,
        second: Annotated[Floats, "N R"] | None = None,
        weight: Annotated[Floats, "N"] | float = 0.0,
    ) -> None:
        """Begin with N <= `room` Gaussians and their moments, which are 0 where none are given."""
        self.count = len(parameters)
        for part, given in ((self._values, parameters), (self._first, first), (self._second, second)):
            part.zero_()
            if given is not None:
                part[: self.count] = self._there(given)
        self._weight.zero_()
        self._weight[: self.count] = weight if isinstance(weight, int | float) else self._there(weight)

    def read(
        self, columns: slice = slice(None), index: NDArray[np.int64] | None = None
    ) -> Annotated[Floats, "M c"]:
        """A copy of some columns of the parameters, of all Gaussians or of some."""
        found = (
            self._values[: self.count, columns]
            if index is None
            else self._values[self._there(index), columns]
        )
        return _here(found)

    def moments(self) -> tuple[Annotated[Floats, "N R"], Annotated[Floats, "N R"], Annotated[Floats, "N"]]:
        """Copies of the first moments, the second ones, and the weights in the second."""
        return (
            _here(self._first[: self.count]),
            _here(self._second[: self.count]),
            _here(self._weight[: self.count]),
        )

    def multiply(self, columns: slice, factor: float) -> None:
        """Multiply columns of the parameters of all Gaussians."""
        self._values[: self.count, columns] *= factor

    def limit_scales(self, most: Annotated[Floats, "M"], index: Annotated[NDArray[np.int64], "M"]) -> None:
        """Cut logarithms of standard deviations of some Gaussians that are above `most`."""
        some = self._there(index)
        self._values[some, LOG_SCALES] = torch.minimum(
            self._values[some, LOG_SCALES], self._there(most)[:, None]
        )

    def split(
        self,
        index: NDArray[np.int64],
        to: NDArray[np.int64],
        one: Annotated[Floats, "M R"],
        other: Annotated[Floats, "M R"],
    ) -> None:
        """As `TrainableGaussians.split`: `one` in the place of M Gaussians, `other` to `to`; both begin
        without a first moment and with half of the second.
        """
        places = self._there(index)
        others = self._there(to)
        self._values[places] = self._there(one)
        self._values[others] = self._there(other)
        second = 0.5 * self._second[places]
        for each in (places, others):
            self._first[each] = torch.zeros_like(second)
            self._second[each] = second
        self._weight[others] = self._weight[places]
        self.count = max(self.count, int(to.max()) + 1)

    def reorder(self, order: Annotated[NDArray[np.int64], "N"]) -> None:
        """Sort all Gaussians: the i-th becomes what the order[i]-th was."""
        places = self._there(order)
        for part in (self._values, self._first, self._second, self._weight):
            part[: self.count] = part[places]

    def learn(
        self,
        target: Target,
        *,
        background: tuple[float, float, float],
        ssim: float,
        rates: Annotated[Floats, "R"],
        factors: Annotated[Floats, "3"] | None = None,
    ) -> Learnt:
        """As `TrainableGaussians.learn`: render, compare, move by a step of Adam; nothing where the loss is
        not finite.
        """
        # One copy takes all numbers of the step to the device.
        exposure = np.ones(3, np.float32) if factors is None else factors
        numbers = self._there(np.concatenate([target.camera, background, exposure, rates]).astype(np.float32))
        seen_from, colour, exposed, rate = torch.split(numbers, [len(target.camera), 3, 3, self.rows])
        photograph = self._photograph(target)
        camera = _camera(target, seen_from)
        pose = camera.world_to_camera.requires_grad_()
        rows = self._values[: self.count].detach().requires_grad_()
        how: dict[str, Any] = {
            "bands": self.bands,
            "antialiased": bool(target.camera[24]),
            "guards": self._guards,
        }
        image, _, seen = _render(rows, camera, colour, mode="RGB", **how)
        # The loss and its slope by every pixel, then by parameters and pose.
        shown = (image.detach() * exposed).permute(2, 0, 1)
        l1, similar, slope = photometric_loss(shown, photograph.colours, ssim)
        if photograph.valid is not None:
            slope = slope * photograph.valid
        # Of a factor e^g the slope by g is that by the render times the render.
        pull = (slope * shown).sum((1, 2))
        of_rows, of_pose = torch.autograd.grad(image, [rows, pose], slope.permute(1, 2, 0) * exposed)
        self._adam(of_rows, seen & (l1 + similar).isfinite(), rate)
        # A turn w about the camera's own axes moves the pose [R t] by -[w]x [R t]; a shift c of its centre
        # moves t by -R c.
        moment = of_pose[:3] @ pose.detach()[:3].T
        of_turn = torch.stack(
            [moment[1, 2] - moment[2, 1], moment[2, 0] - moment[0, 2], moment[0, 1] - moment[1, 0]]
        )
        of_shift = -pose.detach()[:3, :3].T @ of_pose[:3, 3]
        apart = shown - photograph.colours
        squared = apart.square().mean()
        if photograph.valid is not None:
            # Pixels that do not count are neither learnt from nor told.
            apart = apart * photograph.valid
            count = len(apart) * photograph.valid.sum()
            l1 = apart.abs().sum() / count.clamp_min(1)
            squared = apart.square().sum() / count
        measured = torch.stack([l1, similar, squared])
        found = _here(torch.cat([measured, pull, of_turn, of_shift]))  # the step's one wait
        if not np.isfinite(found[:2]).all():
            return Learnt(float(found[0]), float(found[1]), np.nan, np.zeros(3, np.float32), np.zeros(6))
        of_exposure = np.zeros(3, np.float32) if factors is None else found[3:6]
        return Learnt(
            float(found[0]), float(found[1]), float(found[2]), of_exposure, found[6:].astype(np.float64)
        )

    def _adam(
        self, gradient: Annotated[Tensor, "N R"], seen: Annotated[Tensor, "N"], rates: Annotated[Tensor, "R"]
    ) -> None:
        """Move all of a block of LANES where one was seen, as `backward_kernels.adam`; moments of others
        stay.
        """
        values = self._values[: self.count]
        first = self._first[: self.count]
        second = self._second[: self.count]
        weight = self._weight[: self.count]
        # Masks that are multiplied with, not indexed by: the host need not know how many there are.
        blocks = torch.nn.functional.pad(seen, (0, -len(seen) % LANES)).view(-1, LANES)
        seen = blocks.any(1).repeat_interleave(LANES)[: len(seen)]
        seen = (seen & gradient.isfinite().all(1))[:, None]
        gradient = torch.where(seen, gradient, 0.0)
        share = seen.to(values.dtype)
        weight.lerp_(torch.ones_like(weight), (1 - ADAM_DECAYS[1]) * share[:, 0])
        first.lerp_(gradient, (1 - ADAM_DECAYS[0]) * share)
        second.lerp_(gradient.square(), (1 - ADAM_DECAYS[1]) * share)
        size = (
            second / weight[:, None].clamp_min(1 - ADAM_DECAYS[1])
        ).sqrt() + ADAM_EPSILON  # a weight is at least that where seen
        values.sub_(torch.where(seen, rates * first / size, 0.0))

    @torch.no_grad()
    def errors(
        self,
        target: Target,
        background: tuple[float, float, float],
        factors: Annotated[Floats, "3"] | None = None,
    ) -> Annotated[Floats, "N 3"]:
        """As `TrainableGaussians.errors`: each Gaussian's weight times |render - photograph|, in sky, and of
        all.
        """
        exposure = np.ones(3, np.float32) if factors is None else factors
        numbers = self._there(np.concatenate([target.camera, background, exposure]).astype(np.float32))
        seen_from, colour, exposed = torch.split(numbers, [len(target.camera), 3, 3])
        camera = _camera(target, seen_from)
        photograph = self._photograph(target)
        how: dict[str, Any] = {"antialiased": bool(target.camera[24]), "mode": "RGB"}
        rows = self._values[: self.count]
        image, _, _ = _render(rows, camera, colour, bands=self.bands, guards=self._guards, **how)
        apart = ((image * exposed).permute(2, 0, 1) - photograph.colours).abs().sum(0)
        if photograph.valid is not None:
            apart = apart * photograph.valid
        whole = torch.ones_like(apart)
        pixels = torch.stack(
            [apart, torch.zeros_like(whole) if photograph.sky is None else photograph.sky, whole], -1
        )
        # Rendering is linear in the values, so their gradient for given pixels is its transpose.
        with torch.enable_grad():
            lifted = torch.zeros(self.count, 3, device=self.device, requires_grad=True)
            plain = torch.cat([rows[:, : HARMONICS.start], lifted], 1)
            back, _, _ = _render(plain, camera, torch.zeros_like(colour), bands=None, **how)
            return _here(torch.autograd.grad(back, lifted, pixels)[0])

    def _photograph(self, target: Target) -> Photograph:
        """A target's photograph on this device; copied there where it lies in the layout of the CPU's
        kernels.
        """
        if target.there is not None:
            return target.there
        wide = -(-target.width // SIDE) * SIDE

        def image(planes: Floats) -> Annotated[Tensor, "C H W"]:
            # What lies behind the last plane, for the vectors of the CPU, is less than a plane.
            padded = planes[: len(planes) // target.area * target.area].reshape(-1, target.area // wide, wide)
            return self._there(padded)[:, : target.height, : target.width]

        valid, sky = (None if each is None else image(each)[0] for each in (target.valid, target.sky))
        return Photograph(image(target.planes), valid, sky)

    def _there(self, values: NDArray[np.float32 | np.int64]) -> Tensor:
        return torch.from_numpy(values).to(self.device)


Trainable = TrainableGaussians | GsplatGaussians
"""Gaussians in training, on the CPU or on a CUDA device."""


def trainable(room: int, bands: int, device: torch.device) -> Trainable:
    """Room for Gaussians in training: on a CUDA device where gsplat draws there, else on the CPU."""
    return GsplatGaussians(room, bands, device) if usable(device) else TrainableGaussians(room, bands)


def photometric_loss(
    shown: Annotated[Tensor, "C H W"], target: Annotated[Tensor, "C H W"], share: float
) -> tuple[Tensor, Tensor, Annotated[Tensor, "C H W"]]:
    """Mean |shown - target|, mean SSIM, and the slope of (1 - share) L1 + share (1 - SSIM):
    `photometric.loss`, in torch.

    SSIM counts as 0, without a slope, where `share` is 0 and where the image is smaller than a window.
    """
    shown = shown.detach()
    apart = shown - target
    similar = shown.new_zeros(())
    slope = apart.sign() * ((1 - share) / apart.numel())
    if share > 0 and min(shown.shape[1:]) >= WINDOW:
        # Means m and mean products q in every window that lies inside.
        squares = [shown.square(), target.square(), shown * target]
        ma, mb, qaa, qbb, qab = _windowed(torch.cat([shown, target, *squares]), 0).chunk(5)
        # Wang et al. 2004, Eq. 13: S = a1 a2 / (b1 b2).
        square = ma.square() + mb.square()
        product = ma * mb
        a1 = 2 * product + SSIM_C1
        a2 = 2 * (qab - product) + SSIM_C2
        b1 = square + SSIM_C1
        b2 = qaa + qbb - square + SSIM_C2
        scale = 1 / (b1 * b2)
        index = a1 * a2 * scale
        similar = index.mean()
        # Its slopes by ma, qaa and qab, spread over the pixels of each window.
        of_mean = 2 * (mb * (a2 - a1) * scale + ma * index * (1 / b2 - 1 / b1))
        of_pixels = _windowed(torch.cat([of_mean, -index / b2, 2 * a1 * scale]), WINDOW - 1)
        mean, own, other = of_pixels.chunk(3)
        slope = slope - (mean + 2 * shown * own + target * other) * (share / index.numel())
    return apart.abs().mean(), similar, slope


def _windowed(images: Annotated[Tensor, "C H W"], padding: int) -> Annotated[Tensor, "C h w"]:
    """Means under SSIM's window where it lies inside, with so many zeros around the images."""
    at = torch.arange(WINDOW, dtype=images.dtype, device=images.device) - WINDOW // 2
    weights = torch.softmax(-at.square() / (2 * WINDOW_SIGMA**2), 0)
    many = len(images)
    # One window a channel: torch's own kernels for that never round to TF32, which would lose the variances.
    down, across = (weights.view(1, 1, *shape).expand(many, -1, -1, -1) for shape in ((-1, 1), (1, -1)))
    columns = F.conv2d(images[None], down, padding=(padding, 0), groups=many)
    return F.conv2d(columns, across, padding=(0, padding), groups=many)[0]


def _camera(target: Target, numbers: Annotated[Tensor, "26"]) -> Pinhole:
    """A photograph's camera on the device, from its numbers there (see `camera_array`)."""
    turn = numbers[:9].view(3, 3)
    shift = numbers[9:12, None]
    focal = numbers[12:14]
    centre = numbers[14:16]
    last = torch.eye(4, dtype=numbers.dtype, device=numbers.device)[3:]
    pose = torch.cat([torch.cat([turn, shift], 1), last])
    intrinsics = torch.cat([torch.cat([focal.diag(), centre[:, None]], 1), last[:, 1:]])
    return Pinhole(intrinsics, pose, target.width, target.height, float(target.camera[23]))


def _here(values: Tensor) -> Floats:
    """A copy in host memory."""
    copied: Floats = values.detach().cpu().numpy().copy()
    return copied
