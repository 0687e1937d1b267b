"""A k-d tree over the footprint: the heaviest region is halved until each holds no more than a budget of training pixels.

A region weighs half by the pixels of the cameras that stand in it and half by its share of the sparse points: cameras say
where pixels come from, points where they end.
"""

from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ..fields.layouts import AdaptiveConfig
from ..interfaces import BlockLayout
from ..types import Boxes, Site
from .region import bounds

__all__ = ["AdaptiveLayout"]

_TENTH = 0.1


class _Node(NamedTuple):
    low: Annotated[Tensor, "3"]
    high: Annotated[Tensor, "3"]


class AdaptiveLayout(BlockLayout):
    """Splits along the longer horizontal side, where the weight halves."""

    def __init__(self, config: AdaptiveConfig) -> None:
        self.config = config

    def cut(self, site: Site) -> Boxes:
        """The leaves that weigh anything, in the order of the tree."""
        low, high = bounds(site)
        place, weight = _weights(site, low, high)
        extent = high - low
        smallest = _TENTH * float(extent[:2].amax()) if self.config.smallest is None else self.config.smallest / site.unit
        leaves = [n for n in self._split(_Node(low, high), place, weight, smallest) if _load(n, place, weight) > 0]
        leaves = leaves or [_Node(low, high)]
        lows, highs = torch.stack([n.low for n in leaves]), torch.stack([n.high for n in leaves])
        # The margin is that of the smallest side that may be: another budget moves no block that it does not split.
        margin = self.config.margin * smallest if len(leaves) > 1 else 0.0
        # What is found on the region's border lies inside its blocks.
        lows, highs = torch.where(lows <= low, lows - margin, lows), torch.where(highs >= high, highs + margin, highs)
        turn = torch.eye(3, dtype=low.dtype).expand(len(leaves), 3, 3).clone()
        return Boxes(lows, highs, turn, margin)

    def _split(self, node: _Node, place: Tensor, weight: Tensor, smallest: float) -> list[_Node]:
        axis = int((node.high - node.low)[:2].argmax())
        room = float(node.high[axis] - node.low[axis])
        if _load(node, place, weight) <= self.config.rays or room < 2 * smallest:
            return [node]
        inside = _inside(node, place)
        at = _median(place[inside, axis], weight[inside])
        at = min(max(at, float(node.low[axis]) + smallest), float(node.high[axis]) - smallest)
        first, second = node.high.clone(), node.low.clone()
        first[axis] = second[axis] = at
        halves = _Node(node.low, first), _Node(second, node.high)
        return [leaf for half in halves for leaf in self._split(half, place, weight, smallest)]


def _weights(site: Site, low: Tensor, high: Tensor) -> tuple[Annotated[Tensor, "N 2"], Annotated[Tensor, "N"]]:
    """Places seen from above, and the training pixels that each stands for."""
    points = site.points[((site.points >= low) & (site.points <= high)).all(1)]
    share = 0.5 if len(points) else 1.0
    rays = site.rays.double()
    place = torch.cat([site.position[:, :2], points[:, :2]])
    return place, torch.cat([share * rays, points.new_full((len(points),), 0.5 * float(rays.sum()) / max(1, len(points)))])


def _inside(node: _Node, place: Tensor) -> Annotated[Tensor, "N"]:
    return ((place >= node.low[:2]) & (place < node.high[:2])).all(1)


def _load(node: _Node, place: Tensor, weight: Tensor) -> float:
    return float(weight[_inside(node, place)].sum())


def _median(values: Annotated[Tensor, "N"], weight: Annotated[Tensor, "N"]) -> float:
    """Where half of the weight lies below."""
    order = values.argsort()
    total = weight[order].cumsum(0)
    at = int(torch.searchsorted(total, total[-1] / 2))
    return float(values[order[at]])
