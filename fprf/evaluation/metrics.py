"""Renders against photographs and each other: PSNR, SSIM, LPIPS and consistency of images [H W 3] in [0, 1];
`fprf eval`.

PSNR = -10 log10(mean squared error), in decibels. SSIM after Wang et al. 2004: Gaussian window of 11 pixels
(σ 1.5), K = (0.01, 0.03), dynamic range 1, mean over channels and over the windows that lie wholly inside.
LPIPS 0.1 with AlexNet (Zhang et al. 2018, arXiv:1801.03924), with the weights of its authors:

    LPIPS(a, b) = Σ_layers mean over pixels of Σ_channels w_c (f_c(a) / |f(a)| - f_c(b) / |f(b)|)²

f: activations of the five convolutions, w ≥ 0: the learned heads. 0 for equal images, about 0.7 for unrelated
ones.

Consistency of views: a pixel p of view a is lifted to the world by a's depth and looked up in view b, at p'.
It counts where b sees the same place: inside b's frame, in front of it, and at the depth that b itself has
there (occlusion).

    RMSE = sqrt( Σ_pairs Σ_valid |I_a(p) - I_b(p')|² / (3 Σ_pairs #valid) )

Relative to the contrast of what was compared (a dull image scores well for nothing) it is 0 for perfect
agreement, sqrt(2) for unrelated colours.
"""

import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import torch
import torch.nn.functional as F
from kornia.metrics import ssim as _ssim_map
from torch import Tensor

from ..datamanagers.images import Image
from ..datamanagers.scene import ParsedScene
from ..errors import DataError, NumericsError
from ..io.images import to_uint8
from ..memory import peak
from ..plugins.weights import read_weights
from ..rendering.cameras import Cameras, grid_rays, look_up, project
from ..scenes import Scene
from ..training.run import Known
from ..types import View

PSNR_CAP = 99.0
"""PSNR of identical images, in dB: means over views stay finite. Reached at a mean squared error of
1.3e-10.
"""

_SSIM_WINDOW_PIXELS = 11
"""Side of SSIM's window (Wang et al. 2004)."""
_LPIPS_WEIGHTS = Path(__file__).parent / "weights" / "lpips-alex.safetensors"
_ALEXNET_STRIDES = (4, 1, 1, 1, 1)
"""Of its five convolutions."""
_ALEXNET_PADS = (2, 2, 1, 1, 1)
"""Of its five convolutions."""
_ALEXNET_POOLED = (2, 3)
"""Convolutions after a pooling."""
_IMAGENET_MEAN = (-0.030, -0.088, -0.188)
"""Of colours in [-1, 1], as LPIPS has it."""
_IMAGENET_DEVIATION = (0.458, 0.448, 0.450)
"""Of colours in [-1, 1], as LPIPS has it."""
_LPIPS_EPS = 1e-10
"""Added to lengths, as the authors do: a feature may be 0."""
_MIN_LPIPS_SIDE_PIXELS = 31
"""Pixels of a side that the second pooling leaves one of."""
_MAX_DISTANCE_SHARE = 0.02
"""Share of the distance below which two surfaces count as one. Bilinear depth on a slope is off by far
less. By eye.
"""


def _pair(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """Both images as they are compared: on one device, in float32 at least. Raises DataError for unlike
    shapes.
    """
    if a.shape != b.shape or a.ndim != 3 or a.shape[-1] != 3 or a.numel() == 0:
        raise DataError(
            f"images of shape {tuple(a.shape)} and {tuple(b.shape)} cannot be compared; both must be [H W 3] of one size"
        )
    kind = torch.promote_types(torch.promote_types(a.dtype, b.dtype), torch.float32)
    return a.detach().to(kind), b.detach().to(a.device, kind)


def _finite(name: str, value: float) -> float:
    if not math.isfinite(value):
        raise NumericsError(
            f"{name} is {value}: an image holds values that are not finite, or nothing of it counts"
        )
    return value


def psnr(a: Annotated[Tensor, "H W 3"], b: Annotated[Tensor, "H W 3"]) -> float:
    """Peak signal-to-noise ratio in dB, at most `PSNR_CAP`; symmetric. Raises NumericsError for NaN and
    infinities.
    """
    first, second = _pair(a, b)
    error = _finite("psnr", float((first - second).square().mean()))
    if error > 0:
        return min(PSNR_CAP, -10 * math.log10(error))
    return PSNR_CAP


def ssim(
    a: Annotated[Tensor, "H W 3"],
    b: Annotated[Tensor, "H W 3"],
    where: Annotated[Tensor, "H W"] | None = None,
) -> float:
    """Structural similarity in [-1, 1], 1 for identical images; symmetric. Of windows about `where` alone, if
    given.

    An image with a side below 11 pixels is judged with the largest odd window that fits. Raises as `psnr`.
    """
    first, second = _pair(a, b)
    # The window must be odd, and fit.
    shortest = min(first.shape[:2])
    window = min(_SSIM_WINDOW_PIXELS, shortest - 1 + shortest % 2)
    x = first.permute(2, 0, 1)[None]
    y = second.permute(2, 0, 1)[None]
    # No eps: K keeps the denominator above 9e-8, and kornia's 1e-12 would cost black images 1e-5.
    windows = _ssim_map(x, y, window, eps=0.0, padding="valid")
    if where is not None:
        # Windows stand at the pixels in their middle, without a rim.
        edge = window // 2
        about = where[edge : edge + windows.shape[2], edge : edge + windows.shape[3]]
        if bool(about.any()):
            windows = windows[..., about]
        else:
            windows = windows
    # Rounding can carry an identical pair past 1.
    return max(-1.0, min(1.0, _finite("ssim", float(windows.mean()))))


@torch.no_grad()
def lpips(
    a: Annotated[Tensor, "H W 3"],
    b: Annotated[Tensor, "H W 3"],
    where: Annotated[Tensor, "H W"] | None = None,
) -> float:
    """LPIPS of sRGB images in [0, 1], at least 0, symmetric; `where`: mean over the cells that lie there, by
    their share.

    Images with a side below 31 pixels are enlarged. Raises DataError for unlike shapes, NumericsError for NaN
    and infinities.
    """
    a, b = _pair(a, b)
    # Both images as one batch; small ones are enlarged, since the second pooling would leave nothing of them.
    weights = {}
    for name, value in _weights().items():
        weights[name] = value.to(a.device)
    pair = torch.stack([a, b]).float().permute(0, 3, 1, 2)
    if min(pair.shape[2:]) < _MIN_LPIPS_SIDE_PIXELS:
        scale = _MIN_LPIPS_SIDE_PIXELS / min(pair.shape[2:])
        size = []
        for n in pair.shape[2:]:
            size.append(max(_MIN_LPIPS_SIDE_PIXELS, round(scale * n)))
        pair = F.interpolate(pair, size, mode="bilinear", align_corners=False)
    total = 0.0
    for layer, features in enumerate(_activations(weights, pair), start=1):
        # Features of unit length, compared channel by channel by the weights of the layer's head.
        first, second = features / (features.square().sum(1, keepdim=True).sqrt() + _LPIPS_EPS)
        apart = torch.einsum("chw,c->hw", (first - second).square(), weights[f"head{layer}"]).double()
        # A cell counts by the share of it that lies in the mask.
        share = torch.ones_like(apart)
        if where is not None:
            share = F.interpolate(where[None, None].to(apart), apart.shape, mode="area")[0, 0]
        total += float((apart * share).sum() / share.sum())
    return _finite("lpips", total)


def _activations(
    weights: Mapping[str, Tensor], images: Annotated[Tensor, "B 3 H W"]
) -> Iterator[Annotated[Tensor, "B C h w"]]:
    """Of AlexNet's convolutions, one after the other."""
    shift = images.new_tensor(_IMAGENET_MEAN).view(1, 3, 1, 1)
    scale = images.new_tensor(_IMAGENET_DEVIATION).view(1, 3, 1, 1)
    x = (2 * images - 1 - shift) / scale
    for layer, (stride, padding) in enumerate(zip(_ALEXNET_STRIDES, _ALEXNET_PADS, strict=True), start=1):
        if layer in _ALEXNET_POOLED:
            x = F.max_pool2d(x, 3, 2)
        x = F.relu(F.conv2d(x, weights[f"conv{layer}.weight"], weights[f"conv{layer}.bias"], stride, padding))
        yield x


@cache
def _weights() -> Mapping[str, Tensor]:
    return read_weights(_LPIPS_WEIGHTS)[0]


def image_metrics(
    render: Annotated[Tensor, "H W 3"],
    truth: Annotated[Tensor, "H W 3"],
    where: Annotated[Tensor, "H W"] | None = None,
) -> dict[str, float]:
    """Every metric of one view, by name. Pixels that are not `where` (a capture's mask) are left out.

    `cc_psnr` is the PSNR in the photograph's own exposure and white balance: after the factor of each channel
    that brings the render nearest to it (nerfstudio's name; there an affine map is fitted).

    Windows of SSIM and cells of LPIPS about pixels that are left out still see them: the same in both images.
    Raises DataError where the mask leaves nothing.
    """
    if where is None:
        corrected = _exposed_as(render, truth)
        return {
            "psnr": psnr(render, truth),
            "cc_psnr": psnr(corrected, truth),
            "ssim": ssim(render, truth),
            "lpips": lpips(render, truth),
        }
    if not bool(where.any()):
        raise DataError(
            "a mask leaves nothing of a view that is to be judged; leave the view out, or its mask"
        )
    # Pixels that are left out are made equal, so that windows over them see no difference.
    filled = torch.where(where[..., None], render, truth)
    seen = truth[where][None]
    shown = render[where][None]
    return {
        "psnr": psnr(shown, seen),
        "cc_psnr": psnr(_exposed_as(shown, seen), seen),
        "ssim": ssim(filled, truth, where),
        "lpips": lpips(filled, truth, where),
    }


def _exposed_as(
    render: Annotated[Tensor, "H W 3"], truth: Annotated[Tensor, "H W 3"]
) -> Annotated[Tensor, "H W 3"]:
    """A render times f = sum(render truth) / sum(render^2) of each channel, the least squares."""
    first, second = _pair(render, truth)
    square = first.square().double().sum((0, 1))
    factor = torch.where(square > 0, (first * second).double().sum((0, 1)) / square.clamp_min(1e-12), 1.0)
    return (first * factor.to(first.dtype)).clamp(0, 1)


def mean_metrics(views: Iterable[Mapping[str, float]]) -> dict[str, float]:
    """Mean of every metric over views, each view counting once (the mean of PSNRs, not the PSNR of the mean
    error).

    Raises DataError where there is no view; KeyError where the views carry different metrics.
    """
    rows = list(views)
    if not rows:
        raise DataError("no views to average metrics over; the split is empty")
    found: dict[str, float] = {}
    for name in rows[0]:
        found[name] = math.fsum(row[name] for row in rows) / len(rows)
    return found


def warp(
    image_b: Annotated[Tensor, "G F 3"],
    depth_a: Annotated[Tensor, "H W"],
    depth_b: Annotated[Tensor, "G F"],
    cameras: Cameras,
    a: int,
    b: int,
) -> tuple[Annotated[Tensor, "H W 3"], Annotated[Tensor, "H W"]]:
    """View b as view a would see it, and a mask of where that can be said; 0 elsewhere.

    `image_b` is looked up at the pixels of view a; bilinear, so exact where b's image is linear between pixel
    centres. Depths are world distances along the unit ray; 0 or not finite = nothing there. Raises DataError
    for sizes that are not the cameras'.
    """
    for view, what, shape in (
        (b, "image", image_b.shape[:2]),
        (a, "depth", depth_a.shape),
        (b, "depth", depth_b.shape),
    ):
        width, height = cameras.size[view].tolist()
        if tuple(shape) != (height, width):
            found = "x".join(str(side) for side in reversed(shape))
            raise DataError(
                f"view {view}: the {what} is {found}, its camera {width}x{height}; render at the camera's size"
            )
    # Lift view a's pixels to the world by its depth, and look at them from view b.
    origin, direction = grid_rays(cameras, a)
    depth = depth_a.reshape(-1).to(origin)
    solid = torch.isfinite(depth) & (depth > 0)
    points = origin + direction * torch.where(solid, depth, torch.ones_like(depth))[:, None]
    there, ahead = project(cameras, torch.full((len(points),), b, device=points.device), points)
    size = cameras.size[b].to(there)
    # Half a pixel from the border there is no neighbour to interpolate with. The slack is rounding.
    inside = ((there >= 0.5 - 1e-6) & (there <= size - 0.5 + 1e-6)).all(dim=-1) & (ahead > 0)
    pixel = torch.where(inside[:, None], there, size / 2)
    # Where b's own depth differs from the point's distance, something else is in front or the point is not
    # there.
    distance = (points - cameras.pose[b, :, 3]).norm(dim=-1)
    met = look_up(torch.where(torch.isfinite(depth_b), depth_b, 0.0)[..., None], pixel)[:, 0]
    same = (met - distance).abs() <= _MAX_DISTANCE_SHARE * distance
    valid = (solid & inside & same).reshape(depth_a.shape)
    colour = look_up(image_b, pixel).reshape(*depth_a.shape, 3).to(image_b)
    return torch.where(valid[..., None], colour, torch.zeros_like(colour)), valid


class WarpError:
    """Consistency over pairs of views of `cameras`, added one by one, so that no more than two renders are
    held at a time.
    """

    def __init__(self, cameras: Cameras) -> None:
        self.cameras = cameras
        self.squared = self.variation = 0.0
        self.compared = self.pixels = self.pairs = 0

    def add(
        self,
        a: int,
        b: int,
        image_a: Annotated[Tensor, "H W 3"],
        image_b: Annotated[Tensor, "G F 3"],
        depth_a: Annotated[Tensor, "H W"],
        depth_b: Annotated[Tensor, "G F"],
    ) -> None:
        """Warp view b into view a and compare. Raises DataError for sizes that are not the cameras'."""
        warped, valid = warp(image_b, depth_a, depth_b, self.cameras, a, b)
        count = int(valid.sum())
        self.pixels = self.pixels + valid.numel()
        self.compared = self.compared + count
        self.pairs = self.pairs + 1
        if count:
            here = image_a[valid].double()
            there = warped[valid].double()
            self.squared += float((here - there).square().sum())
            for colour in (here, there):
                self.variation += float((colour - colour.mean(dim=0)).square().sum()) / 2

    def summary(self) -> dict[str, float | int | None]:
        """Warp error: `rmse` (of [0, 1]), `relative` (to the contrast), `valid_share`, `pairs`.

        The errors are None where no pixel could be compared, `relative` also where all compared colours are
        alike. Raises NumericsError for colours that are not finite.
        """
        if not math.isfinite(self.squared):
            raise NumericsError(
                "consistency: a render holds colours that are not finite; nothing can be judged by it"
            )
        return {
            "rmse": math.sqrt(self.squared / (3 * self.compared)) if self.compared else None,
            "relative": math.sqrt(self.squared / self.variation) if self.variation > 0 else None,
            "valid_share": self.compared / self.pixels if self.pixels else 0.0,
            "pairs": self.pairs,
        }


def judge(
    scene: Scene,
    known: Known,
    captured: ParsedScene,
    views: Sequence[int],
    progress: Callable[[int, int, str], None],
    save: Callable[[int, Image], None],
    *,
    masks: bool = True,
) -> dict[str, Any]:
    """Metrics of views of a scene: means, and each by name. Their images, in the light that they were taken
    in, go to `save`.

    `captured` has the photographs; pixels that its `masks` leave out do not count, neither here nor in
    consistency; `used_share` says how many do. Seconds are those of rendering alone. Consistency warps each
    view into the next one of the list by the rendered depth.
    """
    cameras = known.cameras
    before: View | None = None
    rows = {}
    seconds = 0.0
    kept = 0.0
    pixels = 0
    warped = WarpError(cameras.select(torch.tensor(list(views), dtype=torch.int64)))
    for i, view in enumerate(views):
        progress(i, len(views), "rendering")
        # As it was taken: in its exposure and tone. Only rendering is timed.
        taken = scene.as_taken(view)
        start = time.perf_counter()
        render = taken.render(cameras, view)
        seconds += time.perf_counter() - start
        save(view, to_uint8(render.rgb))
        kept += render.kept
        truth, where = known.photograph(captured, view, masks=masks)
        pixels += truth.shape[0] * truth.shape[1]
        row = image_metrics(render.rgb, truth, where)
        if where is None:
            row["used_share"] = 1.0
        else:
            row["used_share"] = float(where.double().mean())
        rows[known.names[view]] = row
        # Two renders are held at a time, whatever the number of views. What is left out has no depth there.
        if where is not None:
            render = render._replace(depth=torch.where(where.to(render.depth.device), render.depth, 0.0))
        if before is not None:
            warped.add(i - 1, i, before.rgb, render.rgb, before.depth, render.depth)
        before = render
    progress(len(views), len(views), "rendering")
    means = mean_metrics(rows.values())
    return {
        **means,
        "views": len(views),
        "render_seconds": seconds,
        "seconds_per_view": seconds / max(1, len(views)),
        "rays_per_second": pixels / max(seconds, 1e-9),
        "kept_samples_share": kept / max(1, len(views)),
        "peak_rss_mib": (peak() or 0) / 2**20,
        "consistency": warped.summary(),
        "per_view": rows,
    }
