"""References that may be shown: another town than the scene's, rendered in another light, with the true classes."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from fprf.town.layout import build_town
from fprf.town.palettes import palette
from fprf.town.render import render, walk

SEED, WALK, VIEW = 7, 10, 4
"""The town, the length of the walk and the view of it that is shown."""
SETS: Sequence[tuple[str, ...]] = (
    ("autumn",),
    ("winter",),
    ("sunset",),
    ("night",),
    ("autumn", "night"),
    ("winter", "sunset"),
)
"""Six references: four lights, and two at once."""


class TownReference(NamedTuple):
    name: str
    image: Tensor
    classes: Tensor


def town_reference(name: str, *, seed: int = SEED, view: int = VIEW, size: tuple[int, int] = (384, 288)) -> TownReference:
    """A view of the town in a palette; size is (width, height)."""
    camera = walk(seed=seed, views=WALK, width=size[0], height=size[1])[view]
    picture = render(build_town(seed), camera, palette(name))
    return TownReference(name, torch.from_numpy(picture.rgb).float() / 255, torch.from_numpy(picture.labels.astype("int64")))
