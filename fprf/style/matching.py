"""Semantic correspondence (paper, Eq. 5 and 6): R = queries x keys^T, attention = softmax(R / temperature).

Each side is centred on its own mean, so that what all of a scene (or all references) have in common, such as night
against day, decides nothing. Temperatures are relative to the spread of the scores. At least float32, autocast or not.
"""

from typing import Annotated, Literal

import torch
from torch import Tensor

from ..errors import ConfigError
from ..ops import mixture
from ..ops.dense import usable
from ..ops.precision import full_precision
from .statistics import double

__all__ = [
    "Similarity",
    "attention",
    "compared",
    "point_shares",
    "score_spread",
    "scores",
    "share_mean",
    "unit",
]

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
    """What temperature 1 means: how much the scores of a query differ between keys (rms); 1 where they never do.

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
    if usable(x) and keys.dtype == torch.float32 and len(x) > 0 and temperature > 0:
        flat = 0.0 if centre is None else _FLAT * float(torch.linalg.vector_norm(centre))
        return mixture.attention(x, keys, temperature, centre=centre, flat=flat, prior=prior, faint=faint)
    share = attention(x if centre is None else unit(x, centre), keys, temperature, prior)
    if faint > 0:
        share = torch.where(share < faint * share.amax(1, keepdim=True), 0.0, share)
        share = share / share.sum(1, keepdim=True)
    return share
