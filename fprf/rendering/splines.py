"""Smooth motion through key poses: quaternions (w x y z), SLERP and Catmull-Rom. All in the dtype of the
input.

M keys · F frames. A frame lies in the gap between keys g and g + 1, at the place u in [0, 1) within it.
"""

from typing import Annotated

import torch
from torch import Tensor


def quaternions(rotation: Annotated[Tensor, "M 3 3"]) -> Annotated[Tensor, "M 4"]:
    """Unit quaternions of rotations, either of the two signs.

    Each row of 4 q qᵀ is a multiple of q; the one with the largest diagonal divides by no small number.
    """
    (a, b, c), (d, e, f), (g, h, i) = (row.unbind(-1) for row in rotation.unbind(-2))
    outer = torch.stack(
        [
            torch.stack([1 + a + e + i, h - f, c - g, d - b], -1),
            torch.stack([h - f, 1 + a - e - i, b + d, c + g], -1),
            torch.stack([c - g, b + d, 1 - a + e - i, f + h], -1),
            torch.stack([d - b, c + g, f + h, 1 - a - e + i], -1),
        ],
        -2,
    )
    best = outer.diagonal(dim1=-2, dim2=-1).argmax(-1)
    return torch.nn.functional.normalize(outer[torch.arange(len(outer), device=outer.device), best], dim=-1)


def rotations(quaternion: Annotated[Tensor, "F 4"]) -> Annotated[Tensor, "F 3 3"]:
    """Rotations of quaternions of any length above 0."""
    w, x, y, z = torch.nn.functional.normalize(quaternion, dim=-1).unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    parts = []
    for row in rows:
        parts.append(torch.stack(row, -1))
    return torch.stack(parts, -2)


def slerp(
    start: Annotated[Tensor, "F 4"], end: Annotated[Tensor, "F 4"], u: Annotated[Tensor, "F"]
) -> Annotated[Tensor, "F 4"]:
    """Rotations from `start` (u = 0) to `end` (u = 1) the short way round, at constant speed."""
    cosine = (start * end).sum(-1, keepdim=True)
    # q and -q are the same rotation: take the nearer one.
    end = torch.where(cosine < 0, -end, end)
    # Half-angle tangent: exact for small angles, where arccos of the dot product loses half of the digits.
    angle = 2 * torch.atan2((end - start).norm(dim=-1), (end + start).norm(dim=-1))[:, None]
    u = u[:, None]
    # torch.sinc is sin(πx) / (πx): sin(u a) / sin(a) stays finite at a = 0.
    whole = torch.sinc(angle / torch.pi)
    return (
        (1 - u) * torch.sinc((1 - u) * angle / torch.pi) * start + u * torch.sinc(u * angle / torch.pi) * end
    ) / whole


def catmull_rom(
    keys: Annotated[Tensor, "M 3"], gap: Annotated[Tensor, "F"], u: Annotated[Tensor, "F"]
) -> Annotated[Tensor, "F 3"]:
    """Through every key with a continuous velocity, each gap in the same time.

    Directions at keys are those of the centripetal spline, whose knots are spaced by the root l of the
    distance: unlike the uniform one it makes no loops (Yuksel et al. 2011). Speeds are those of the shorter
    gap, l_short · v with
    |v| <= 2 l_short, so that keys in a line are passed without turning back (Fritsch and Carlson 1980) and a key that
    comes twice is a rest. A missing neighbour at either end is the mirror image of the other one.
    """
    if len(keys) == 1:
        return keys[gap]
    padded = torch.cat([2 * keys[:1] - keys[1:2], keys, 2 * keys[-1:] - keys[-2:-1]])
    chord = padded.diff(dim=0)
    root = chord.norm(dim=-1, keepdim=True).sqrt()
    # Where a root is 0 so is the shorter one, and with it the velocity, whatever the quotient.
    rate = chord / torch.where(root > 0, root, torch.ones_like(root))
    left = root[:-1]
    right = root[1:]
    both = left + right
    share = left / torch.where(both > 0, both, torch.ones_like(both))
    # Of the derivatives of the quadratic through three keys, the one at the middle key.
    velocity = torch.minimum(left, right) * ((1 - share) * rate[:-1] + share * rate[1:])
    # A frame at the very end lies in the gap after the last key, with u = 0.
    after = (gap + 1).clamp(max=len(keys) - 1)
    u = u[:, None]
    square = u.square()
    cube = square * u
    place: Tensor = (
        (2 * cube - 3 * square + 1) * keys[gap]
        + (cube - 2 * square + u) * velocity[gap]
        + (3 * square - 2 * cube) * keys[after]
        + (cube - square) * velocity[after]
    )
    return place
