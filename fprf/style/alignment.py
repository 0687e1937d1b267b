"""Regions of a scene and style codes in one frame, before they are scored: what makes a region find its like.

Semantics of two sets of pictures differ by more than by what they show. A few directions hold most of the variance on either
side (sky against ground), so cosines say little of the rest: both sides are partly whitened, each by its own scatter,

    x'  =  (C / c + s I)^(-w/2) (x - m)        C the scatter of its keys, c its mean variance, w the share of whitening.

And the mean of the references depends on what they were pointed at: three photographs, two of façades, have a mean that
looks like a façade, from which trees point elsewhere than they do in the scene. So the codes' mean is taken again with the
weights at which the scene takes them, a few times over. Nothing is learnt, and either step can be left out.
"""

from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from .matching import Similarity, attention, compared, score_spread, share_mean, unit
from .statistics import double

__all__ = ["Keys", "Matching", "match_keys", "whitener"]

_RIDGE = 0.1
"""Variance added to every direction before whitening, relative to the mean one: what hardly varies is not blown up."""


class Matching(NamedTuple):
    """How regions and codes are matched."""

    temperature: float
    """Relative to the spread of the scores; above 0."""
    similarity: Similarity = "cosine"
    whitening: float = 0.0
    """In [0, 1]; 0 = semantics as they are."""
    recentred: int = 0
    """Times that the codes' mean is taken again; 0 = the mean of all of them."""
    centred: bool = True
    """Cosines are taken from the mean of each side; False = from the encoder's own origin, without whitening."""


class Keys(NamedTuple):
    """One side: semantic centroids and the share of their side that each stands for."""

    keys: Annotated[Tensor, "T D"]
    share: Annotated[Tensor, "T"]


def match_keys(
    here: Keys,
    there: Keys,
    matching: Matching,
    prior: Annotated[Tensor, "T"],
    origin: Annotated[Tensor, "D"] | None = None,
) -> Annotated[Tensor, "K T"]:
    """Share of each code in each region, float64; rows sum to 1. `prior` > 0 multiplies the odds of each code.

    `origin` is the encoder's, in the keys' own basis; None = 0. It counts where cosines are not centred: a single thing has
    no sky, so its mean says nothing about that of a landscape.

    With cosines, moving one side or rotating both changes nothing. Dot products are the paper's, and know no frame.
    """
    here, there = (Keys(double(side.keys), double(side.share) / double(side.share).sum()) for side in (here, there))
    if matching.similarity == "dot":
        centres = share_mean(*here), share_mean(*there)
        queries, keys = compared(here.keys, there.keys, "dot", queries_centre=centres[0], keys_centre=centres[1])
        return attention(queries, keys, matching.temperature * score_spread(queries, keys), double(prior))
    if not matching.centred:
        zero = torch.zeros_like(here.keys[0]) if origin is None else double(origin)
        queries, keys = unit(here.keys, zero), unit(there.keys, zero)
        return attention(queries, keys, matching.temperature * score_spread(queries, keys), double(prior))
    queries = _directions(here.keys, share_mean(*here), whitener(here, matching.whitening))
    white, weight = whitener(there, matching.whitening), there.share
    for _ in range(matching.recentred + 1):
        keys = _directions(there.keys, share_mean(there.keys, weight), white)
        table = attention(queries, keys, matching.temperature * score_spread(queries, keys), double(prior))
        weight = here.share @ table
    return table


def whitener(side: Keys, whitening: float) -> Annotated[Tensor, "D D"]:
    """What partly whitens semantics of a side, float64 and symmetric; the identity where they do not vary, or for 0."""
    away = double(side.keys) - share_mean(double(side.keys), double(side.share))
    scatter = (away * (double(side.share) / double(side.share).sum())[:, None]).T @ away
    unity, size = torch.eye(len(scatter)).to(scatter), scatter.diagonal().mean()
    if whitening == 0 or not bool(size > 0):
        return unity
    values, vectors = torch.linalg.eigh(scatter / size + _RIDGE * unity)
    root: Tensor = (vectors * values.clamp_min(_RIDGE) ** (-whitening / 2)) @ vectors.T
    return root


def _directions(x: Tensor, centre: Tensor, white: Tensor) -> Annotated[Tensor, "N D"]:
    """Directions from the centre, whitened; of what lies at the centre there is none (0)."""
    return unit(unit(x, centre) @ white, torch.zeros_like(centre))
