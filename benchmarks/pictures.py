"""Contact sheets of the repository's pages, and references of their own: another town than the scene's in another light."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from fprf.io.images import Picture, to_uint8

from .town.layout import build_town
from .town.palettes import palette
from .town.render import render, walk

BAR = 18
GAP = 4


def cell(picture: Picture, name: str, height: int) -> Picture:
    width = max(1, round(picture.shape[1] * height / picture.shape[0]))
    smaller = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
    made = np.full((height + BAR + GAP, width + GAP, 3), 255, dtype=np.uint8)
    made[:height, :width] = smaller
    cv2.putText(made, name, (2, height + 13), cv2.FONT_HERSHEY_SIMPLEX, 0.38, (40, 40, 40), 1, cv2.LINE_AA)
    return made


def sheet(rows: Sequence[Mapping[str, Tensor]], height: int = 144) -> Picture:
    """Rows of pictures [H W 3] in [0, 1] by name."""
    lines = [np.concatenate([cell(to_uint8(image), name, height) for name, image in row.items()], axis=1) for row in rows]
    width = max(line.shape[1] for line in lines)
    padded = [np.pad(line, ((0, 0), (0, width - line.shape[1]), (0, 0)), constant_values=255) for line in lines]
    return np.concatenate(padded, axis=0)


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
