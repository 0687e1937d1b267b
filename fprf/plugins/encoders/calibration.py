"""Pictures on which encoders are measured: the embedded town, a view in each of its palettes, always the same.

Noise with the spectrum of photographs is no substitute: deep filters that answer to edges and things hardly fire on it.
"""

from functools import cache
from typing import Annotated

import numpy as np
import torch
from torch import Tensor

from ...town.layout import build_town
from ...town.palettes import PALETTES
from ...town.render import render, walk

__all__ = ["street"]

WIDTH, HEIGHT = 160, 128


@cache
def street() -> Annotated[Tensor, "B 3 H W"]:
    """Sky, plants, walls and a road, from day to night; made once, in half a second."""
    town, views = build_town(0), walk(seed=0, views=len(PALETTES), width=WIDTH, height=HEIGHT)
    pictures = [render(town, view, look).rgb for view, look in zip(views, PALETTES.values(), strict=True)]
    return torch.from_numpy(np.stack(pictures)).permute(0, 3, 1, 2).float() / 255
