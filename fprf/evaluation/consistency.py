"""Does one place keep its colour from view to view? Renders are warped onto each other by the scene's own depth.

A pixel p of view a is lifted to the world by a's depth and looked up in view b. It counts where b sees the same place:
inside of b's frame, in front of it, and at the depth that b itself has there (occlusion).

    RMSE = sqrt( Σ_pairs Σ_valid |I_a(p) - I_b(p')|² / (3 Σ_pairs #valid) ),  pairs (t, t + 1) short, (t, t + 7) long

A dull image scores well for nothing, so the error is also given relative to the contrast of what was compared: 0 for
perfect agreement, sqrt(2) for unrelated colours. Compare a stylised path with the unstylised render of the same path:
view-dependent shine and errors of the depth are in both.
"""

import math
from collections.abc import Sequence
from typing import Annotated, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from ..errors import DataError, NumericsError
from ..rendering.cameras import Cameras, pixel_grid, project, rays_through

__all__ = ["LONG", "SHORT", "Warped", "consistency", "path_consistency", "path_pairs", "warp"]

SHORT, LONG = 1, 7
"""Frames between the two views of a pair (Lai et al. 2018, and every peer since)."""

_TOLERANCE = 0.02
"""Of the distance: below it, two surfaces count as one. Bilinear depth on a slope is off by far less."""


class Warped(NamedTuple):
    """View b as view a would see it, and where that can be said."""

    image: Annotated[Tensor, "H W 3"]
    """0 where not valid."""
    valid: Annotated[Tensor, "H W"]


def warp(
    image_b: Annotated[Tensor, "G F 3"],
    depth_a: Annotated[Tensor, "H W"],
    depth_b: Annotated[Tensor, "G F"],
    cameras: Cameras,
    a: int,
    b: int,
) -> Warped:
    """`image_b` looked up at the pixels of view a; bilinear, so exact where b's image is linear between pixel centres.

    Depths are world distances along the unit ray; 0 or not finite = nothing there. Raises DataError for sizes that are
    not the cameras'.
    """
    _sized(image_b.shape[:2], cameras, b, "image")
    _sized(depth_a.shape, cameras, a, "depth")
    _sized(depth_b.shape, cameras, b, "depth")
    pixel = pixel_grid(cameras, a)
    view = torch.full((len(pixel),), a, device=pixel.device)
    origin, direction = rays_through(cameras, view, pixel)
    depth = depth_a.reshape(-1).to(pixel)
    solid = torch.isfinite(depth) & (depth > 0)
    points = origin + direction * torch.where(solid, depth, torch.ones_like(depth))[:, None]
    there, ahead = project(cameras, torch.full_like(view, b), points)
    size = cameras.size[b].to(there)
    # Half a pixel from the border there is no neighbour to interpolate with. The slack is rounding.
    inside = ((there >= 0.5 - 1e-6) & (there <= size - 0.5 + 1e-6)).all(dim=-1) & (ahead > 0)
    place = torch.where(inside[:, None], 2 * there / size - 1, torch.zeros_like(there))
    distance = (points - cameras.pose[b, :, 3]).norm(dim=-1)
    met = _at(torch.where(torch.isfinite(depth_b), depth_b, 0.0).to(place)[..., None], place)[:, 0]
    same = (met - distance).abs() <= _TOLERANCE * distance
    valid = (solid & inside & same).reshape(depth_a.shape)
    colour = _at(image_b.to(place), place).reshape(*depth_a.shape, 3).to(image_b)
    return Warped(torch.where(valid[..., None], colour, torch.zeros_like(colour)), valid)


def consistency(
    images: Sequence[Annotated[Tensor, "H W 3"]],
    depths: Sequence[Annotated[Tensor, "H W"]],
    cameras: Cameras,
    pairs: Sequence[tuple[int, int]],
) -> dict[str, float | int | None]:
    """Warp error over pairs of views: `rmse` (of [0, 1]), `relative` (to the contrast), `valid_share`, `pairs`.

    The errors are None where no pixel could be compared, `relative` also where all compared colours are alike.
    Raises DataError where images, depths and cameras differ in number, NumericsError for colours that are not finite.
    """
    if not len(images) == len(depths) == len(cameras):
        raise DataError(f"{len(images)} images, {len(depths)} depths, {len(cameras)} cameras: one of each per view is needed")
    squared = variation = 0.0
    compared = pixels = 0
    for a, b in pairs:
        warped, valid = warp(images[b], depths[a], depths[b], cameras, a, b)
        count = int(valid.sum())
        pixels, compared = pixels + valid.numel(), compared + count
        if count:
            here, there = images[a][valid].double(), warped[valid].double()
            squared += float((here - there).square().sum())
            variation += sum(float((colour - colour.mean(dim=0)).square().sum()) for colour in (here, there)) / 2
    if not math.isfinite(squared):
        raise NumericsError("consistency: a render holds colours that are not finite; nothing can be judged by it")
    return {
        "rmse": math.sqrt(squared / (3 * compared)) if compared else None,
        "relative": math.sqrt(squared / variation) if variation > 0 else None,
        "valid_share": compared / pixels if pixels else 0.0,
        "pairs": len(pairs),
    }


def path_pairs(frames: int, gap: int) -> list[tuple[int, int]]:
    """All (t, t + gap) of a path; none where it is too short."""
    return [(t, t + gap) for t in range(frames - gap)]


def path_consistency(
    images: Sequence[Annotated[Tensor, "H W 3"]], depths: Sequence[Annotated[Tensor, "H W"]], cameras: Cameras
) -> dict[str, dict[str, float | int | None]]:
    """`consistency` of a path at short (t, t + 1) and long (t, t + 7) range."""
    return {
        name: consistency(images, depths, cameras, path_pairs(len(images), gap))
        for name, gap in (("short", SHORT), ("long", LONG))
    }


def _at(image: Annotated[Tensor, "H W C"], place: Annotated[Tensor, "N 2"]) -> Annotated[Tensor, "N C"]:
    """Bilinear values; `place` runs from -1 to 1 between the outer edges of the image."""
    found = grid_sample(
        image.permute(2, 0, 1)[None], place[None, None], mode="bilinear", padding_mode="border", align_corners=False
    )
    return found[0, :, 0].T


def _sized(shape: Sequence[int], cameras: Cameras, view: int, what: str) -> None:
    width, height = (int(side) for side in cameras.size[view])
    if tuple(shape) != (height, width):
        found = "x".join(str(side) for side in reversed(shape))
        raise DataError(f"view {view}: the {what} is {found}, its camera {width}x{height}; render at the camera's size")
