"""Did every place take the style of its own kind? Style codes get the true class of the pixels that they were made of.

A code's class is the most frequent one among the reference's pixels that lie nearest to its key. A pixel of a view is right
if the code that it takes most of is of its own true class. Classes that no reference shows cannot be right and don't count.
"""

from collections.abc import Mapping, Sequence
from typing import Annotated, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from ..datamanagers.config import GuidedConfig
from ..errors import DataError
from ..evaluation.flat import encoded
from ..style.dictionary import StyleDictionary
from ..style.references import Encoders
from ..town.surface import CAR, DOOR, FACADE, FOLIAGE, LAMP, LAWN, ROAD, ROOF, SIDEWALK, SKY, TRUNK, WINDOW
from .references import Reference

__all__ = ["KINDS", "Matched", "code_classes", "interior", "match_rates", "winners"]

KINDS = {SKY: 0, LAWN: 1, FOLIAGE: 1, TRUNK: 1, ROAD: 2, SIDEWALK: 2, FACADE: 3, ROOF: 3, WINDOW: 3, DOOR: 3, LAMP: 4, CAR: 5}
"""Classes that belong together: sky, plants, ground, buildings, lamps, cars."""
_SHOWN = 0.005
"""Share of a reference from which on it shows a class."""
_REACH = 2
"""Pixels around one that must be of its class for it to lie inside."""


class Matched(NamedTuple):
    """Rates in [0, 1]; None where no pixel could be right."""

    match: float | None
    """Pixels that take a code of their own class."""
    match_inside: float | None
    """The same of pixels that are no nearer than two pixels to another class: encoders see cells, not pixels."""
    match_border: float | None
    """The same of the other pixels: how sharply what is told apart is told apart."""
    match_kind: float | None
    """Pixels that take a code of their own kind (see KINDS)."""


@torch.no_grad()
def code_classes(
    dictionary: StyleDictionary, references: Mapping[str, Reference], encoders: Encoders, guided: GuidedConfig
) -> Annotated[Tensor, "T"]:
    """Class of each code, int64. References go by the dictionary's names. Raises DataError where semantics are missing."""
    if encoders.semantic is None or encoders.basis is None:
        raise DataError("match rates: the scene has no semantics; train it with a semantic encoder")
    found = torch.full((len(dictionary.keys),), -1, dtype=torch.int64)
    for i, name in enumerate(dictionary.names):
        own = (dictionary.reference == i).nonzero().squeeze(1)
        semantic = encoded(references[name].image.to(encoders.device), encoders.semantic, guided, encoders.basis)
        nearest = torch.cdist(semantic, dictionary.keys[own].to(semantic)).argmin(1).cpu()
        for place, code in enumerate(own.tolist()):
            kinds = references[name].classes.flatten()[nearest == place]
            if len(kinds):
                found[code] = int(kinds.mode().values)
    return found


def winners(share: Annotated[Tensor, "N T"], classes: Annotated[Tensor, "T"]) -> Annotated[Tensor, "N"]:
    """Class of the code that each pixel takes most of; the first of several that are alike."""
    return classes[share.argmax(1)]


def interior(labels: Annotated[Tensor, "H W"]) -> Annotated[Tensor, "H W"]:
    """Pixels whose surroundings are all of their own class, bool."""
    side = 2 * _REACH + 1
    padded = F.pad(labels[None, None].double(), (_REACH,) * 4, mode="replicate")
    highest, lowest = F.max_pool2d(padded, side, 1), -F.max_pool2d(-padded, side, 1)
    return (highest == lowest)[0, 0]


def match_rates(
    found: Sequence[Annotated[Tensor, "H W"]], truth: Sequence[Annotated[Tensor, "H W"]], references: Sequence[Reference]
) -> Matched:
    """Rates over all pixels of the views together."""
    counted = [torch.bincount(reference.classes.flatten()) for reference in references]
    shown = sorted({k for each in counted for k in (each >= _SHOWN * each.sum()).nonzero().flatten().tolist()})
    taken, true = torch.cat([x.flatten() for x in found]), torch.cat([x.flatten() for x in truth])
    counts = torch.isin(true, torch.tensor(shown))
    inside = torch.cat([interior(x).flatten() for x in truth])
    kind = torch.full((max(KINDS) + 2,), -1)  # the last one stands for codes without a class
    kind[list(KINDS)] = torch.tensor(list(KINDS.values()))
    return Matched(
        _rate(taken == true, counts),
        _rate(taken == true, counts & inside),
        _rate(taken == true, counts & ~inside),
        _rate(kind[taken] == kind[true], counts),
    )


def _rate(right: Tensor, counts: Tensor) -> float | None:
    return float(right[counts].double().mean()) if bool(counts.any()) else None
