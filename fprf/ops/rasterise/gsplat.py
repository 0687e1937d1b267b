"""3D Gaussians on a CUDA device by gsplat (Ye et al. 2025): drawn with gradients, and trained.

gsplat computes what `rasterise_reference` defines, with two differences: it cuts alphas at 0.999 instead of 0.99, and a ray
ends where 1/10000 of the light is left. It is imported when something is drawn, never before. N, K, C, H, W and R are those
of `rendering` and `training`.
"""

import functools
import importlib.util
import math
from typing import Annotated, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..photometric import WINDOW
from ..simd import LANES
from . import BLUR
from .forward_kernels import SIDE
from .layout import FIXED
from .reference import Pinhole
from .training import LOG_SCALES, Floats, Learnt, Target, TrainableGaussians

_MOST_LOG, _LARGE = 30.0, 1e15
"""Bounds of logarithms and logits, and of means and quaternions, as in `rasterise_reference`."""
_BETAS, _EPS = (0.9, 0.99), 1e-15
"""Decay of Adam's moments, and what keeps 0 / 0 from being NaN: those of `backward_kernels`."""
_COLUMNS = 3, 3, 4, 1
"""Columns of means, logarithms of scales, quaternions and logits; those of the harmonics follow."""
_SIGMA, _C1, _C2 = 1.5, 0.01**2, 0.03**2
"""SSIM: standard deviation of its window in pixels, and its two constants for colours in [0, 1]."""


def usable(device: torch.device) -> bool:
    """True where gsplat draws on this device."""
    return device.type == "cuda" and obstacle(device) is None


@functools.cache
def obstacle(device: torch.device) -> str | None:
    """The reason why gsplat can't draw on a CUDA device; None where it has drawn a Gaussian there.

    gsplat compiles its kernels at the first use where its wheel has none, which takes minutes and CUDA's toolkit.
    """
    if importlib.util.find_spec("gsplat") is None:
        return "gsplat is not installed; `pip install 'fprf[cuda]'` installs it"
    camera = Pinhole(torch.eye(3), torch.eye(4), SIDE, SIDE)
    try:
        with torch.inference_mode(False), torch.enable_grad():
            means = torch.ones(1, 3, device=device, requires_grad=True)
            rest = (torch.ones(1, 4, device=device), torch.zeros(1, 3, device=device), torch.zeros(1, device=device))
            values, background = torch.ones(1, 3, device=device), torch.zeros(3, device=device)
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
    """Composited values, the composited depth behind them, and the transmittance left, float32: as `rasterise_reference`."""
    camera = camera._replace(intrinsics=camera.intrinsics.to(means), world_to_camera=camera.world_to_camera.to(means))
    shape = means, log_scales, quaternions, logits[:, None]
    image, opacity, _ = _render(shape, values, camera, background, antialiased=antialiased, mode="RGB+D")
    return image, 1 - opacity


def _render(
    shape: tuple[Tensor, ...],
    values: Annotated[Tensor, "N C"] | Annotated[Tensor, "N K 3"],
    camera: Pinhole,
    background: Annotated[Tensor, "C"],
    *,
    antialiased: bool,
    mode: Literal["RGB", "RGB+D"],
) -> tuple[Annotated[Tensor, "H W C"], Annotated[Tensor, "H W"], Annotated[Tensor, "N"]]:
    """Image, opacity, and which Gaussians lie in view, for parameters in the order of `_COLUMNS`; values [N K 3] are harmonics.

    What is not finite, or far beyond everything, is not drawn: it would spoil the gradients of all others.
    """
    from gsplat import rasterization

    means, log_scales, quaternions, logits = shape
    # Harmless numbers take the place of what is not drawn: at the origin, and transparent.
    size = quaternions.detach().norm(dim=1, keepdim=True)
    fine = (means.abs() < _LARGE).all(1, keepdim=True) & (size < _LARGE) & values.isfinite().flatten(1).all(1, keepdim=True)
    fine = fine & ~torch.cat([log_scales, logits], 1).isnan().any(1, keepdim=True)
    means = torch.where(fine, means, 0.0)
    upright = torch.eye(4, dtype=means.dtype, device=means.device)[:1]  # also where a quaternion has no length
    quaternions = torch.where(fine & (size > 0), quaternions, upright)
    scales = torch.where(fine, log_scales, 0.0).clamp(-_MOST_LOG, _MOST_LOG).exp()
    opacities = torch.where(fine, logits, -_MOST_LOG).clamp(-_MOST_LOG, _MOST_LOG).sigmoid()
    values = torch.where(fine[..., None] if values.dim() == 3 else fine, values, 0.0)
    image, opacity, about = rasterization(
        means=means,
        quats=quaternions,
        scales=scales,
        opacities=opacities[:, 0],
        colors=values,
        viewmats=camera.world_to_camera[None],
        Ks=camera.intrinsics[None],
        width=camera.width,
        height=camera.height,
        near_plane=camera.near,
        eps2d=BLUR,
        sh_degree=math.isqrt(values.shape[1]) - 1 if values.dim() == 3 else None,
        packed=False,
        backgrounds=background[None],
        render_mode=mode,
        rasterize_mode="antialiased" if antialiased else "classic",
    )
    return image[0], opacity[0, ..., 0], (about["radii"][0] > 0).all(-1)


class GsplatGaussians:
    """`TrainableGaussians` on a device, drawn by gsplat: the same methods, parameters, loss and optimiser.

    Whoever calls gives and gets arrays of host memory. A step waits for the device where gsplat does, and once for its figures.
    """

    def __init__(self, room: int, bands: int, device: torch.device) -> None:
        self.bands, self.rows, self.device = bands, FIXED + 3 * bands, device
        self.count = 0
        self._values, self._first, self._second = (torch.zeros(room, self.rows, device=device) for _ in range(3))
        self._weight = torch.zeros(room, device=device)

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

    def read(self, columns: slice = slice(None), index: NDArray[np.int64] | None = None) -> Annotated[Floats, "M c"]:
        """A copy of some columns of the parameters, of all Gaussians or of some."""
        found = self._values[: self.count, columns] if index is None else self._values[self._there(index), columns]
        return _here(found)

    def moments(self) -> tuple[Annotated[Floats, "N R"], Annotated[Floats, "N R"], Annotated[Floats, "N"]]:
        """Copies of the first moments, the second ones, and the weights in the second."""
        return _here(self._first[: self.count]), _here(self._second[: self.count]), _here(self._weight[: self.count])

    def multiply(self, columns: slice, factor: float) -> None:
        """Multiply columns of the parameters of all Gaussians."""
        self._values[: self.count, columns] *= factor

    def limit_scales(self, most: Annotated[Floats, "M"], index: NDArray[np.int64] | None = None) -> None:
        """Cut logarithms of standard deviations that are above `most`, of all Gaussians or of some."""
        limit = self._there(most)[:, None]
        if index is None:
            scales = self._values[: self.count, LOG_SCALES]
            torch.minimum(scales, limit, out=scales)
        else:
            some = self._there(index)
            self._values[some, LOG_SCALES] = torch.minimum(self._values[some, LOG_SCALES], limit)

    def split(
        self, index: NDArray[np.int64], to: NDArray[np.int64], one: Annotated[Floats, "M R"], other: Annotated[Floats, "M R"]
    ) -> None:
        """As `TrainableGaussians.split`: `one` in the place of M Gaussians, `other` to `to`; both begin without a first moment
        and with half of the second."""
        places, others = self._there(index), self._there(to)
        self._values[places], self._values[others] = self._there(one), self._there(other)
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
        """As `TrainableGaussians.learn`: render, compare, move by a step of Adam; nothing where the loss is not finite."""
        # One copy takes all numbers of the step to the device.
        exposure = np.ones(3, np.float32) if factors is None else factors
        numbers = self._there(np.concatenate([target.camera, background, exposure, rates]).astype(np.float32))
        seen_from, colour, exposed, rate = torch.split(numbers, [len(target.camera), 3, 3, self.rows])
        photograph, valid = self._image(target, target.planes), target.valid
        camera = _camera(target, seen_from)
        pose, rows = camera.world_to_camera.requires_grad_(), self._values[: self.count].detach().requires_grad_()
        image, seen = self._drawn(rows, camera, colour, antialiased=bool(target.camera[24]))
        # The loss and its slope by every pixel, then by parameters and pose.
        shown = (image.detach() * exposed).permute(2, 0, 1)
        l1, similar, slope = photometric_loss(shown, photograph, ssim)
        if valid is not None:
            slope = slope * self._image(target, valid)
        # Of a factor e^g the slope by g is that by the render times the render.
        pull = (slope * shown).sum((1, 2))
        of_rows, of_pose = torch.autograd.grad(image, [rows, pose], slope.permute(1, 2, 0) * exposed)
        self._adam(of_rows, seen & (l1 + similar).isfinite(), rate)
        # A turn w about the camera's own axes moves the pose [R t] by -[w]x [R t]; a shift c of its centre moves t by -R c.
        moment = of_pose[:3] @ pose.detach()[:3].T
        of_turn = torch.stack([moment[1, 2] - moment[2, 1], moment[2, 0] - moment[0, 2], moment[0, 1] - moment[1, 0]])
        of_shift = -pose.detach()[:3, :3].T @ of_pose[:3, 3]
        measured = torch.stack([l1, similar, (shown - photograph).square().mean()])
        found = _here(torch.cat([measured, pull, of_turn, of_shift]))  # the step's one wait
        if not np.isfinite(found[:2]).all():
            return Learnt(float(found[0]), float(found[1]), np.nan, np.zeros(3, np.float32), np.zeros(6))
        of_exposure = np.zeros(3, np.float32) if factors is None else found[3:6]
        return Learnt(float(found[0]), float(found[1]), float(found[2]), of_exposure, found[6:].astype(np.float64))

    def _adam(self, gradient: Annotated[Tensor, "N R"], seen: Annotated[Tensor, "N"], rates: Annotated[Tensor, "R"]) -> None:
        """Move all of a block of LANES where one was seen, as `backward_kernels.adam`; moments of others stay."""
        values, first, second, weight = (part[: self.count] for part in (self._values, self._first, self._second, self._weight))
        # Masks that are multiplied with, not indexed by: the host need not know how many there are.
        blocks = torch.nn.functional.pad(seen, (0, -len(seen) % LANES)).view(-1, LANES)
        seen = blocks.any(1).repeat_interleave(LANES)[: len(seen)]
        seen = (seen & gradient.isfinite().all(1))[:, None]
        gradient = torch.where(seen, gradient, 0.0)
        share = seen.to(values.dtype)
        weight.lerp_(torch.ones_like(weight), (1 - _BETAS[1]) * share[:, 0])
        first.lerp_(gradient, (1 - _BETAS[0]) * share)
        second.lerp_(gradient.square(), (1 - _BETAS[1]) * share)
        size = (second / weight[:, None].clamp_min(1 - _BETAS[1])).sqrt() + _EPS  # a weight is at least that where seen
        values.sub_(torch.where(seen, rates * first / size, 0.0))

    @torch.no_grad()
    def errors(
        self, target: Target, background: tuple[float, float, float], factors: Annotated[Floats, "3"] | None = None
    ) -> Annotated[Floats, "N 3"]:
        """As `TrainableGaussians.errors`: each Gaussian's weight times |render - photograph|, in sky, and of all."""
        exposure = np.ones(3, np.float32) if factors is None else factors
        numbers = self._there(np.concatenate([target.camera, background, exposure]).astype(np.float32))
        seen_from, colour, exposed = torch.split(numbers, [len(target.camera), 3, 3])
        camera, antialiased = _camera(target, seen_from), bool(target.camera[24])
        image, _ = self._drawn(self._values[: self.count], camera, colour, antialiased=antialiased)
        apart = ((image * exposed).permute(2, 0, 1) - self._image(target, target.planes)).abs()
        if target.valid is not None:
            apart = apart * self._image(target, target.valid)
        whole = torch.ones_like(apart[0])
        sky = torch.zeros_like(whole) if target.sky is None else self._image(target, target.sky)[0]
        pixels = torch.stack([apart.sum(0), sky, whole], -1)
        # Rendering is linear in the values, so their gradient for given pixels is its transpose.
        with torch.enable_grad():
            lifted = torch.zeros(self.count, 3, device=self.device, requires_grad=True)
            shape = torch.split(self._values[: self.count], [*_COLUMNS, 3 * self.bands], 1)[:4]
            back, _, _ = _render(shape, lifted, camera, torch.zeros_like(colour), antialiased=antialiased, mode="RGB")
            return _here(torch.autograd.grad(back, lifted, pixels)[0])

    def _drawn(
        self, rows: Annotated[Tensor, "N R"], camera: Pinhole, background: Annotated[Tensor, "3"], *, antialiased: bool
    ) -> tuple[Annotated[Tensor, "H W 3"], Annotated[Tensor, "N"]]:
        """What a camera sees of the Gaussians of these rows, and which of them lie in view."""
        *shape, harmonics = torch.split(rows, [*_COLUMNS, 3 * self.bands], 1)
        colours = harmonics.reshape(-1, self.bands, 3)
        image, _, seen = _render(tuple(shape), colours, camera, background, antialiased=antialiased, mode="RGB")
        return image, seen

    def _image(self, target: Target, planes: Floats) -> Annotated[Tensor, "C H W"]:
        """Planes of whole tiles, as the kernels of the CPU take them, as an image on the device."""
        wide = -(-target.width // SIDE) * SIDE
        # What lies behind the last plane, for the vectors of the CPU, is less than a plane.
        padded = planes[: len(planes) // target.area * target.area].reshape(-1, target.area // wide, wide)
        return self._there(padded)[:, : target.height, : target.width]

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
    """Mean |shown - target|, mean SSIM, and the slope of (1 - share) L1 + share (1 - SSIM): `photometric.loss`, in torch.

    SSIM counts as 0, without a slope, where `share` is 0 and where the image is smaller than a window.
    """
    with torch.enable_grad():
        shown = shown.detach().requires_grad_()
        l1, similar = (shown - target).abs().mean(), shown.new_zeros(())
        if share > 0 and min(shown.shape[1:]) >= WINDOW:
            # One window a channel: torch's own kernels for that never round to TF32, which would lose the variances.
            at = torch.arange(WINDOW, dtype=shown.dtype, device=shown.device) - WINDOW // 2
            weights = torch.softmax(-at.square() / (2 * _SIGMA**2), 0)
            images = torch.cat([shown, target, shown.square(), target.square(), shown * target])[None]
            many = images.shape[1]
            images = torch.conv2d(images, weights.view(1, 1, -1, 1).expand(many, -1, -1, -1), groups=many)
            images = torch.conv2d(images, weights.view(1, 1, 1, -1).expand(many, -1, -1, -1), groups=many)
            ma, mb, aa, bb, ab = images[0].chunk(5)
            # Wang et al. 2004, Eq. 13, of the windows that lie inside.
            above = (2 * ma * mb + _C1) * (2 * (ab - ma * mb) + _C2)
            below = (ma.square() + mb.square() + _C1) * (aa - ma.square() + bb - mb.square() + _C2)
            similar = (above / below).mean()
        (slope,) = torch.autograd.grad((1 - share) * l1 + share * (1 - similar), shown)
    return l1.detach(), similar.detach(), slope


def _camera(target: Target, numbers: Annotated[Tensor, "25"]) -> Pinhole:
    """A photograph's camera on the device, from its numbers there (see `camera_array`)."""
    turn, shift, focal, centre = numbers[:9].view(3, 3), numbers[9:12, None], numbers[12:14], numbers[14:16]
    last = torch.eye(4, dtype=numbers.dtype, device=numbers.device)[3:]
    pose = torch.cat([torch.cat([turn, shift], 1), last])
    intrinsics = torch.cat([torch.cat([focal.diag(), centre[:, None]], 1), last[:, 1:]])
    return Pinhole(intrinsics, pose, target.width, target.height, float(target.camera[23]))


def _here(values: Tensor) -> Floats:
    """A copy in host memory."""
    copied: Floats = values.detach().cpu().numpy().copy()
    return copied
