"""Inconsistency that a style adds to that of the unstylised render, plus the sharpness that it loses:

    score = mean over short and long of max(0, error(stylised) - error(plain))  +  max(0, 1 - sharpness)

Only places that the unstylised render itself shows alike count. Colours are compared as means over windows,
since a texture finer than a pixel differs in every frame. Sharpness is the steepest change of colour in a
neighbourhood over the range of colours there. Frames are warped as in `fprf.evaluation.metrics`.

`published` is consistency as other papers report it. A blurred or dull film scores well there.

    rmse   = mean over t of sqrt( mean over valid pixels and channels of (I_t - W(I_{t-k}))² )     Stylos, AnyStyle, StyleRF
    e_warp = mean over t of the same mean square                                                   FPRF, after Lai et al. 2018
    lpips  = mean over t of LPIPS(M I_t, M W(I_{t-k})), M = 0 where not valid: black in both       Stylos, AnyStyle, StyleRF
"""

import math
from collections.abc import Sequence
from typing import Annotated, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from fprf.errors import DataError, NumericsError
from fprf.evaluation.metrics import lpips, warp
from fprf.rendering.cameras import Cameras

SHORT = 1
LONG = 7
"""Frames between the two views of a pair (Lai et al. 2018, and every peer since)."""

_ALIKE = 0.1
"""Distance of sRGB colours up to which the unstylised render shows a place alike in two frames."""
_WINDOW = 7
"""Pixels of a side, at least half of which must count."""
_EDGE = 0.5
"""Of a frame's contrast: neighbourhoods with a smaller range of colours show no edge."""

Frames = Sequence[Annotated[Tensor, "H W 3"]]


class Steadiness(NamedTuple):
    """Errors are relative to contrast; None where nothing could be compared."""

    score: float | None
    short: float | None
    """Error of the stylised frames between neighbours."""
    long: float | None
    """Seven frames apart."""
    plain_short: float | None
    plain_long: float | None
    sharpness: float | None
    """Relative to the unstylised frames; 1 = as sharp."""
    valid_share: float
    """Share of the pixels that counted, between neighbours."""


def steadiness(
    plain: Frames, styled: Frames, depths: Sequence[Annotated[Tensor, "H W"]], cameras: Cameras
) -> Steadiness:
    """Of a path. Depths are world distances along the unit ray (0 or infinite = nothing there).

    Raises DataError where the numbers of frames differ, NumericsError for colours that are not finite.
    """
    if not len(plain) == len(styled) == len(depths) == len(cameras):
        raise DataError(
            f"steadiness: {len(plain)} plain and {len(styled)} stylised frames, {len(depths)} depths, {len(cameras)} cameras; "
            "one of each per frame is needed"
        )
    for frame in (*plain, *styled):
        if not bool(frame.isfinite().all()):
            raise NumericsError(
                "steadiness: a frame holds colours that are not finite; nothing can be judged by it"
            )
    near, far = (_errors(plain, styled, depths, cameras, gap) for gap in (SHORT, LONG))
    added = [
        max(0.0, each.styled - each.plain)
        for each in (near, far)
        if each.styled is not None and each.plain is not None
    ]
    sharp = sharpness(plain, styled)
    lost = 0.0 if sharp is None else max(0.0, 1 - sharp)
    score = math.fsum(added) / len(added) + lost if added else None
    return Steadiness(score, near.styled, far.styled, near.plain, far.plain, sharp, near.share)


def sharpness(plain: Frames, styled: Frames) -> float | None:
    """Steepness of the stylised frames' edges over that of the plain ones' (the median over places where both
    have an edge).
    """
    ratios = []
    for before, after in zip(plain, styled, strict=True):
        (steep, edge) = _steepness(before)
        (steep_after, edge_after) = _steepness(after)
        both = edge & edge_after
        ratios.append((steep_after[both] / steep[both]).double())
    all_ratios = torch.cat(ratios) if ratios else torch.empty(0)
    return float(all_ratios.median()) if len(all_ratios) else None


class _Errors(NamedTuple):
    plain: float | None
    styled: float | None
    share: float


def _errors(plain: Frames, styled: Frames, depths: Sequence[Tensor], cameras: Cameras, gap: int) -> _Errors:
    squared = [0.0, 0.0]
    spread = [0.0, 0.0]
    counted = pixels = 0
    for a, b in zip(range(len(plain)), range(gap, len(plain)), strict=False):
        there, valid = warp(plain[b], depths[a], depths[b], cameras, a, b)
        valid = valid & ((plain[a] - there).norm(dim=-1) <= _ALIKE)
        # Share of the window around each pixel that counts; beyond the frame nothing does.
        within = F.avg_pool2d(valid[None, None].double(), _WINDOW, 1, _WINDOW // 2)[0, 0]
        full = valid & (within >= 0.5)
        counted = counted + int(full.sum())
        pixels = pixels + full.numel()
        moved, _ = warp(styled[b], depths[a], depths[b], cameras, a, b)
        for i, (here, warped) in enumerate(((plain[a], there), (styled[a], moved))):
            first, second = (_window_mean(x, valid, within)[full].double() for x in (here, warped))
            squared[i] += float((first - second).square().sum())
            spread[i] += float((first - first.mean(0)).square().sum()) if len(first) else 0.0
    errors = [math.sqrt(s / v) if v > 0 else None for s, v in zip(squared, spread, strict=True)]
    return _Errors(errors[0], errors[1], counted / pixels if pixels else 0.0)


def _window_mean(
    image: Annotated[Tensor, "H W 3"], valid: Annotated[Tensor, "H W"], within: Annotated[Tensor, "H W"]
) -> Annotated[Tensor, "H W 3"]:
    kept = torch.where(valid[..., None], image.double(), 0.0).permute(2, 0, 1)[None]
    return F.avg_pool2d(kept, _WINDOW, 1, _WINDOW // 2)[0].permute(1, 2, 0) / within[..., None].clamp_min(
        1e-9
    )


def _steepness(
    image: Annotated[Tensor, "H W 3"],
) -> tuple[Annotated[Tensor, "H W"], Annotated[Tensor, "H W"]]:
    """Steepest change between neighbours over the range of colours, in the window of each pixel; and where
    there is an edge.
    """
    rows = image.double().permute(2, 0, 1)[None]
    reach = (_highest(rows) + _highest(-rows)).norm(dim=1)[0]
    across = F.pad((rows[..., 1:] - rows[..., :-1]).norm(dim=1), (0, 1))
    down = F.pad((rows[..., 1:, :] - rows[..., :-1, :]).norm(dim=1), (0, 0, 0, 1))
    steep = _highest(torch.maximum(across, down)[None])[0, 0]
    contrast = (image.double() - image.double().mean((0, 1))).square().sum(-1).mean().sqrt()
    edge = reach > _EDGE * contrast.clamp_min(1e-6)
    return steep / reach.clamp_min(1e-9), edge


def _highest(maps: Annotated[Tensor, "1 C H W"]) -> Annotated[Tensor, "1 C H W"]:
    return F.max_pool2d(maps, _WINDOW, 1, _WINDOW // 2)


def published(
    images: Sequence[Annotated[Tensor, "H W 3"]], depths: Sequence[Annotated[Tensor, "H W"]], cameras: Cameras
) -> dict[str, dict[str, float | int | None]]:
    """`short` and `long`: `rmse`, `e_warp` (both of colours in [0, 1]), `lpips` and the number of `pairs`
    compared.

    Raises DataError where images, depths and cameras differ in number.
    """
    if not len(images) == len(depths) == len(cameras):
        raise DataError(
            f"{len(images)} images, {len(depths)} depths, {len(cameras)} cameras: one of each per frame is needed"
        )
    summary: dict[str, dict[str, float | int | None]] = {}
    for name, gap in (("short", SHORT), ("long", LONG)):
        squares = []
        perceived = []
        for t in range(gap, len(images)):
            there, valid = warp(images[t - gap], depths[t], depths[t - gap], cameras, t, t - gap)
            if bool(valid.any()):
                squares.append(float((images[t][valid].double() - there[valid].double()).square().mean()))
                perceived.append(lpips(torch.where(valid[..., None], images[t], 0.0), there))
        count = len(squares)
        summary[name] = {
            "rmse": math.fsum(map(math.sqrt, squares)) / count if count else None,
            "e_warp": math.fsum(squares) / count if count else None,
            "lpips": math.fsum(perceived) / count if count else None,
            "pairs": count,
        }
    return summary
