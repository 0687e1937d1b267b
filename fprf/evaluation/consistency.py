"""Multi-view consistency: views are warped onto each other by depth and compared.

A pixel p of view a is lifted to the world by a's depth and looked up in view b. It counts where b sees the same place: inside
b's frame, in front of it, and at the depth that b itself has there (occlusion).

`consistency` is the error of warped colours, also relative to the contrast of what was compared (a dull image scores well for
nothing): 0 = perfect agreement, sqrt(2) = unrelated colours.

    RMSE = sqrt( Σ_pairs Σ_valid |I_a(p) - I_b(p')|² / (3 Σ_pairs #valid) )
"""

import math
from collections.abc import Sequence
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ..errors import DataError, NumericsError
from ..rendering.cameras import Cameras, grid_rays, look_up, project

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
    # Where b's own depth differs from the point's distance, something else is in front or the point is not there.
    distance = (points - cameras.pose[b, :, 3]).norm(dim=-1)
    met = look_up(torch.where(torch.isfinite(depth_b), depth_b, 0.0)[..., None], pixel)[:, 0]
    same = (met - distance).abs() <= _TOLERANCE * distance
    valid = (solid & inside & same).reshape(depth_a.shape)
    colour = look_up(image_b, pixel).reshape(*depth_a.shape, 3).to(image_b)
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
    error = WarpError(cameras)
    for a, b in pairs:
        error.add(a, b, images[a], images[b], depths[a], depths[b])
    return error.summary()


class WarpError:
    """Sums of `consistency` over pairs of views of `cameras`, so that no more than two renders are held at a time."""

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
        self.pixels, self.compared, self.pairs = self.pixels + valid.numel(), self.compared + count, self.pairs + 1
        if count:
            here, there = image_a[valid].double(), warped[valid].double()
            self.squared += float((here - there).square().sum())
            self.variation += sum(float((colour - colour.mean(dim=0)).square().sum()) for colour in (here, there)) / 2

    def summary(self) -> dict[str, float | int | None]:
        """The figures of `consistency`. Raises NumericsError for colours that are not finite."""
        if not math.isfinite(self.squared):
            raise NumericsError("consistency: a render holds colours that are not finite; nothing can be judged by it")
        return {
            "rmse": math.sqrt(self.squared / (3 * self.compared)) if self.compared else None,
            "relative": math.sqrt(self.squared / self.variation) if self.variation > 0 else None,
            "valid_share": self.compared / self.pixels if self.pixels else 0.0,
            "pairs": self.pairs,
        }


def _sized(shape: Sequence[int], cameras: Cameras, view: int, what: str) -> None:
    width, height = (int(side) for side in cameras.size[view])
    if tuple(shape) != (height, width):
        size = "x".join(str(side) for side in reversed(shape))
        raise DataError(f"view {view}: the {what} is {size}, its camera {width}x{height}; render at the camera's size")
