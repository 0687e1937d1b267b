"""3D Gaussians to images, forward and backward, and image features back to Gaussians.

N Gaussians, K harmonics of a colour channel (1, 4, 9 or 16), C feature channels, H W pixels; H16 W16 whole
tiles of them.

`rasterise_reference` defines what is computed, in plain torch, for every device and dtype. On the CPU in
float32 compiled kernels do (`layout`, `forward_kernels`, `backward_kernels`), by the steps below; on CUDA in
float32 gsplat does, where it is installed (`gsplat`).

    project     mean -> image position and depth, Sigma' = J W Sigma W^T J^T + 0.3 I, colour from its harmonics
    bin         every Gaussian into the tiles of 16 x 16 pixels that it reaches, each tile sorted by depth
    composite   C = sum_i c_i alpha_i T_i + T_N background,  T_i = prod_j<i (1 - alpha_j),  front to back, tile by tile
    back        the same tiles, front to back again, with what is still behind: dL/d ln alpha and dL/dc, then back to parameters

These skip and count: Gaussians whose opacity stays below 1/255, behind the camera, outside the image, or not
finite (exact: the reference gives them nothing either), and what lies behind blocks of 4 x 4 pixels through
which less than 1/1000 of the light passes (an error of at most 1/1000 of the largest value). Their
exponential errs by 1.1e-4 of alpha.
"""

# The checker takes compiled functions to have one argument.
# mypy: disable-error-code="call-arg, attr-defined"

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ...errors import FprfError
from ..backend import compiled, compiled_for
from .reference import Pinhole, rasterise_reference, view_colours

if TYPE_CHECKING:
    from .forward_kernels import Channels

__all__ = ["Pinhole", "Rasterised", "lift", "rasterise"]

_Array = np.ndarray[Any, Any]
_SKIPPED = ("faint", "behind", "outside", "invalid")
_WIDE = 8
"""Feature channels that the kernels composite at once."""
_MIN_PIXEL_OPACITY = 1e-6
"""Of a pixel, below which its depth is 0: a drawn alpha is at least 1/255."""


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
    """Gaussians left out: faint, behind, outside, invalid; then entries (Gaussians times tiles) and saturated
    ones, skipped.
    """


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
    """Render Gaussians: quaternions are wxyz of any length, scales natural logarithms, opacities logits, K 1,
    4, 9 or 16.

    Every tensor has a gradient, through every output. Features must be finite. `antialiased` is for Gaussians
    trained that way; the background is black by default. Raises FprfError where shapes do not fit.
    """
    _check(means, quaternions, log_scales, logits, harmonics, features)
    features = means.new_zeros(len(means), 0) if features is None else features
    background = means.new_zeros(3) if background is None else background
    shape = (means, quaternions, log_scales)
    given = (*shape, logits, harmonics, features, background)
    counts: dict[str, int] = {}
    if not compiled_for(*given):
        colours, fine = view_colours(means, harmonics, camera)
        logits = torch.where(fine, logits, torch.nan)  # what is not finite is not drawn
        behind = torch.cat([background, features.new_zeros(features.shape[1])])
        planes, passing = _form(*given)(
            *shape, logits, torch.cat([colours, features], -1), camera, behind, antialiased=antialiased
        )
        # In the kernels' order: colour, depth, features.
        planes = torch.cat([planes[..., :3], planes[..., -1:], planes[..., 3:-1]], -1)
    elif torch.is_grad_enabled() and any(x.requires_grad for x in given):
        planes, passing, counts = _Rasterise.apply(*given, camera, antialiased)  # type: ignore[no-untyped-call]
    else:
        planes, passing, counts, _ = _composite(
            _view(*shape, logits, harmonics, camera, antialiased), features, background
        )
    # The mean depth by weight.
    opacity = 1 - passing
    depth = planes[..., 3] / opacity.clamp_min(_MIN_PIXEL_OPACITY)
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
    """Carry the features of pixels back to the Gaussians that show there, by their weights in the image: the
    transpose of rendering features. A channel of ones gives the sum of the weights. No gradients. Raises
    FprfError where shapes do not fit.
    """
    harmonics = means.new_zeros(len(means), 1, 3)
    _check(means, quaternions, log_scales, logits, harmonics, None)
    if pixels.shape[:2] != (camera.height, camera.width):
        raise FprfError(
            f"pixels {tuple(pixels.shape)}: a camera of {camera.height} x {camera.width} has other ones"
        )
    channels = pixels.shape[-1]
    pixels = pixels.detach()
    shape = (means.detach(), quaternions.detach(), log_scales.detach(), logits.detach())
    if not compiled_for(*shape, pixels):
        # Rendering is linear in the values, so their gradient for given pixels is its transpose.
        with torch.inference_mode(False), torch.enable_grad():
            # Tensors of inference can't take part in a gradient: copies can.
            pixels = pixels.clone()
            centres, turns, sizes, densities = (each.clone() for each in shape)
            values = centres.new_zeros(len(centres), channels, requires_grad=True)
            image, _ = _form(*shape, pixels)(
                centres,
                turns,
                sizes,
                densities,
                values,
                camera,
                pixels.new_zeros(channels),
                antialiased=antialiased,
            )
            (lifted,) = torch.autograd.grad((image[..., :-1] * pixels).sum(), values)
        return lifted
    from . import backward_kernels as kernels

    tiles = _view(*shape, harmonics, camera, antialiased).tiles
    # Sixteen channels fill the sums of an entry, and cost little more than eight: Gaussians are found, and
    # entries read, once.
    parts = [(first, 16 if channels - first > 8 else 8) for first in range(0, channels, 16)]
    out = np.empty((len(means), sum(parts[-1]) if parts else 0), np.float32)
    for first, size in parts:
        sums = kernels.lift(tiles, size, _planes(tiles, pixels[..., first : first + size], size).reshape(-1))
        kernels.lift_values(tiles, sums, out.reshape(-1), out.shape[1], first, size, skipped=0)
    return torch.from_numpy(out)[:, :channels]


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
        planes, passing, counts, made = _composite(view, features, background)
        ctx.view = view
        ctx.made = made
        ctx.save_for_backward(features, passing)
        return planes, passing, counts

    @staticmethod
    def backward(ctx: Any, grad: Tensor, grad_passing: Tensor, _: None) -> tuple[Tensor | None, ...]:
        from . import backward_kernels as kernels

        (tiles, blocks, bands, camera, _) = ctx.view
        (features, passing) = ctx.saved_tensors
        # Of the first group the sums of the shape, with the gradient of the transmittance, which is to be
        # counted once.
        of_left = _planes(tiles, grad_passing[..., None], 1)[0]
        of_features = np.empty((tiles.total, features.shape[1] + -features.shape[1] % _WIDE), np.float32)
        total = None
        begin = 0
        for channels, (out, left) in zip(_groups(ctx.view, features), ctx.made, strict=True):
            slope = _planes(tiles, grad[..., begin : begin + channels.number], channels.number)
            begin += channels.number
            sums = kernels.composite_back(
                tiles, channels, out.reshape(-1), left.reshape(-1), slope.reshape(-1), of_left.reshape(-1)
            )
            if total is None:
                total = sums
                of_left = np.zeros_like(of_left)
            else:
                # Features move alphas as colours do; the last slot is spare.
                total.reshape(-1, kernels.SUMS)[:-1, :6] += sums.reshape(-1, kernels.SUMS)[:-1, :6]
                kernels.lift_values(
                    tiles,
                    sums,
                    of_features.reshape(-1),
                    of_features.shape[1],
                    channels.first,
                    channels.number,
                )
        # From sums over pixels to the parameters, in blocks; then a row a Gaussian.
        assert total is not None
        slopes = np.empty_like(blocks)
        kernels.gradients(tiles, blocks, bands, camera, total, slopes)
        rows = (
            torch.from_numpy(slopes)
            .view(-1, 11 + 3 * bands, 16)
            .transpose(1, 2)
            .reshape(-1, 11 + 3 * bands)[: tiles.total]
        )
        shape = rows[:, :3], rows[:, 6:10], rows[:, 3:6], rows[:, 10], rows[:, 11:].reshape(-1, bands, 3)
        of_background = (grad[..., :3] * passing[..., None]).sum((0, 1))
        return *shape, torch.from_numpy(of_features)[:, : features.shape[1]], of_background, None, None


def _form(*tensors: Tensor) -> Callable[..., tuple[Tensor, Tensor]]:
    """The rasteriser of tensors that are not the CPU kernels': gsplat for float32 where it works, else the
    plain form.
    """
    device = tensors[0].device
    if compiled() and device.type == "cuda" and all(x.dtype == torch.float32 for x in tensors):
        from .gsplat import rasterise_gsplat, usable

        if usable(device):
            return rasterise_gsplat
    return rasterise_reference


def _check(
    means: Tensor,
    quaternions: Tensor,
    log_scales: Tensor,
    logits: Tensor,
    harmonics: Tensor,
    features: Tensor | None,
) -> None:
    count = len(means)
    bands = harmonics.shape[1] if harmonics.dim() == 3 else 0
    wanted = [(count, 3), (count, 4), (count, 3), (count,), (count, bands, 3)]
    given = [tuple(x.shape) for x in (means, quaternions, log_scales, logits, harmonics)]
    fit = features is None or (features.dim() == 2 and len(features) == count)
    if given != wanted or bands not in (1, 4, 9, 16) or not fit:
        raise FprfError(
            f"Gaussians of shapes {given}: [N 3], [N 4], [N 3], [N], [N K 3] with K 1, 4, 9 or 16 and features [N C] fit"
        )


class _View(NamedTuple):
    """A camera and the Gaussians it sees, as the kernels take them."""

    tiles: Any
    blocks: _Array
    bands: int
    camera: _Array
    counts: dict[str, int]


def _view(
    means: Tensor,
    quaternions: Tensor,
    log_scales: Tensor,
    logits: Tensor,
    harmonics: Tensor,
    camera: Pinhole,
    antialiased: bool,
) -> _View:
    from ..simd import LANES, aligned
    from . import forward_kernels as kernels
    from .layout import FIXED, pack
    from .tile_kernels import SLOTS
    from .training import camera_array

    # The kernels read blocks of LANES Gaussians, property by property; the last block is padded.
    bands = harmonics.shape[1]
    seen = camera_array(camera, antialiased)
    whole = -(-len(means) // LANES) * LANES
    blocks = aligned(whole * (FIXED + 3 * bands))
    splats = aligned(whole * SLOTS)
    pack(
        *(x.detach().contiguous().numpy() for x in (means, quaternions, log_scales, logits, harmonics)),
        blocks,
    )
    # Project all Gaussians, leave out what cannot be seen, and list for each tile of 16 x 16 pixels those on
    # it by depth.
    tiles = kernels.see(blocks, len(means), bands, seen, camera.width, camera.height, splats)
    counts = dict(zip(_SKIPPED, tiles.skipped.tolist(), strict=True)) | {
        "entries": len(tiles.ids),
        "saturated": 0,
    }
    return _View(tiles, blocks, bands, seen, counts)


def _groups(view: _View, features: Tensor) -> "list[Channels]":
    """Channels that are composited together: colour and depth, which lie in the splats; then features, in
    groups of 8, padded with zeros.
    """
    from .forward_kernels import Channels

    padded = features.shape[1] + -features.shape[1] % _WIDE
    values = (
        torch.nn.functional.pad(features.detach(), (0, padded - features.shape[1]))
        .contiguous()
        .view(-1)
        .numpy()
    )
    groups = [Channels(4, view.tiles.splats, 16, 6)]
    for first in range(0, padded, _WIDE):
        groups.append(Channels(_WIDE, values, padded, first))
    return groups


def _composite(
    view: _View, features: Tensor, background: Tensor
) -> tuple[Tensor, Tensor, dict[str, int], list[tuple[_Array, _Array]]]:
    """Channels last: colour, depth, features; the transmittance left; counts; and planes and transmittance of
    each group.
    """
    from . import forward_kernels as kernels

    # One pass over the sorted lists of Gaussians for each group of channels: a kernel composites 4 or 8 at a
    # time, and the transmittance is the same in all.
    tiles = view.tiles
    made: list[tuple[_Array, _Array]] = []
    saturated = 0
    for channels in _groups(view, features):
        out = np.empty((channels.number, *_padded(tiles)), np.float32)
        left = np.empty(_padded(tiles), np.float32)
        behind = np.zeros(channels.number, np.float32)
        if not made:  # colour and depth come first; only colour has a background
            behind[:3] = background.detach().numpy()
        saturated = kernels.composite(tiles, channels, behind, out.reshape(-1), left.reshape(-1))
        made.append((out, left))
    # Off with the margin of whole tiles and the padding of the last group; the arrays in `made` keep both for
    # gradients.
    planes = torch.cat([torch.from_numpy(out[:, : tiles.height, : tiles.width]) for out, _ in made])
    planes = planes[: 4 + features.shape[1]].permute(1, 2, 0)
    passing = torch.from_numpy(made[0][1][: tiles.height, : tiles.width].copy())
    return planes, passing, view.counts | {"saturated": int(saturated)}, made


def _padded(tiles: Any) -> tuple[int, int]:
    """Height and width of an image in whole tiles."""
    return -(-tiles.height // 16) * 16, -(-tiles.width // 16) * 16


def _planes(tiles: Any, pixels: Tensor, channels: int) -> _Array:
    """Pixels [H W C] as planes [channels, H16, W16], zeros around."""
    out = np.zeros((channels, *_padded(tiles)), np.float32)
    out[: pixels.shape[2], : tiles.height, : tiles.width] = pixels.detach().permute(2, 0, 1).numpy()
    return out
