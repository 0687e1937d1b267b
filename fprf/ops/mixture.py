"""Points in mixtures: shares in regions or codes, and the maps of these, mixed.

Each function is the compiled form of the plain torch that its caller holds beside it, and defines nothing:
`usable` says where it applies. On 95 000 points, two cores, against plain torch: shares 3, maps of channels 4,
matrices 2, nearest codes 5 times as fast.

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
    padding = keys.new_full((width,), _NO_KEY)
    padding[:count] = 0
    odds = keys.new_zeros(width)
    if prior is not None:
        odds[:count] = prior.log()
    out = torch.empty(len(x), count)
    kernels.attention(
        array(x), array(torch.zeros_like(keys[0]) if centre is None else centre),
        np.float32(-1 if centre is None else least), array(table), width, array(padding), array(odds),
        np.float32(1 / max(temperature, torch.finfo(torch.float32).tiny)), np.float32(faint), out.view(-1).numpy(),
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
    out = torch.empty_like(x, memory_format=torch.contiguous_format)
    kernels.scaled(
        array(x), array(centre), array(share), array(gains), array(_padded(bias)), gains.shape[1], out.view(-1).numpy()
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

    shifts = _padded(bias)
    width = shifts.shape[1]
    out = torch.empty(len(x), width)
    kernels.affine(
        array(x), array(centre), array(share), array(_padded(matrix)), array(shifts), width, out.view(-1).numpy()
    )  # fmt: skip
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

    codes: np.ndarray[tuple[int], np.dtype[np.int64]]
    """First code of each reference, and behind the last."""
    keys: Floats
    """Directions of the codes from the centre, times what is shown of each: [references, D, width]."""
    middle_keys: Floats
    """The same from the middle of each reference."""
    padding: Floats
    """0 for codes, far below any cosine for what fills their place: [references, width]."""
    sizes: Floats
    """Share of each code in its reference."""
    width: int


def nearest_codes(
    keys: Sequence[Annotated[Tensor, "T D"]],
    middle_keys: Sequence[Annotated[Tensor, "T D"]],
    sizes: Sequence[Annotated[Tensor, "T"]],
) -> NearestCodes:
    """The codes of each reference, as seen from the centre and from its middle, and their sizes."""
    width = max(_padded(each.T).shape[1] for each in keys)
    ends = np.cumsum([0] + [len(each) for each in keys])
    tables = []
    for side in (keys, middle_keys):
        tables.append(array(torch.stack([_padded(each.T, width) for each in side])))
    padding = torch.full((len(keys), width), _NO_KEY)
    for row, each in zip(padding, keys, strict=True):
        row[: len(each)] = 0
    return NearestCodes(ends, tables[0], tables[1], array(padding), array(torch.cat(list(sizes))), width)


def nearest(
    x: Annotated[Tensor, "N D"],
    centre: Annotated[Tensor, "D"],
    middles: Annotated[Tensor, "references D"],
    codes: NearestCodes,
    *,
    least: Annotated[Tensor, "1+references"],
    share: float,
    lower: Annotated[Tensor, "N references"] | None,
) -> Annotated[Tensor, "N"]:
    """The largest of all references' mean cosines of a point with their nearest codes, which are taken until
    `share` of a reference is full; a cosine is the lesser of those from the centre and from the middle.

    What lies within `least` of the centre, or of a middle, has no direction. `lower` is subtracted.
    """
    from . import mixture_kernels as kernels

    out = torch.empty(len(x))
    bounds = array(least)
    kernels.nearest(
        array(x), array(centre), bounds[0], array(middles), bounds[1:], codes.codes, codes.keys, codes.middle_keys,
        codes.width, codes.padding, codes.sizes, np.float32(share), array(out[:0] if lower is None else lower), out.numpy(),
    )  # fmt: skip
    return out


def _padded(table: Tensor, width: int | None = None) -> Tensor:
    """A table with zeros up to whole vectors, or to `width`, in its last dimension."""
    from .simd import WIDE

    columns = table.shape[-1]
    goal = -(-columns // WIDE) * WIDE if width is None else width
    return torch.nn.functional.pad(table, (0, goal - columns))
