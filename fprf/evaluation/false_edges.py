"""Does a style cut through things? How often a restyled picture has an edge where the picture before has none.

Two pixels lie on one surface where no colour on the straight way between them is further than `even` from the first: a wall, a
cloth, a face, a sky. A style may give them any colour, but one colour. A pair is a false edge where the style moves its ends
more than `cut` apart: a region ended inside of a thing. With the defaults contrast alone must double before it counts.
"""

from typing import Annotated

import torch
import torch.nn.functional as F
from torch import Tensor

from ..errors import DataError

__all__ = ["false_edges"]

_SIGMA = 1.0
"""Pixels that both pictures are blurred by: noise is no edge."""
_REACH = 12
"""Ends of a pair lie so many-th of the shorter side apart: further than a soft border between regions is wide."""
_EVEN, _CUT = 0.05, 0.1
"""Largest differences of a channel in [0, 1]: thirteen and twenty-six 8-bit steps."""


def false_edges(
    plain: Annotated[Tensor, "H W 3"], styled: Annotated[Tensor, "H W 3"], *, even: float = _EVEN, cut: float = _CUT
) -> float | None:
    """Share of the pairs on one surface, along rows and columns, that the style cuts, in [0, 1]; None where there are none.

    Raises DataError for pictures of different sizes, or smaller than 12 pixels.
    """
    if plain.shape != styled.shape or plain.ndim != 3 or min(plain.shape[:2]) < _REACH:
        raise DataError(
            f"false edges: pictures of shape {tuple(plain.shape)} and {tuple(styled.shape)}; both must be [H W 3] of one size, "
            f"with sides of at least {_REACH} pixels"
        )
    reach = max(2, round(min(plain.shape[:2]) / _REACH))
    before, after = _blurred(plain), _blurred(styled)
    pairs = cuts = 0
    for axis in (1, 2):
        a, b = before.movedim(axis, 0), after.movedim(axis, 0)
        starts = len(a) - reach
        way = torch.stack([(a[i : i + starts] - a[:starts]).abs().amax(1) for i in range(1, reach + 1)])
        surface = way.amax(0) < even
        pairs += int(surface.sum())
        cuts += int((surface & ((b[reach:] - b[:starts]).abs().amax(1) > cut)).sum())
    return cuts / pairs if pairs else None


def _blurred(picture: Tensor) -> Annotated[Tensor, "3 H W"]:
    at = torch.arange(-3, 4, dtype=torch.float32)
    kernel = torch.exp(-at.square() / (2 * _SIGMA**2))
    kernel = kernel / kernel.sum()
    padded = F.pad(picture.detach().cpu().float().permute(2, 0, 1)[:, None], (3, 3, 3, 3), mode="replicate")
    return F.conv2d(F.conv2d(padded, kernel.view(1, 1, 1, -1)), kernel.view(1, 1, -1, 1))[:, 0]
