"""The plan of a large scene: its blocks, and for each one which tiles of which views it learns from.

Pure geometry of cameras and sparse points: made in seconds, before any image is decoded.
"""

from dataclasses import dataclass
from typing import Annotated, Any

import torch
from torch import Tensor

from ..datamanagers.scene import Scene, find_sightings
from ..errors import ConfigError
from ..fields.layouts import LayoutConfig
from ..rendering.space import Space
from ..types import Boxes
from .space import open_space, site_of
from .visibility import pixel_mask, tile_rays, visible

__all__ = ["Plan", "boxes_from", "boxes_to", "make_plan"]

VIEWS = 256
"""Views whose tiles are looked at together: bounds memory, changes nothing."""


@dataclass(frozen=True, kw_only=True)
class Plan:
    """Z blocks of a scene, T training views."""

    space: Space
    boxes: Boxes
    views: Annotated[Tensor, "T"]
    """int64 training views of the scene."""
    seen: Annotated[Tensor, "T Z TILES TILES"]
    """Tiles of each view that each block learns from."""
    pixels: Annotated[Tensor, "T TILES TILES"]
    """int64 pixels of each tile."""

    @property
    def cut(self) -> bool:
        """Whether there is more than one block."""
        return len(self.boxes.low) > 1

    @property
    def rays(self) -> Annotated[Tensor, "Z"]:
        """int64 training pixels of each block."""
        return torch.stack([(self.seen[:, z] * self.pixels).sum() for z in range(len(self.boxes.low))])

    def views_of(self, block: int) -> Annotated[Tensor, "M"]:
        """int64 training views that a block learns from."""
        return self.views[(self.seen[:, block] & (self.pixels > 0)).flatten(1).any(1)]

    def mask(self, block: int, view: int, size: tuple[int, int]) -> Annotated[Tensor, "H W"]:
        """The pixels of a training view of (width, height) that a block learns from."""
        at = int((self.views == view).nonzero()[0, 0])
        return pixel_mask(self.seen[at, block], size)


def make_plan(scene: Scene, layout: LayoutConfig) -> Plan:
    """Cut the scene and find out who sees what. Raises ConfigError where a block would have nothing to learn from."""
    sightings = find_sightings(scene)
    space = open_space(scene, sightings)
    boxes = layout.build().cut(site_of(scene, space))
    seen, pixels = [], []
    for views in torch.split(scene.train, VIEWS):
        tiles = tile_rays(scene, space, views, sightings)
        seen.append(visible(tiles, boxes))
        pixels.append(tiles.pixels)
    tiles_seen, counts = torch.cat(seen), torch.cat(pixels)
    whole = Plan(space=space, boxes=boxes, views=scene.train, seen=tiles_seen, pixels=counts)
    used = (whole.rays > 0).nonzero()[:, 0]
    if not len(used):
        raise ConfigError(f"{scene.name}: no training view sees any block of this layout; choose another --blocks")
    kept = Boxes(boxes.low[used], boxes.high[used], boxes.turn[used], boxes.margin)
    return Plan(space=space, boxes=kept, views=scene.train, seen=tiles_seen[:, used], pixels=counts)


def boxes_to(boxes: Boxes) -> dict[str, Any]:
    """As JSON."""
    return {"low": boxes.low.tolist(), "high": boxes.high.tolist(), "turn": boxes.turn.tolist(), "margin": boxes.margin}


def boxes_from(value: dict[str, Any]) -> Boxes:
    """Out of JSON. Raises ValueError or KeyError where it is something else."""
    low, high, turn = (torch.tensor(value[key], dtype=torch.float64) for key in ("low", "high", "turn"))
    if low.ndim != 2 or low.shape != high.shape or tuple(turn.shape) != (len(low), 3, 3) or low.shape[1] != 3:
        raise ValueError(f"boxes of shapes {tuple(low.shape)}, {tuple(high.shape)}, {tuple(turn.shape)}")
    return Boxes(low, high, turn, float(value["margin"]))
