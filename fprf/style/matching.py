"""Semantic correspondence (paper, Eq. 5 and 6): R = queries x keys^T, attention = softmax(R / temperature).

Each side is centred on its own mean, so that what all of a scene (or all references) have in common, such as night
against day, decides nothing. Temperatures are relative to the spread of the scores. At least float32, autocast or not.

Regions of a scene and style codes in one frame, before they are scored: what makes a region find its like.

Semantics of two sets of pictures differ by more than by what they show. A few directions hold most of the variance on either
side (sky against ground), so cosines say little of the rest: both sides are partly whitened, each by its own scatter,

    x'  =  (C / c + s I)^(-w/2) (x - m)        C the scatter of its keys, c its mean variance, w the share of whitening.

And the mean of the references depends on what they were pointed at: three photographs, two of façades, have a mean that
looks like a façade, from which trees point elsewhere than they do in the scene. So the codes' mean is taken again with the
weights at which the scene takes them, a few times over. Nothing is learnt, and either step can be left out.
"""

from typing import Annotated, Literal, NamedTuple

import torch
from torch import Tensor

from ..errors import ConfigError
from ..ops.precision import double, full_precision

Similarity = Literal["cosine", "dot"]

_FLAT = 1e-6
"""Below this share of what they were computed from, lengths and spreads are float32 rounding."""


def unit(x: Annotated[Tensor, "N D"], centre: Annotated[Tensor, "D"]) -> Annotated[Tensor, "N D"]:
    """Directions from the centre; what lies at the centre has none and becomes 0, which matches everything alike."""
    away = x - centre
    norm = torch.linalg.vector_norm(away, dim=-1, keepdim=True)
    flat = norm <= _FLAT * torch.linalg.vector_norm(centre)
    return torch.where(flat, 0.0, away / norm.clamp_min(torch.finfo(x.dtype).tiny))


def share_mean(keys: Annotated[Tensor, "T D"], share: Annotated[Tensor, "T"]) -> Annotated[Tensor, "D"]:
    """Mean of the keys by their shares: the centre of a set of codes."""
    with full_precision(keys):
        return (share / share.sum()) @ keys


def compared(
    queries: Annotated[Tensor, "N D"],
    keys: Annotated[Tensor, "T D"],
    similarity: Similarity,
    *,
    queries_centre: Annotated[Tensor, "D"],
    keys_centre: Annotated[Tensor, "D"],
) -> tuple[Annotated[Tensor, "N D"], Annotated[Tensor, "T D"]]:
    """Both sides, such that their inner products are the scores: cosines of the centred features, or plain dot products."""
    if similarity == "cosine":
        return unit(queries, queries_centre), unit(keys, keys_centre)
    # Softmax does not see what is subtracted from all keys; the smaller numbers round less.
    return queries, keys - keys_centre


def scores(queries: Annotated[Tensor, "N D"], keys: Annotated[Tensor, "T D"]) -> Annotated[Tensor, "N T"]:
    """The cross-correlation matrix R (paper, Eq. 5), in float32 or wider."""
    with full_precision(queries):
        return queries @ keys.T


def score_spread(queries: Annotated[Tensor, "N D"], keys: Annotated[Tensor, "T D"]) -> float:
    """Unit of the temperature: spread of the scores of a query between keys (rms); 1 where they never do.

    The unit cancels the encoder's scale and its contrast between things, both of which differ between encoders.
    """
    r = scores(double(queries), double(keys))
    spread = float((r - r.mean(1, keepdim=True)).square().mean().sqrt()) if r.numel() else 0.0
    return spread if spread > _FLAT * float(r.abs().max() if r.numel() else 0.0) else 1.0


def attention(
    queries: Annotated[Tensor, "N D"],
    keys: Annotated[Tensor, "T D"],
    temperature: float,
    prior: Annotated[Tensor, "T"] | None = None,
) -> Annotated[Tensor, "N T"]:
    """R^S (paper, Eq. 6): softmax of scores / temperature (absolute, above 0); rows sum to 1.

    `prior` > 0 multiplies each key's odds. Raises ConfigError for a temperature that is not above 0.
    """
    if not temperature > 0:
        raise ConfigError(f"temperature: {temperature} must be above 0")
    r = scores(queries, keys)
    # The best score is subtracted before dividing: tiny temperatures then give -inf beside it, never inf - inf.
    logits = (r - r.amax(1, keepdim=True)) / max(temperature, torch.finfo(r.dtype).tiny)
    return torch.softmax(logits if prior is None else logits + prior.log(), 1)


def point_shares(
    x: Annotated[Tensor, "N D"],
    keys: Annotated[Tensor, "T D"],
    temperature: float,
    *,
    centre: Annotated[Tensor, "D"] | None = None,
    prior: Annotated[Tensor, "T"] | None = None,
    faint: float = 0.0,
) -> Annotated[Tensor, "N T"]:
    """`attention` of the directions of points from a centre (None: of the points as they are), as renderers ask for it.

    Shares below `faint` of a point's largest become 0. Rows sum to 1. Within 4 (D + 4) u / temperature of the exact shares.
    """
    share = attention(x if centre is None else unit(x, centre), keys, temperature, prior)
    if faint > 0:
        share = torch.where(share < faint * share.amax(1, keepdim=True), 0.0, share)
        share = share / share.sum(1, keepdim=True)
    return share


_RIDGE = 0.1
"""Variance added to every direction before whitening, relative to the mean one: what hardly varies is not blown up."""


class Matching(NamedTuple):
    """Settings of the match between regions and codes."""

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

    def matched(queries: Annotated[Tensor, "K D"], keys: Annotated[Tensor, "T D"]) -> Annotated[Tensor, "K T"]:
        return attention(queries, keys, matching.temperature * score_spread(queries, keys), double(prior))

    if matching.similarity == "dot":
        centres = share_mean(*here), share_mean(*there)
        return matched(*compared(here.keys, there.keys, "dot", queries_centre=centres[0], keys_centre=centres[1]))
    if not matching.centred:
        zero = torch.zeros_like(here.keys[0]) if origin is None else double(origin)
        return matched(unit(here.keys, zero), unit(there.keys, zero))
    queries = _directions(here.keys, share_mean(*here), whitener(here, matching.whitening))
    white, weight = whitener(there, matching.whitening), there.share
    for _ in range(matching.recentred + 1):
        table = matched(queries, _directions(there.keys, share_mean(there.keys, weight), white))
        weight = here.share @ table
    return table


def whitener(side: Keys, whitening: float) -> Annotated[Tensor, "D D"]:
    """Matrix that partly whitens semantics of a side, float64 and symmetric; the identity where they do not vary, or for 0."""
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
