"""Real spherical harmonics of a viewing direction, up to degree 4 (16 functions), orthonormal on the sphere."""

from typing import Annotated

import torch
from torch import Tensor

from ..errors import ConfigError

__all__ = ["MAX_DEGREE", "count", "harmonics"]

MAX_DEGREE = 4


def count(degree: int) -> int:
    """How many functions a degree has: its square. Raises ConfigError outside 1..4."""
    if not 1 <= degree <= MAX_DEGREE:
        raise ConfigError(f"degree: {degree} must lie in [1, {MAX_DEGREE}]")
    return degree * degree


def harmonics(view: Annotated[Tensor, "N 3"], degree: int) -> Annotated[Tensor, "N degree**2"]:
    """Values at unit directions."""
    x, y, z = view.unbind(-1)
    columns = [torch.full_like(x, 0.28209479177387814)]
    if degree > 1:
        columns += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    if degree > 2:
        columns += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (3 * z * z - 1),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (x * x - y * y),
        ]
    if degree > 3:
        columns += [
            -0.5900435899266435 * y * (3 * x * x - y * y),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (5 * z * z - 1),
            0.3731763325901154 * z * (5 * z * z - 3),
            -0.4570457994644658 * x * (5 * z * z - 1),
            1.445305721320277 * z * (x * x - y * y),
            -0.5900435899266435 * x * (x * x - 3 * y * y),
        ]
    return torch.stack(columns, -1)
