"""Semantic matching (paper, section on semantic matching): which style codes points and regions take.

Letters: N points or queries, D semantic channels, T style codes with a key each, K regions of a scene with a
key each. Semantics are vectors [D] in the scene's semantic basis, without a unit; scores are cosines in [-1,
1], or dot products; shares are in [0, 1]. At least float32; tables of regions are float64.

    R = queries x keys^T                        cross-correlation             paper, Eq. 5
    R^S = softmax(R / temperature)              attention, rows sum to 1      paper, Eq. 6
    M_w = R^S M,  Sigma_w = R^S Sigma           style of each row             paper, Eq. 6 (plugins/stylizers)

The paper matches points with codes by dot products at temperature 1. Three things are ours, and each can be
left out:

- Cosines: both sides are directions from a centre, each side's own mean, so that what all of a scene (or all
  references) have in common, such as night against day, decides nothing. Temperatures are relative to the
  spread of the scores.
- Whitening: a few directions hold most of the variance on either side (sky against ground), so cosines say
  little of the rest. Both sides are partly whitened, each by its own scatter,

      x'  =  (C / c + s I)^(-w/2) (x - m)        C the scatter of its keys, m their mean, c their mean variance,
                                                 s = `_WHITENING_RIDGE`, w the share of whitening.

- Recentring: the mean of the references depends on what they were pointed at: three photographs, two of
  façades, have a mean that looks like a façade, from which trees point elsewhere than they do in the scene.
  So the codes' mean is taken again with the weights at which the scene takes them.
"""

from typing import Annotated

import torch
from torch import Tensor

from ..ops import mixture
from ..ops.backend import double

_ROUNDING_SHARE = 1e-6
"""Below this share of what they were computed from, lengths and spreads are float32 rounding."""
_WHITENING_RIDGE = 0.1
"""Variance added to every direction before whitening, relative to the mean one: what hardly varies is not
blown up.
"""


def unit(x: Annotated[Tensor, "N D"], centre: Annotated[Tensor, "D"]) -> Annotated[Tensor, "N D"]:
    """Directions from the centre; what lies at the centre has none and becomes 0, which matches everything
    alike.
    """
    away = x - centre
    norm = torch.linalg.vector_norm(away, dim=-1, keepdim=True)
    return torch.where(norm <= no_direction(centre), 0.0, away / norm.clamp_min(torch.finfo(x.dtype).tiny))


def no_direction(centre: Annotated[Tensor, "... D"]) -> Annotated[Tensor, "..."]:
    """Distance from a centre up to which nothing has a direction: what is left of it is rounding."""
    length: Tensor = torch.linalg.vector_norm(centre, dim=-1)
    return _ROUNDING_SHARE * length


def share_mean(keys: Annotated[Tensor, "T D"], share: Annotated[Tensor, "T"]) -> Annotated[Tensor, "D"]:
    """Mean of the keys by their shares: the centre of a set of codes."""
    return (share / share.sum()) @ keys


def scores(queries: Annotated[Tensor, "N D"], keys: Annotated[Tensor, "T D"]) -> Annotated[Tensor, "N T"]:
    """The cross-correlation matrix R (paper, Eq. 5), in float32 or wider."""
    return queries @ keys.T


def score_spread(queries: Annotated[Tensor, "N D"], keys: Annotated[Tensor, "T D"]) -> float:
    """Unit of the temperature: spread of the scores of a query between keys (rms); 1 where they never differ.

    The unit cancels the encoder's scale and its contrast between things, both of which differ between
    encoders.
    """
    r = scores(double(queries), double(keys))
    if not r.numel():
        return 1.0
    spread = float((r - r.mean(1, keepdim=True)).square().mean().sqrt())
    if spread > _ROUNDING_SHARE * float(r.abs().max()):
        return spread
    return 1.0


def attention(
    queries: Annotated[Tensor, "N D"],
    keys: Annotated[Tensor, "T D"],
    temperature: float,
    prior: Annotated[Tensor, "T"] | None = None,
) -> Annotated[Tensor, "N T"]:
    """R^S (paper, Eq. 6): softmax of scores / temperature (absolute, above 0); rows sum to 1.

    `prior` > 0 multiplies each key's odds.
    """
    r = scores(queries, keys)
    # The best score is subtracted before dividing: tiny temperatures then give -inf beside it, never inf -
    # inf.
    logits = (r - r.amax(1, keepdim=True)) / max(temperature, torch.finfo(r.dtype).tiny)
    if prior is not None:
        logits = logits + prior.log()
    return torch.softmax(logits, 1)


def point_shares(
    x: Annotated[Tensor, "N D"],
    keys: Annotated[Tensor, "T D"],
    temperature: float,
    *,
    centre: Annotated[Tensor, "D"] | None = None,
    prior: Annotated[Tensor, "T"] | None = None,
    faint: float = 0.0,
) -> Annotated[Tensor, "N T"]:
    """`attention` of the directions of points from a centre (None: of the points as they are), as renderers
    ask for it.

    Shares below `faint` of a point's largest become 0. Rows sum to 1. Rounding errors are at most
    4 (D + 4) u / temperature, u the unit roundoff of the points' type.
    """
    given = [each for each in (x, keys, centre, prior) if each is not None]
    if mixture.usable(*given):
        least = 0.0 if centre is None else no_direction(centre)
        return mixture.shares(
            x, keys, temperature, centre=centre, least=float(least), prior=prior, faint=faint
        )
    if centre is not None:
        x = unit(x, centre)
    share = attention(x, keys, temperature, prior)
    if faint > 0:
        share = torch.where(share < faint * share.amax(1, keepdim=True), 0.0, share)
        share = share / share.sum(1, keepdim=True)
    return share


def match_keys(
    regions: Annotated[Tensor, "K D"],
    region_share: Annotated[Tensor, "K"],
    codes: Annotated[Tensor, "T D"],
    code_share: Annotated[Tensor, "T"],
    prior: Annotated[Tensor, "T"],
    *,
    temperature: float,
    whitening: float = 0.0,
    recentred: int = 0,
    centred: bool = True,
    origin: Annotated[Tensor, "D"] | None = None,
) -> Annotated[Tensor, "K T"]:
    """Share of each code in each region, float64; rows sum to 1. `prior` > 0 multiplies the odds of each
    code.

    Both sides are keys and the share of their side that each stands for. `temperature` is relative to the
    spread of the scores, above 0; `whitening` in [0, 1], 0 = semantics as they are; `recentred` is how often
    the codes' mean is taken again. With `centred` False cosines are taken from the encoder's own zero
    (`origin`, in the keys' basis; None = 0), without whitening: a single thing has no sky, so its mean says
    nothing about that of a landscape.

    Moving one side or rotating both changes nothing.
    """
    # Shares of each side sum to 1, in float64: the tables are small and decide everything that follows.
    regions = double(regions)
    region_share = double(region_share) / double(region_share).sum()
    codes = double(codes)
    code_share = double(code_share) / double(code_share).sum()

    def matched(
        queries: Annotated[Tensor, "K D"], keys: Annotated[Tensor, "T D"]
    ) -> Annotated[Tensor, "K T"]:
        """Eq. 5 and 6 at a temperature in units of the scores' own spread."""
        return attention(queries, keys, temperature * score_spread(queries, keys), double(prior))

    # Plain cosines, for single things: both sides are seen from the encoder's zero.
    if not centred:
        if origin is None:
            zero = torch.zeros_like(regions[0])
        else:
            zero = double(origin)
        return matched(unit(regions, zero), unit(codes, zero))

    def directions(x: Tensor, centre: Tensor, white: Tensor) -> Annotated[Tensor, "N D"]:
        """Whitened directions from the centre; of what lies at the centre there is none (0)."""
        return unit(unit(x, centre) @ white, torch.zeros_like(centre))

    # The default: each side is whitened by its own scatter and seen from its own mean.
    queries = directions(
        regions, share_mean(regions, region_share), whitener(regions, region_share, whitening)
    )
    white = whitener(codes, code_share, whitening)
    weight = code_share
    for _ in range(recentred + 1):
        table = matched(queries, directions(codes, share_mean(codes, weight), white))
        # Recentring: in the next mean each code counts by how much of the scene has taken it, p = share of
        # regions x R^S.
        weight = region_share @ table
    return table


def whitener(
    keys: Annotated[Tensor, "T D"], share: Annotated[Tensor, "T"], whitening: float
) -> Annotated[Tensor, "D D"]:
    """Matrix that partly whitens semantics of a side, float64 and symmetric; the identity where they do not
    vary, or for 0.
    """
    away = double(keys) - share_mean(double(keys), double(share))
    scatter = (away * (double(share) / double(share).sum())[:, None]).T @ away
    unity = torch.eye(len(scatter)).to(scatter)
    size = scatter.diagonal().mean()
    if whitening == 0 or not bool(size > 0):
        return unity
    values, vectors = torch.linalg.eigh(scatter / size + _WHITENING_RIDGE * unity)
    root: Tensor = (vectors * values.clamp_min(_WHITENING_RIDGE) ** (-whitening / 2)) @ vectors.T
    return root
