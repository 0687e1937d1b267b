"""References whose truth is known: other towns, photographed in another light, from places that nobody chose by eye.

`one` is a single view along a street. `three` are three photographs of three towns that share the work: one shows mostly
façades, one mostly plants, one road and sky. Each is the view of its town, among those of a walk, some with a longer lens, that
shows most of its part.
"""

from collections.abc import Sequence
from typing import Annotated, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..town.layout import build_town
from ..town.palettes import palette
from ..town.render import View, geometry, render, walk
from ..town.surface import DOOR, FACADE, FOLIAGE, LAWN, ROAD, SIDEWALK, SKY, TRUNK, WINDOW

__all__ = ["PARTS", "Place", "Reference", "photograph", "places", "shows"]

PARTS = {"facades": (FACADE, WINDOW, DOOR), "plants": (FOLIAGE, LAWN, TRUNK), "street": (ROAD, SIDEWALK, SKY)}
"""What each of three references shows most of."""
_WALK = 20
_STREET_VIEW = 9
"""The view of the walk that stands for a whole street."""
_LENS = {"facades": 2.4, "plants": 2.4, "street": 1.0}
"""Focal length of the searching views, relative to the usual: façades and plants fill the frame."""
_SEARCHED = 40
"""Pixels across a view while its classes are counted."""


class Place(NamedTuple):
    """Where a reference is photographed."""

    name: str
    seed: int
    view: View


class Reference(NamedTuple):
    """A photograph of a place in some light."""

    name: str
    image: Annotated[Tensor, "H W 3"]
    classes: Annotated[Tensor, "H W"]


def places(seeds: Sequence[int], size: tuple[int, int]) -> dict[str, tuple[Place, ...]]:
    """The places of `one` and `three` in towns of these seeds; size is (width, height)."""
    width, height = size
    street = walk(seed=seeds[0], views=_WALK, width=width, height=height)[_STREET_VIEW]
    found = {"one": (Place("street", seeds[0], street),), "three": ()}
    return found | {"three": tuple(_most(part, seed, size) for part, seed in zip(PARTS, seeds, strict=False))}


def photograph(place: Place, light: str) -> Reference:
    """The place in a palette. Raises DataError for a palette that does not exist."""
    picture = render(build_town(place.seed), place.view, palette(light))
    image = torch.from_numpy(picture.rgb).float() / 255
    return Reference(f"{light}-{place.name}", image, torch.from_numpy(picture.labels.astype("int64")))


def shows(labels: NDArray[np.uint8], part: str) -> float:
    """Share of a view that its part fills; of several things that must all be seen, counts the one seen least."""
    shares = [float(np.mean(labels == kind)) for kind in PARTS[part]]
    return sum(shares) if part != "street" else 2 * min(shares[0] + shares[1], shares[2])


def _most(part: str, seed: int, size: tuple[int, int]) -> Place:
    width, height = size
    town = build_town(seed)
    best, place = -1.0, None
    for view in walk(seed=seed, views=_WALK, width=width, height=height):
        long = view._replace(focal=view.focal * _LENS[part])
        ratio = _SEARCHED / width
        small = View(long.pose, long.focal * ratio, _SEARCHED, max(1, round(height * ratio)))
        seen = shows(geometry(town, small)[1], part)
        if seen > best:
            best, place = seen, Place(part, seed, long)
    assert place is not None
    return place
