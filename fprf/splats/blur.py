"""Blurred photographs: each is compared with those that were taken near by."""

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Annotated

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from ..datamanagers.images import Image
from ..rendering.cameras import Cameras

_MAX_BLURRED_SHARE = 0.5
"""Share of the usual ratio below which a photograph counts as blurred: blurred ones have 0.23 to 0.32, sharp
ones 0.96 to 1.12 (blurred.json).
"""
_MAX_COMPARED_PHOTOGRAPHS = 8
"""Photographs that one is compared with, at most; by eye."""
_HALVINGS_APART = 2
"""Halvings between the fine detail and the coarse; by eye."""
_MIN_DETAIL_PIXELS = 4
"""Pixels of the shorter side from which on detail is measured: a Laplacian takes three."""
_MIN_COARSE_VARIANCE = 1e-3
"""Variance of the coarse detail, in 8-bit steps squared, below which a picture is flat; by eye."""
_MIN_COMPARABLE_PHOTOGRAPHS = 3
"""Photographs below which there is no saying what is usual."""


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
    energy = np.full(scales + _HALVINGS_APART, np.nan)
    for k in range(scales + _HALVINGS_APART):
        if k:
            grey = np.asarray(
                cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), dtype=np.float32
            )
        if min(grey.shape) < _MIN_DETAIL_PIXELS:
            break
        energy[k] = cv2.Laplacian(grey, cv2.CV_32F).var(dtype=np.float64)
    # In a flat picture there is no coarse detail to compare with, and the ratio says nothing.
    coarse = energy[_HALVINGS_APART:]
    ratio = np.full(scales, np.nan)
    np.divide(energy[:scales], coarse, out=ratio, where=coarse > _MIN_COARSE_VARIANCE)
    return ratio


def blurred_views(cameras: Cameras, images: Mapping[int, Image], scales: int) -> tuple[frozenset[int], ...]:
    """Views, of those with an image, that are blurred at each scale: at their size, at half of it and so on.

    `cameras` are of all views; images [H W 3] are 8 bits, sRGB. What is usual is the median of photographs
    taken near by in the same direction, so a softer camera is compared with itself, and nothing counts as
    blurred where all is.
    """
    views = list(images)
    if len(views) < _MIN_COMPARABLE_PHOTOGRAPHS:
        return (frozenset(),) * scales
    with ThreadPoolExecutor() as pool:
        ratio = np.stack(list(pool.map(lambda view: detail(images[view], scales), views)))
    # Near by means places in units of how far the cameras stand apart, and directions in radians.
    pose = cameras.pose[torch.tensor(views)].double()
    place = pose[:, :, 3]
    ahead = -pose[:, :, 2]
    spread = float((place - place.mean(0)).norm(dim=1).mean()) or 1.0
    blurred: list[set[int]] = []
    for _ in range(scales):
        blurred.append(set())
    for row, view in enumerate(views):
        apart = (place - place[row]).norm(dim=1) / spread + (ahead - ahead[row]).norm(dim=1)
        apart[row] = torch.inf
        beside = apart.argsort()[: min(_MAX_COMPARED_PHOTOGRAPHS, len(views) - 1)].numpy()
        for k in range(scales):
            usual = ratio[beside, k]
            usual = usual[np.isfinite(usual)]
            if len(usual) and ratio[row, k] < _MAX_BLURRED_SHARE * np.median(usual):
                blurred[k].add(view)
    return tuple(map(frozenset, blurred))
