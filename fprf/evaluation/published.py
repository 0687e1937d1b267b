"""Consistency as others report it, for comparison alone: a blurred or dull film scores well here (see `steadiness`).

Frame t - k is warped onto frame t, k = 1 (short) and 7 (long), and both are compared where the warp is valid:

    rmse   = mean over t of sqrt( mean over valid pixels and channels of (I_t - W(I_{t-k}))² )     Stylos, AnyStyle, StyleRF
    e_warp = mean over t of the same mean square                                                   FPRF, after Lai et al. 2018

LPIPS, which these protocols give as well, needs weights that do not ship.
"""

import math
from collections.abc import Sequence
from typing import Annotated

from torch import Tensor

from ..errors import DataError
from ..rendering.cameras import Cameras
from .consistency import LONG, SHORT, warp

__all__ = ["published"]


def published(
    images: Sequence[Annotated[Tensor, "H W 3"]], depths: Sequence[Annotated[Tensor, "H W"]], cameras: Cameras
) -> dict[str, dict[str, float | int | None]]:
    """`short` and `long`: `rmse`, `e_warp` (both of colours in [0, 1]), `lpips` (None) and the number of `pairs` compared.

    Raises DataError where images, depths and cameras differ in number.
    """
    if not len(images) == len(depths) == len(cameras):
        raise DataError(f"{len(images)} images, {len(depths)} depths, {len(cameras)} cameras: one of each per frame is needed")
    found: dict[str, dict[str, float | int | None]] = {}
    for name, gap in (("short", SHORT), ("long", LONG)):
        squares = []
        for t in range(gap, len(images)):
            there, valid = warp(images[t - gap], depths[t], depths[t - gap], cameras, t, t - gap)
            if bool(valid.any()):
                squares.append(float((images[t][valid].double() - there[valid].double()).square().mean()))
        count = len(squares)
        found[name] = {
            "rmse": math.fsum(map(math.sqrt, squares)) / count if count else None,
            "e_warp": math.fsum(squares) / count if count else None,
            "lpips": None,
            "pairs": count,
        }
    return found
