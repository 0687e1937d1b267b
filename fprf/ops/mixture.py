"""Points in mixtures: shares in regions or codes, and the maps of these, mixed.

Each function is the compiled form of the plain torch that its caller holds beside it, and defines nothing:
`usable` says where it applies. In a view of fox with 94 000 samples, two cores, milliseconds of plain torch and
compiled: memberships 6.5 and 2.7, `region-ot` with its memberships 39 and 12, confidence 20.5 and 4.6, maps of
colours 7.2 and 0.8.

Letters: N points, D channels of semantics, K keys (regions or codes), C content channels.
"""

# The checker takes compiled functions to have one argument.
# mypy: disable-error-code="call-arg"

from collections.abc import Sequence
from typing import Annotated, NamedTuple

import numpy as np
import torch
from torch import Tensor

from .dense import Floats, array, usable

__all__ = ["NearestCodes", "affine", "coloured", "nearest", "nearest_codes", "scaled", "shares", "usable"]
_NO_KEY = -1e30
"""Score of the padding of keys: below that of any key."""


def shares(
    x: Annotated[Tensor, "N D"],
    keys: Annotated[Tensor, "K D"],
    temperature: float,
    *,
    centre: Annotated[Tensor, "D"] | None,
    least: float,
    prior: Annotated[Tensor, "K"] | None,
    faint: float,
) -> Annotated[Tensor, "N K"]:
    """`style.matching.point_shares`; what lies within `least` of the centre has no direction."""
    from . import mixture_kernels as kernels

    count = len(keys)
    table = _padded(keys.T)
    width = table.shape[1]
    odds = keys.new_zeros(2, width)
    odds[0, count:] = _NO_KEY
    if prior is not None:
        odds[1, :count] = prior.log()
    sharpness = 1 / max(temperature, torch.finfo(torch.float32).tiny)
    out = torch.empty(len(x), count)
    kernels.attention(
        array(x), array(torch.zeros_like(keys[0]) if centre is None else centre),
        np.float32(-1 if centre is None else least), array(table), array(odds),
        (np.float32(sharpness), np.float32(faint)), out.view(-1).numpy(),
    )  # fmt: skip
    return out


def scaled(
    x: Annotated[Tensor, "N C"],
    centre: Annotated[Tensor, "C"],
    share: Annotated[Tensor, "N K"],
    gain: Annotated[Tensor, "K C"],
    bias: Annotated[Tensor, "K C"],
) -> Annotated[Tensor, "N C"]:
    """(x - centre) (share gain) + share bias, channel by channel."""
    from . import mixture_kernels as kernels

    gains = _padded(gain)
    table = torch.cat([gains, _padded(bias)], 1)
    out = torch.empty_like(x, memory_format=torch.contiguous_format)
    kernels.scaled(
        array(x), array(centre), array(share), array(table), gains.shape[1], out.view(-1).numpy()
    )  # fmt: skip
    return out


def affine(
    x: Annotated[Tensor, "N C"],
    centre: Annotated[Tensor, "C"],
    share: Annotated[Tensor, "N K"],
    matrix: Annotated[Tensor, "K C C"],
    bias: Annotated[Tensor, "K C"],
) -> Annotated[Tensor, "N C"]:
    """sum_k share_k ((x - centre) matrix_k + bias_k); maps without a share are not computed."""
    from . import mixture_kernels as kernels

    maps = _padded(torch.cat([matrix, bias[:, None]], 1))
    width = maps.shape[-1]
    out = torch.empty(len(x), width)
    kernels.affine(array(x), array(centre), array(share), array(maps), width, out.view(-1).numpy())
    if width == x.shape[1]:
        return out
    return out[:, : x.shape[1]].contiguous()


def coloured(
    colour: Annotated[Tensor, "N 3"],
    share: Annotated[Tensor, "N K"],
    matrix: Annotated[Tensor, "K 3 3"],
    bias: Annotated[Tensor, "K 3"],
) -> Annotated[Tensor, "N 3"]:
    """sum_k share_k (colour matrix_k + bias_k), of colours: maps are mixed before they are applied."""
    from . import mixture_kernels as kernels

    maps = _padded(torch.cat([matrix.flatten(1), bias], 1))
    out = torch.empty(len(colour), 3)
    kernels.coloured(array(colour), array(share), array(maps), maps.shape[1], out.view(-1).numpy())
    return out


class NearestCodes(NamedTuple):
    """Codes of references as `nearest` takes them."""

    keys: Floats
    """Directions of the codes from the centre, and from the middle of their reference, times what is shown of
    each: [2, references, D, width].
    """
    table: Floats
    """0 for codes and far below any cosine for what fills their place; their sizes: [2, references, width]."""


def nearest_codes(
    keys: Sequence[Annotated[Tensor, "T D"]],
    middle_keys: Sequence[Annotated[Tensor, "T D"]],
    sizes: Sequence[Annotated[Tensor, "T"]],
) -> NearestCodes:
    """The codes of each reference, as seen from the centre and from its middle, and their sizes.

    Of a reference's codes the nearest are taken until their sizes sum to 1.
    """
    width = max(_padded(each.T).shape[1] for each in keys)
    directions = []
    for each in (*keys, *middle_keys):
        directions.append(_padded(each.T, width))
    table = torch.zeros(2, len(keys), width)
    table[0] = _NO_KEY
    for i, size in enumerate(sizes):
        table[0, i, : len(size)] = 0
        table[1, i, : len(size)] = size
    return NearestCodes(array(torch.stack(directions)), array(table))


def nearest(
    x: Annotated[Tensor, "N D"],
    views: Annotated[Tensor, "1+references D"],
    codes: NearestCodes,
    *,
    least: Annotated[Tensor, "1+references"],
    lower: Annotated[Tensor, "N references"] | None,
) -> Annotated[Tensor, "N"]:
    """The largest of all references' mean cosines of a point with their nearest codes.

    A cosine is the lesser of those from the centre, the first of `views`, and from the middle of the
    reference, behind it. What lies within `least` of one of them has no direction. `lower` is subtracted.
    """
    from . import mixture_kernels as kernels

    out = torch.empty(len(x))
    less = array(out[:0] if lower is None else lower)
    kernels.nearest(array(x), array(views), array(least), *codes, less, out.numpy())
    return out


def _padded(table: Tensor, width: int | None = None) -> Tensor:
    """A table with zeros up to whole vectors, or to `width`, in its last dimension."""
    from .simd import WIDE

    columns = table.shape[-1]
    goal = -(-columns // WIDE) * WIDE if width is None else width
    return torch.nn.functional.pad(table, (0, goal - columns))
