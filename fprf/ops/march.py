"""Proposals of where a ray's samples go, compiled (`march_kernels`): CPU, float32, without gradients.

`rendering.space` and `rendering.stepfun` hold the reference of each step: distances, places, weights, even steps of these.
"""

# The checker takes compiled functions to have one argument.
# mypy: disable-error-code="call-arg"

from typing import Annotated

import numpy as np
import torch
from torch import Tensor

from ..types import Rays
from .dense import array


def propose(
    rays: Rays,
    s: Annotated[Tensor, "R E"],
    warp: Annotated[Tensor, "7"],
    table: Annotated[Tensor, "rows F"],
    resolution: int,
    weight: Annotated[Tensor, "F"],
    *,
    limit: float,
    padding: float,
    count: int,
    shift: Annotated[Tensor, "R 1"],
) -> Annotated[Tensor, "R count+1"]:
    """Edges of the next level for a plane field of one scale, of density exp(feature . weight - 1).

    `warp` is `Space.warp`; F is a multiple of 8. Behind an optical depth of 20 nothing is looked up. An index never leaves the
    table, whatever the numbers.
    """
    from . import march_kernels as kernels

    out = torch.empty(len(s), count + 1)
    kernels.propose(
        array(rays.origin), array(rays.direction), array(rays.near), array(rays.far), array(s), array(warp), array(table),
        resolution, table.shape[1], array(weight), np.float32(limit), np.float32(padding), array(shift),
        out.view(-1).numpy(),
    )  # fmt: skip
    return out
