"""One block over the whole scene: not cut."""

import torch

from ..interfaces import BlockLayout
from ..types import Boxes, Site
from .region import bounds

__all__ = ["SingleLayout"]


class SingleLayout(BlockLayout):
    """The default."""

    def cut(self, site: Site) -> Boxes:
        """The region as one cell."""
        low, high = bounds(site)
        return Boxes(low[None], high[None], torch.eye(3, dtype=low.dtype)[None], 0.0)
