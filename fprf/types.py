"""Data that flows between the parts. Letters, used in every signature:

R rays · S samples of a ray · E = S+1 edges · N points · C content channels · D semantic channels of the field
· L latent channels · T style codes · K scene regions · V views · H W pixels · B images · Z cells · P sparse
points.

Images are [H W 3] sRGB in [0, 1] float32, channels last; encoders alone take [B 3 H W]. Camera axes are
OpenGL's (x right, y up, the camera looks along -z); pixel centres lie at +0.5.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Flag, auto
from typing import Annotated, NamedTuple, TypeAlias

import torch
from torch import Tensor

Origin: TypeAlias = tuple[float, float, float]
"""Of a local frame: world = local + origin (see `rendering.local_frame`)."""
Window: TypeAlias = tuple[int, int, int, int]
"""Part of an image: left, top, width, height in pixels."""


class Want(Flag):
    """Outputs that are asked of a field or a render: nothing else is computed."""

    DENSITY = auto()
    COLOUR = auto()
    CONTENT = auto()
    SEMANTIC = auto()


class Rays(NamedTuple):
    """Rays in the scene's own space (see `rendering.space`), ready to be marched."""

    origin: Annotated[Tensor, "R 3"]
    direction: Annotated[Tensor, "R 3"]
    """March direction in space units; of any length in NDC."""
    view: Annotated[Tensor, "R 3"]
    """Unit viewing direction in world axes, for view-dependent features."""
    near: Annotated[Tensor, "R"]
    far: Annotated[Tensor, "R"]


class Level(NamedTuple):
    """One proposal level, kept for the interlevel loss."""

    s: Annotated[Tensor, "R E"]
    weights: Annotated[Tensor, "R S"]


class Site(NamedTuple):
    """Inputs of a layout: training cameras and sparse points in a frame of the scene, float64.

    Axis 0 runs along the capture, axis 2 upwards, or they are the principal axes of the points
    (`LayoutConfig.principal`, where the origin may lie anywhere); one unit is the distance that views commonly
    see, then up to a factor of 1.5.
    """

    position: Annotated[Tensor, "V 3"]
    rays: Annotated[Tensor, "V"]
    """int64 pixels of each view."""
    points: Annotated[Tensor, "P 3"]
    """None at all (P = 0) where the capture has no reconstruction."""
    unit: float
    """World units of one space unit."""
    seen: Annotated[Tensor, "O 3"] | None = None
    """Points, each as often as training views see it; None where no view sees any."""


@dataclass(frozen=True, kw_only=True)
class Cell:
    """A box of a partitioned scene: a block of fields or a cell of Gaussians. Neighbours share faces.

    Point x lies in it where low <= frame x < high; all are float64. Of blocks the frame is that of the
    scene's space; layouts leave it as it is, and their boxes are in the frame of the site.
    """

    low: Annotated[Tensor, "3"]
    """Lowest corner; -inf where the cell has no end."""
    high: Annotated[Tensor, "3"]
    border: Annotated[Tensor, "3"]
    """Width of the surroundings that it learns as well; there blocks blend with their neighbours. Cells of Gaussians
    have borders of their own (`blocks.windows`).
    """
    frame: Annotated[Tensor, "3 3"] = field(default_factory=lambda: torch.eye(3, dtype=torch.float64))
    """Rows: the axes of all cells of a scene; orthonormal."""
    windows: Mapping[int, Window] = field(default_factory=dict)
    """Parts of photographs that a cell of Gaussians learns from, by view."""

    def holds(self, points: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N"]:
        """True for points inside."""
        local = points.double() @ self.frame.T
        return ((local >= self.low) & (local < self.high)).all(1)

    def around(self, points: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N"]:
        """True for points inside and in the border."""
        local = points.double() @ self.frame.T
        return ((local >= self.low - self.border) & (local < self.high + self.border)).all(1)


class Sampled(NamedTuple):
    """Sorted sample edges: `s` in [0, 1] as the sampler spaces them, `t` along the ray in space units."""

    s: Annotated[Tensor, "R E"]
    t: Annotated[Tensor, "R E"]
    levels: tuple[Level, ...] = ()


class FieldSample(NamedTuple):
    """A content field at points: density per space unit, and what `content` needs to go on from there."""

    density: Annotated[Tensor, "N"]
    latent: Annotated[Tensor, "N L"]


class Batch(NamedTuple):
    """Training pixels, a pure function of (seed, step). Targets that nobody wants are None."""

    view: Annotated[Tensor, "R"]
    """int64 index of the view in the scene."""
    pixel: Annotated[Tensor, "R 2"]
    """x, y in pixels, centres at +0.5."""
    rgb: Annotated[Tensor, "R 3"]
    content: Annotated[Tensor, "R C"] | None = None
    semantic: Annotated[Tensor, "Q D"] | None = None
    """Semantic targets of the first Q rays of the batch (Q <= R)."""
    distance: Annotated[Tensor, "R"] | None = None
    """World distance along the rays that go through points of the reconstruction, NaN for the others."""
    sky: Annotated[Tensor, "R"] | None = None
    """True where a mask of the capture shows sky; None where there is none."""


class Rendered(NamedTuple):
    """A render of R rays. What was not wanted is None."""

    depth: Annotated[Tensor, "R"]
    """Expected distance in space units along the ray parameter."""
    opacity: Annotated[Tensor, "R"]
    rgb: Annotated[Tensor, "R 3"] | None = None
    content: Annotated[Tensor, "R C"] | None = None
    semantic: Annotated[Tensor, "R D"] | None = None
    weights: Annotated[Tensor, "R S"] | None = None
    sampled: Sampled | None = None
    counts: Mapping[str, int] = {}
    """Numbers of rays, samples, and kept samples."""


class View(NamedTuple):
    """One rendered view, on the CPU."""

    rgb: Annotated[Tensor, "H W 3"]
    depth: Annotated[Tensor, "H W"]
    """Distance along the unit ray in world units."""
    opacity: Annotated[Tensor, "H W"]
    kept: float
    """Share of the samples that were decoded; 1 where there are none."""
