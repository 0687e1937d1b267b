"""Streets that the package renders itself: one view in every palette, with one answer for all of them.

Photographs of one place by day and by night are rare; here the palette is the only difference. The teachers see the day,
and their word is drawn half-way to the mean of its class, which sharpens borders and makes other streets agree.
"""

from typing import Annotated, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ..town.layout import build_town
from ..town.palettes import PALETTES
from ..town.render import geometry, render, walk
from ..town.surface import CLASSES
from .ensemble import Ensemble, taught

__all__ = ["Streets", "render_streets", "street_targets"]

FIRST_SEED = 7000
"""Far from the seeds that users and tests take, so that no town is measured that was learned."""
VIEWS = 5
"""Views of each street, spread over the walk."""
TO_CLASS = 0.5
"""How far a target is drawn to the mean of its class."""


class Streets(NamedTuple):
    """V views in P palettes."""

    images: Annotated[Tensor, "V P 3 s s"]
    """Bytes; palettes in the order of `PALETTES`, day first."""
    classes: Annotated[Tensor, "V K t t"]
    """Share of each class in each cell."""


def render_streets(count: int, size: int, stride: int) -> Streets:
    """`count` streets, the same ones every time."""
    images, classes = [], []
    for number in range(count):
        town = build_town(FIRST_SEED + number)
        for view in walk(seed=FIRST_SEED + number, views=VIEWS, width=size, height=size):
            pictures = [render(town, view, look).rgb for look in PALETTES.values()]
            images.append(torch.from_numpy(np.stack(pictures)).permute(0, 3, 1, 2))
            label = torch.from_numpy(geometry(town, view)[1]).long()
            share = F.one_hot(label, len(CLASSES)).permute(2, 0, 1)[None].float()
            classes.append(F.avg_pool2d(share, stride)[0])
    return Streets(torch.stack(images), torch.stack(classes))


def street_targets(ensemble: Ensemble, streets: Streets, stride: int) -> Annotated[Tensor, "V C t t"]:
    """What the teachers say of each view by day, half-way to the mean of the cell's classes over all views."""
    said = torch.cat([taught(ensemble, views[:1].float() / 255, stride).cpu() for views in streets.images])
    weight = streets.classes.sum((0, 2, 3)).clamp_min(1e-6)  # a class that no view shows has no mean, and needs none
    mean = torch.einsum("vkij,vcij->kc", streets.classes, said) / weight[:, None]
    return torch.lerp(said, torch.einsum("vkij,kc->vcij", streets.classes, mean), TO_CLASS)
