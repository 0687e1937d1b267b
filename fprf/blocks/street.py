"""Segments along the cameras' path. The path is halved across its own direction until the segments are short enough.

Halving looks at places only, so a street that was driven there and back is cut once, and a bend turns the segments with it.
A segment reaches to the planes that cut it off, is as wide and high as what was found there, and at the ends of the path
goes on for the distance that views commonly see.
"""

import math
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ..fields.layouts import StreetConfig
from ..interfaces import BlockLayout
from ..types import Boxes, Site
from .region import REACH, within

__all__ = ["StreetLayout"]


class _Plane(NamedTuple):
    """A cut: the segment lies where (x - point) . normal <= 0."""

    point: Annotated[Tensor, "3"]
    normal: Annotated[Tensor, "3"]


class _Stretch(NamedTuple):
    """Cameras of a part of the path, and what cuts it off."""

    cameras: Annotated[Tensor, "M"]
    planes: tuple[_Plane, ...]


class StreetLayout(BlockLayout):
    """Turned boxes in a row."""

    def __init__(self, config: StreetConfig) -> None:
        self.config = config

    def cut(self, site: Site) -> Boxes:
        """The segments, in the order of the path."""
        stretches = self._stretches(site)
        boxes = [_box(site, stretch) for stretch in stretches]
        low, high, turn, free = (torch.stack(parts) for parts in zip(*boxes, strict=True))
        margin = self.config.margin * float((high - low)[:, 0].amin()) if len(boxes) > 1 else 0.0
        # What is found beside the street, or at its ends, lies inside its block.
        return Boxes(low - margin * free[:, 0], high + margin * free[:, 1], turn, margin)

    def _stretches(self, site: Site) -> list[_Stretch]:
        whole = _Stretch(torch.arange(len(site.position)), ())
        if self.config.length is None:
            return _parts(site, whole, self.config.segments)
        return _short(site, whole, self.config.length / site.unit)


def _parts(site: Site, stretch: _Stretch, count: int) -> list[_Stretch]:
    """So many parts of equal length; fewer, where cameras are."""
    count = min(count, len(stretch.cameras))
    if count < 2 or _extent(site, stretch) <= 0:
        return [stretch]
    first, second = _halve(site, stretch, (count // 2) / count)
    return _parts(site, first, count // 2) + _parts(site, second, count - count // 2)


def _short(site: Site, stretch: _Stretch, longest: float) -> list[_Stretch]:
    """Parts of equal length none of which is longer; a bend shows as it is halved, and is then measured anew."""
    count = math.ceil(_extent(site, stretch) / longest)
    if min(count, len(stretch.cameras)) < 2:
        return [stretch]
    return [part for half in _halve(site, stretch, (count // 2) / count) for part in _short(site, half, longest)]


def _axis(position: Annotated[Tensor, "M 3"]) -> Annotated[Tensor, "3"]:
    """The level direction along which cameras spread most, onwards along axis 0 (else along axis 1)."""
    flat = position[:, :2] - position[:, :2].mean(0)
    along = torch.linalg.svd(flat, full_matrices=False).Vh[0] if len(flat) > 1 else flat.new_tensor([1.0, 0.0])
    if along[0] < -1e-9 or (abs(float(along[0])) <= 1e-9 and along[1] < 0):
        along = -along
    return torch.cat([along, along.new_zeros(1)])


def _extent(site: Site, stretch: _Stretch) -> float:
    here = site.position[stretch.cameras]
    along = here @ _axis(here)
    return float(along.amax() - along.amin())


def _halve(site: Site, stretch: _Stretch, share: float) -> list[_Stretch]:
    """Two parts of a stretch, cut across it at a share of its length."""
    here = site.position[stretch.cameras]
    axis = _axis(here)
    along = here @ axis
    at = along.amin() + share * (along.amax() - along.amin())
    middle = here.mean(0)
    point = middle + (at - middle @ axis) * axis
    first = along <= at
    return [
        _Stretch(stretch.cameras[first], (*stretch.planes, _Plane(point, axis))),
        _Stretch(stretch.cameras[~first], (*stretch.planes, _Plane(point, -axis))),
    ]


def _box(site: Site, stretch: _Stretch) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Low, high and turn of a segment, and [2 3] which of its low and high faces no other segment shares."""
    here = site.position[stretch.cameras]
    axis = _axis(here)
    up = axis.new_tensor([0.0, 0.0, 1.0])
    turn = torch.stack([axis, torch.linalg.cross(up, axis), up])
    local = here @ turn.T
    low, high = local.amin(0) - REACH, local.amax(0) + REACH
    for plane in stretch.planes:
        slope = float(plane.normal @ axis)
        if abs(slope) < 0.5:  # a cut along the segment says nothing about where it ends
            continue
        ends = float((plane.point - here.mean(0)) @ plane.normal) / slope + float(here.mean(0) @ axis)
        # A cut that is not quite across leaves some of the segment's own cameras beyond it.
        if slope > 0:
            high[0] = min(float(high[0]), max(ends, float(local[:, 0].amax())))
        else:
            low[0] = max(float(low[0]), min(ends, float(local[:, 0].amin())))
    cuts = low.clone(), high.clone()
    turned = Site(site.position @ turn.T, site.rays, site.points @ turn.T, site.unit)
    low, high = within(turned, low, high)
    free = low.new_ones(2, 3)
    if any(float(plane.normal @ axis) < -0.5 for plane in stretch.planes):
        low[0], free[0, 0] = cuts[0][0], 0.0
    if any(float(plane.normal @ axis) > 0.5 for plane in stretch.planes):
        high[0], free[1, 0] = cuts[1][0], 0.0
    return low, high, turn, free
