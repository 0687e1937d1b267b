"""Equal cells over the cameras' footprint; cells that no camera stands in and where next to nothing was found are left out."""

import torch

from ..fields.layouts import GridConfig
from ..interfaces import BlockLayout
from ..types import Boxes, Site
from .region import FEW, bounds

__all__ = ["GridLayout"]


class GridLayout(BlockLayout):
    """Cells along axes 0 and 1, as high as the region."""

    def __init__(self, config: GridConfig) -> None:
        self.config = config

    def cut(self, site: Site) -> Boxes:
        """The cells that hold something, row after row."""
        low, high = bounds(site)
        counts = list(self.config.cells)
        if self.config.size is not None:
            counts = [max(1, round(float(high[a] - low[a]) * site.unit / self.config.size)) for a in range(2)]
        margin = self.config.margin * min(float(high[a] - low[a]) / n for a, n in enumerate(counts))
        low, high = low - margin, high + margin  # what is found on the region's border lies inside its blocks
        sides = [torch.linspace(float(low[a]), float(high[a]), n + 1, dtype=low.dtype) for a, n in enumerate(counts)]
        cells = []
        for i in range(counts[0]):
            for j in range(counts[1]):
                first = torch.stack([sides[0][i], sides[1][j], low[2]])
                last = torch.stack([sides[0][i + 1], sides[1][j + 1], high[2]])
                if _holds(site, first, last):
                    cells.append((first, last))
        corners = torch.stack([torch.stack(cell) for cell in cells])
        turn = torch.eye(3, dtype=low.dtype).expand(len(cells), 3, 3).clone()
        return Boxes(corners[:, 0], corners[:, 1], turn, margin)


def _holds(site: Site, low: torch.Tensor, high: torch.Tensor) -> bool:
    cameras = ((site.position >= low) & (site.position <= high))[:, :2].all(1)
    points = ((site.points >= low) & (site.points <= high)).all(1)
    return bool(cameras.any()) or int(points.sum()) >= FEW or not len(site.points)
