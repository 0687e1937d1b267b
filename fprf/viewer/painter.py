"""A view in pictures, chunk by chunk: as it is, in a look, and as a map of what it takes; then put together as one.

Layers are what takes time and composing them is what does not: a wipe that is dragged renders nothing.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..interfaces import Decoder
from ..io.images import Picture, to_uint8
from ..io.maps import depth_image, match_image, palette
from ..style.regional import RegionWeight
from ..style.scene import SceneStyle
from ..training.cached_view import Part
from ..training.restyle import Styled
from .looks import Look

__all__ = ["MAPS", "Layers", "Map", "Painter", "Shown", "compose"]

Map: TypeAlias = Literal["none", "matches", "regions", "depth"]
MAPS: tuple[Map, ...] = ("none", "matches", "regions", "depth")

_DIM = 0.45
"""Brightness of what does not belong to the region that is picked; it is grey, too."""
_UNSURE = 0.45
"""Brightness of a region's colour where a pixel belongs to many."""


class Shown(NamedTuple):
    """What the page shows of a view."""

    look: Look
    map: Map = "none"
    cover: float = 1.0
    """How much of the picture a map hides, in [0, 1]."""
    wipe: float | None = None
    """Left of this share of the width is the scene as it was captured; None = nowhere."""
    region: int | None = None
    """A region to be made out; the others are dimmed."""

    @property
    def of_regions(self) -> bool:
        """Regions of the scene are shown."""
        return self.map == "regions" or self.region is not None

    @property
    def layers(self) -> frozenset[str]:
        """What must be painted for it."""
        wanted = {"look"}
        if self.map != "none":
            wanted.add(self.map)
        if self.wipe is not None:
            wanted.add("plain")
        if self.region is not None:
            wanted.add(f"region {self.region}")
        return frozenset(wanted)


@dataclass(frozen=True)
class Layers:
    """Painted layers of one view at one size."""

    pictures: dict[str, Picture]
    share: NDArray[np.float32] | None
    """How much of each pixel belongs to the region that is picked, [H W]."""
    depth: Tensor
    """World distance along each ray, [H W]; infinite where there is nothing."""


@dataclass
class Painter:
    """Paints chunks of a view. `styled` is the look on the scene, None for the scene as it is."""

    decoder: Decoder
    scene: SceneStyle | None
    """May be None where no region is shown."""
    styled: Styled | None
    shown: Shown
    size: tuple[int, int]
    """Width, height."""
    _rows: dict[str, list[Picture]] = field(default_factory=dict)
    _share: list[NDArray[np.float32]] = field(default_factory=list)
    _depth: list[Tensor] = field(default_factory=list)
    _opacity: list[Tensor] = field(default_factory=list)

    def paint(self, parts: Iterable[Part]) -> Iterator[None]:
        """Take in the chunks of a view, a step each."""
        for part in parts:
            self._take(part)
            yield

    def layers(self) -> Layers:
        """What was painted."""
        width, height = self.size
        depth, opacity = (torch.cat(each).view(height, width) for each in (self._depth, self._opacity))
        rows = {name: np.concatenate(each) for name, each in self._rows.items()}
        share = np.concatenate(self._share).reshape(height, width) if self._share else None
        pictures: dict[str, Picture] = {name: each.reshape(height, width, 3) for name, each in rows.items()}
        if self.shown.map == "depth":
            pictures["depth"] = depth_image(depth, opacity)
        solid = torch.where(opacity > 0.5, depth, torch.inf)
        return Layers(pictures, share, solid)

    @torch.inference_mode()
    def _take(self, part: Part) -> None:
        restyle = None if self.styled is None else self.styled.restyle
        self._add("look", _row(to_uint8(part.colour(self.decoder, restyle)[None])))
        if self.shown.wipe is not None:
            self._add("plain", _row(to_uint8(part.colour(self.decoder, None)[None])))
        if self.shown.map == "matches":
            self._add("matches", self._matches(part))
        if self.shown.map == "regions":
            self._add("regions", self._regions(part))
        if self.shown.region is not None:
            self._share.append(self._belongs(part)[:, self.shown.region].float().numpy())
        self._depth.append(part.depth)
        self._opacity.append(part.opacity)

    def _matches(self, part: Part) -> Picture:
        if self.styled is None or part.semantic is None:
            return np.full((part.rays, 3), 128, np.uint8)
        codes, look = self.styled.codes, self.styled.restyle
        taken = part.mean(look.match(part.semantic))
        total = taken.sum(-1, keepdim=True)
        attention, kept = taken / total.clamp_min(1e-10), 1 - total[:, 0]
        return _row(match_image(attention[None], codes.reference, codes.names, part.opacity[None], kept.clamp(0, 1)[None]))

    def _regions(self, part: Part) -> Picture:
        share = self._belongs(part)
        most, region = share.max(-1)
        light = (_UNSURE + (1 - _UNSURE) * most) * part.opacity
        return _row(to_uint8((palette(share.shape[1])[region] * light[:, None])[None]))

    def _belongs(self, part: Part) -> Tensor:
        """How much each pixel belongs to each region."""
        assert self.scene is not None
        weight = RegionWeight(self.scene, torch.eye(len(self.scene.share))).to(part.content.device)
        semantic = part.content[:, :0] if part.semantic is None else part.semantic
        return part.mean(weight(semantic))

    def _add(self, name: str, rows: Picture) -> None:
        self._rows.setdefault(name, []).append(rows)


def _row(picture: Picture) -> Picture:
    """A picture of one row as its pixels."""
    return np.asarray(picture[0])


def compose(layers: Layers, shown: Shown) -> Picture:
    """One picture. What was not painted is left out."""
    picture = layers.pictures["look"]
    if layers.share is not None and shown.region is not None:
        grey = _DIM * picture.mean(-1, keepdims=True)
        picture = np.rint(grey + (picture - grey) * layers.share[..., None]).astype(np.uint8)
    if shown.map in layers.pictures:
        over = layers.pictures[shown.map]
        picture = np.rint(picture * (1 - shown.cover) + over * shown.cover).astype(np.uint8)
    if shown.wipe is not None and "plain" in layers.pictures:
        width = picture.shape[1]
        edge = round(min(1.0, max(0.0, shown.wipe)) * width)
        picture = np.concatenate([layers.pictures["plain"][:, :edge], picture[:, edge:]], 1)
    return np.ascontiguousarray(picture)
