"""Layouts: how a scene is cut, into blocks of fields or cells of Gaussians. One part, the whole scene, is the
default. `build` imports the implementation.

Lengths are in world units: metres, or whatever the capture's poses are in.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from ..checks import at_least, between, positive
from ..plugins.config import PluginConfig

if TYPE_CHECKING:
    from ..interfaces import BlockLayout


@dataclass(frozen=True, kw_only=True)
class LayoutConfig(PluginConfig):
    """Cuts a scene into parts; a number N stands for `bisect` with N of them."""

    group: ClassVar[str] = "fprf.layouts"
    cuts: ClassVar[bool] = True
    """True where it may give more than one part."""
    principal: ClassVar[bool] = False
    """True where the site that it cuts has the principal axes of what views see of the reconstruction's points,
    not those along, across and above the capture.
    """

    @classmethod
    def of_number(cls, number: int) -> LayoutConfig:
        if number == 1:
            return SingleConfig()
        return BisectConfig(count=number)

    def build(self) -> BlockLayout:
        """The layout."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class SingleConfig(LayoutConfig):
    """One part: the whole scene."""

    cuts: ClassVar[bool] = False

    def build(self) -> BlockLayout:
        from .layouts import GridLayout

        return GridLayout(GridConfig(cells=(1, 1)))


@dataclass(frozen=True, kw_only=True)
class GridConfig(LayoutConfig):
    """Equal cells over the footprint of the cameras, seen from above."""

    cells: tuple[int, int] = (2, 2)
    """Cells along the capture's longer side, and across."""
    size: float | None = None
    """Side of a cell instead, world units; the nearest whole numbers of cells are taken."""
    margin: float = 0.1
    """Overlap of a block with its neighbours, as a share of the shorter side of a cell; in (0, 0.5]."""

    def __post_init__(self) -> None:
        for count in self.cells:
            at_least("cells", count, 1)
        if self.size is not None:
            positive("size", self.size)
        positive("margin", self.margin)
        between("margin", self.margin, 0.0, 0.5)

    def build(self) -> BlockLayout:
        from .layouts import GridLayout

        return GridLayout(self)


@dataclass(frozen=True, kw_only=True)
class AdaptiveConfig(LayoutConfig):
    """Halves the scene where cameras and points are dense until each block fits a budget."""

    rays: int = 20_000_000
    """Most training pixels of a block, counted by its share of the cameras and of the sparse points."""
    smallest: float | None = None
    """No side of a block falls below this, world units; none = a tenth of the scene's."""
    margin: float = 0.25
    """Overlap of a block with its neighbours, as a share of the smallest side; in (0, 0.5]."""

    def __post_init__(self) -> None:
        at_least("rays", self.rays, 1)
        if self.smallest is not None:
            positive("smallest", self.smallest)
        positive("margin", self.margin)
        between("margin", self.margin, 0.0, 0.5)

    def build(self) -> BlockLayout:
        from .layouts import AdaptiveLayout

        return AdaptiveLayout(self)


@dataclass(frozen=True, kw_only=True)
class BisectConfig(LayoutConfig):
    """Parts that photographs see equally often, along the principal axes of the reconstruction's points. They
    cover all of space.
    """

    principal: ClassVar[bool] = True

    count: int = 2
    """Parts."""
    margin: float = 0.1
    """Overlap of a block of fields with its neighbours, as a share of the shortest side of what is seen in any; in
    (0, 0.5].
    """

    def __post_init__(self) -> None:
        at_least("count", self.count, 1)
        positive("margin", self.margin)
        between("margin", self.margin, 0.0, 0.5)

    def build(self) -> BlockLayout:
        from .layouts import BisectLayout

        return BisectLayout(self)
