"""3D Gaussians to images, forward and backward, and image features back to Gaussians.

`rasterise_reference` defines what is computed, in plain torch; on the CPU in float32 compiled kernels do (`rasterise_kernels`).
These skip and count: Gaussians whose opacity stays below 1/255, behind the camera, outside the image, or not finite (exact:
the reference gives them nothing either), and what lies behind blocks of 4 x 4 pixels through which less than 1/1000 of the
light passes (an error of at most 1/1000 of the largest value). Their exponential errs by 1.1e-4 of alpha.
"""

# The checker takes compiled functions to have one argument.
# mypy: disable-error-code="call-arg, attr-defined"

from collections.abc import Mapping
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..errors import FprfError
from .backend import compiled
from .rasterise_reference import Pinhole, rasterise_reference, view_colours

__all__ = ["Pinhole", "Rasterised", "lift", "rasterise"]

_Array = np.ndarray[Any, Any]
_SKIPPED = ("faint", "behind", "outside", "invalid")


class Rasterised(NamedTuple):
    """A view of N Gaussians."""

    image: Annotated[Tensor, "H W 3"]
    """Colours from 0 on; more than 1 where the harmonics say so."""
    depth: Annotated[Tensor, "H W"]
    """World distance along the camera's z, the mean by weight; 0 where nothing is drawn."""
    opacity: Annotated[Tensor, "H W"]
    features: Annotated[Tensor, "H W C"]
    """Composited on zeros; C = 0 where none were given."""
    counts: Mapping[str, int]
    """Gaussians left out: faint, behind, outside, invalid; then entries (Gaussians times tiles) and saturated ones, skipped."""


class _View(NamedTuple):
    """A camera and the Gaussians it sees, as the kernels take them."""

    width: int
    height: int
    camera: _Array
    blocks: _Array
    bands: int
    total: int
    splats: _Array
    entries: Any
    counts: dict[str, int]

    @property
    def padded(self) -> tuple[int, int]:
        """Height and width in whole tiles."""
        return -(-self.height // 16) * 16, -(-self.width // 16) * 16


def rasterise(
    means: Annotated[Tensor, "N 3"],
    quaternions: Annotated[Tensor, "N 4"],
    log_scales: Annotated[Tensor, "N 3"],
    logits: Annotated[Tensor, "N"],
    harmonics: Annotated[Tensor, "N K 3"],
    camera: Pinhole,
    *,
    features: Annotated[Tensor, "N C"] | None = None,
    background: Annotated[Tensor, "3"] | None = None,
    antialiased: bool = False,
) -> Rasterised:
    """Render Gaussians: quaternions are wxyz of any length, scales natural logarithms, opacities logits, K 1, 4, 9 or 16.

    Every tensor has a gradient, through every output. Features must be finite. `antialiased` is for Gaussians trained that way;
    the background is black by default. Raises FprfError where shapes do not fit.
    """
    _check(means, quaternions, log_scales, logits, harmonics, features)
    features = means.new_zeros(len(means), 0) if features is None else features
    background = means.new_zeros(3) if background is None else background
    shape = (means, quaternions, log_scales)
    given = (*shape, logits, harmonics, features, background)
    counts: dict[str, int] = {}
    if _fits(*given):
        if torch.is_grad_enabled() and any(x.requires_grad for x in given):
            planes, passing, counts = _Rasterise.apply(*given, camera, antialiased)  # type: ignore[no-untyped-call]
        else:
            planes, passing, counts = _forward(_view(*shape, logits, harmonics, camera, antialiased), features, background)[:3]
    else:
        colours, fine = view_colours(means, harmonics, camera)
        logits = torch.where(fine, logits, torch.nan)  # what is not finite is not drawn
        behind = torch.cat([background, features.new_zeros(features.shape[1])])
        planes, passing = rasterise_reference(
            *shape, logits, torch.cat([colours, features], -1), camera, behind, antialiased=antialiased
        )
        planes = torch.cat([planes[..., :3], planes[..., -1:], planes[..., 3:-1]], -1)
    opacity = 1 - passing
    depth = planes[..., 3] / opacity.clamp_min(1e-6)  # a drawn alpha is at least 1/255
    return Rasterised(planes[..., :3], depth, opacity, planes[..., 4:], counts)


def lift(
    means: Annotated[Tensor, "N 3"],
    quaternions: Annotated[Tensor, "N 4"],
    log_scales: Annotated[Tensor, "N 3"],
    logits: Annotated[Tensor, "N"],
    camera: Pinhole,
    pixels: Annotated[Tensor, "H W C"],
    *,
    antialiased: bool = False,
) -> Annotated[Tensor, "N C"]:
    """Carry the features of pixels back to the Gaussians that show there, by their weights in the image: the transpose of
    rendering features. A channel of ones gives the sum of the weights. No gradients. Raises FprfError where shapes do not fit.
    """
    harmonics = means.new_zeros(len(means), 1, 3)
    _check(means, quaternions, log_scales, logits, harmonics, None)
    if pixels.shape[:2] != (camera.height, camera.width):
        raise FprfError(f"pixels {tuple(pixels.shape)}: a camera of {camera.height} x {camera.width} has other ones")
    pixels = pixels.detach()
    shape = (means.detach(), quaternions.detach(), log_scales.detach(), logits.detach())
    if _fits(*shape, pixels):
        lifted = _lifted(_view(*shape, harmonics, camera, antialiased), pixels)
    else:
        with torch.enable_grad():
            values = means.new_zeros(len(means), pixels.shape[-1], requires_grad=True)
            image, _ = rasterise_reference(*shape, values, camera, pixels.new_zeros(pixels.shape[-1]), antialiased=antialiased)
            (lifted,) = torch.autograd.grad((image[..., :-1] * pixels).sum(), values)
    return lifted


class _Rasterise(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quaternions: Tensor,
        log_scales: Tensor,
        logits: Tensor,
        harmonics: Tensor,
        features: Tensor,
        background: Tensor,
        camera: Pinhole,
        antialiased: bool,
    ) -> tuple[Tensor, Tensor, dict[str, int]]:
        view = _view(means, quaternions, log_scales, logits, harmonics, camera, antialiased)
        planes, passing, counts, groups = _forward(view, features, background)
        ctx.view, ctx.groups = view, groups
        ctx.save_for_backward(features, passing)
        return planes, passing, counts

    @staticmethod
    def backward(ctx: Any, grad: Tensor, grad_passing: Tensor, _: None) -> tuple[Tensor | None, ...]:
        features, passing = ctx.saved_tensors
        blocks, of_features = _backward(ctx.view, ctx.groups, features, grad, grad_passing)
        parts = (
            blocks[:, :3],
            blocks[:, 6:10],
            blocks[:, 3:6],
            blocks[:, 10],
            blocks[:, 11:].reshape(-1, ctx.view.bands, 3),
        )
        return *parts, of_features, (grad[..., :3] * passing[..., None]).sum((0, 1)), None, None


def _fits(*tensors: Tensor) -> bool:
    """Float32 on the CPU, and numba is installed."""
    return compiled() and all(x.device.type == "cpu" and x.dtype == torch.float32 for x in tensors)


def _check(
    means: Tensor, quaternions: Tensor, log_scales: Tensor, logits: Tensor, harmonics: Tensor, features: Tensor | None
) -> None:
    count, bands = len(means), harmonics.shape[1] if harmonics.dim() == 3 else 0
    wanted = [(count, 3), (count, 4), (count, 3), (count,), (count, bands, 3)]
    given = [tuple(x.shape) for x in (means, quaternions, log_scales, logits, harmonics)]
    if (
        given != wanted
        or bands not in (1, 4, 9, 16)
        or (features is not None and (features.dim() != 2 or len(features) != count))
    ):
        raise FprfError(
            f"Gaussians of shapes {given}: [N 3], [N 4], [N 3], [N], [N K 3] with K 1, 4, 9 or 16 and features [N C] fit"
        )


def camera_array(camera: Pinhole, antialiased: bool) -> _Array:
    """A camera as the kernels take it."""
    fx, fy, cx, cy = (float(camera.intrinsics[k]) for k in ((0, 0), (1, 1), (0, 2), (1, 2)))
    pose = camera.world_to_camera.double().cpu()
    limits = [
        -cx / fx - 0.15 * camera.width / fx,
        (camera.width - cx) / fx + 0.15 * camera.width / fx,
        -cy / fy - 0.15 * camera.height / fy,
        (camera.height - cy) / fy + 0.15 * camera.height / fy,
    ]
    turn, shift = pose[:3, :3], pose[:3, 3]
    place = [*turn.flatten().tolist(), *shift.tolist(), fx, fy, cx, cy, *(-turn.T @ shift).tolist()]
    return np.array([*place, *limits, camera.near, float(antialiased)], np.float32)


def _view(
    means: Tensor,
    quaternions: Tensor,
    log_scales: Tensor,
    logits: Tensor,
    harmonics: Tensor,
    camera: Pinhole,
    antialiased: bool,
) -> _View:
    from . import rasterise_kernels as kernels
    from .simd import aligned

    count, bands, seen = len(means), harmonics.shape[1], camera_array(camera, antialiased)
    blocks = aligned(-(-count // kernels.LANES) * kernels.LANES * (kernels.FIXED + 3 * bands))
    splats = aligned(-(-count // kernels.LANES) * kernels.LANES * kernels.SLOTS)
    plain = (x.detach().contiguous().numpy() for x in (means, quaternions, log_scales, logits, harmonics))
    kernels.pack(*plain, blocks)
    kernels.project(blocks, count, bands, seen, camera.width, camera.height, splats)
    entries = kernels.bins(splats, count, camera.width, camera.height)
    counts = dict(zip(_SKIPPED, entries.skipped.tolist(), strict=True)) | {"entries": len(entries.ids), "saturated": 0}
    return _View(camera.width, camera.height, seen, blocks, bands, count, splats, entries, counts)


def _groups(view: _View, features: Tensor) -> list[tuple[int, _Array, int, int]]:
    """Channels that are composited together: how many, the array that holds them, its stride and the first one."""
    padded = -(-features.shape[1] // 8) * 8
    values = torch.nn.functional.pad(features.detach(), (0, padded - features.shape[1])).contiguous().view(-1).numpy()
    return [(4, view.splats, 16, 6), *((8, values, padded, c) for c in range(0, padded, 8))]


def _forward(
    view: _View, features: Tensor, background: Tensor
) -> tuple[Tensor, Tensor, dict[str, int], list[tuple[_Array, _Array]]]:
    """Channels last: colour, depth, features; the transmittance left; counts; and planes and transmittance of each group."""
    from . import rasterise_kernels as kernels

    height, width = view.padded
    made: list[tuple[_Array, _Array]] = []
    saturated = 0
    for channels, values, stride, first in _groups(view, features):
        out, left = np.empty((channels, height, width), np.float32), np.empty((height, width), np.float32)
        behind = np.zeros(channels, np.float32)
        if not made:
            behind[:3] = background.detach().numpy()
        saturated = kernels.composite(
            channels, view.entries, view.splats, values, stride, first, behind, view.width, view.height,
            out.reshape(-1), left.reshape(-1),
        )  # fmt: skip
        made.append((out, left))
    planes = torch.cat([torch.from_numpy(out[:, : view.height, : view.width]) for out, _ in made])
    planes = planes[: 4 + features.shape[1]].permute(1, 2, 0)
    passing = torch.from_numpy(made[0][1][: view.height, : view.width].copy())
    return planes, passing, view.counts | {"saturated": int(saturated)}, made


def _backward(
    view: _View, made: list[tuple[_Array, _Array]], features: Tensor, grad: Tensor, grad_passing: Tensor
) -> tuple[Tensor, Tensor]:
    """Gradients [N 11+3K] of the parameters in the order of the blocks, and of the features."""
    from . import rasterise_gradient_kernels as kernels

    of_left = _planes(view, grad_passing[..., None])[0]
    groups = _groups(view, features)
    of_features = np.empty((view.total, 8 * (len(groups) - 1)), np.float32)
    total: _Array | None = None
    begin = 0
    for (channels, values, stride, first), (out, left) in zip(groups, made, strict=True):
        slope = _planes(view, grad[..., begin : begin + channels], channels)
        gradients = kernels.composite_back(
            channels, view.entries, view.splats, values, stride, first, view.width, view.height,
            out.reshape(-1), left.reshape(-1), slope.reshape(-1), of_left.reshape(-1),
        )  # fmt: skip
        begin += channels
        if total is None:
            total, of_left = gradients, np.zeros_like(of_left)
        else:
            total.reshape(-1, kernels.SUMS)[:-1, :6] += gradients.reshape(-1, kernels.SUMS)[:-1, :6]  # the last is spare
            kernels.lift_values(
                gradients, view.entries.first_slot, view.total, of_features.reshape(-1), of_features.shape[1], first, channels
            )
    assert total is not None
    blocks = np.empty_like(view.blocks)
    kernels.gradients(view.blocks, view.total, view.bands, view.camera, total, view.entries.first_slot, blocks)
    rows = torch.from_numpy(blocks).view(-1, 11 + 3 * view.bands, 16).transpose(1, 2).reshape(-1, 11 + 3 * view.bands)
    return rows[: view.total], torch.from_numpy(of_features)[:, : features.shape[1]]


def _planes(view: _View, pixels: Tensor, channels: int = 1) -> _Array:
    """Pixels [H W C] as planes [channels, H16, W16], zeros around."""
    height, width = view.padded
    out = np.zeros((channels, height, width), np.float32)
    out[: pixels.shape[2], : view.height, : view.width] = pixels.detach().permute(2, 0, 1).numpy()
    return out


def _lifted(view: _View, pixels: Tensor) -> Tensor:
    from . import rasterise_gradient_kernels as kernels

    channels = pixels.shape[-1]
    # Sixteen channels fill the sums of an entry, and cost little more than eight: Gaussians are found, and entries read, once.
    parts = [(first, 16 if channels - first > 8 else 8) for first in range(0, channels, 16)]
    out = np.empty((view.total, sum(parts[-1]) if parts else 0), np.float32)
    for first, size in parts:
        slope = _planes(view, pixels[..., first : first + size], size)
        sums = kernels.lift(size, view.entries, view.splats, view.width, view.height, slope.reshape(-1))
        kernels.lift_values(sums, view.entries.first_slot, view.total, out.reshape(-1), out.shape[1], first, size, skipped=0)
    return torch.from_numpy(out)[:, :channels]
