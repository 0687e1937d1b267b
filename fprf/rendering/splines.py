"""Smooth motion through key poses: quaternions (w x y z), SLERP and Catmull-Rom. All in the dtype of the input.

M keys · F frames. A frame lies in the gap between keys g and g + 1, at the place u in [0, 1) within it.
"""

from typing import Annotated

import torch
from torch import Tensor

__all__ = ["catmull_rom", "quaternions", "rotations", "slerp"]


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
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def slerp(
    start: Annotated[Tensor, "F 4"], end: Annotated[Tensor, "F 4"], u: Annotated[Tensor, "F"]
) -> Annotated[Tensor, "F 4"]:
    """From `start` (u = 0) to `end` (u = 1) the short way round, at constant speed."""
    cosine = (start * end).sum(-1, keepdim=True)
    # q and -q are the same rotation: take the nearer one.
    end = torch.where(cosine < 0, -end, end)
    # Half-angle tangent: exact for small angles, where arccos of the dot product loses half of the digits.
    angle = 2 * torch.atan2((end - start).norm(dim=-1), (end + start).norm(dim=-1))[:, None]
    u = u[:, None]
    # torch.sinc is sin(πx) / (πx): sin(u a) / sin(a) stays finite at a = 0.
    whole = torch.sinc(angle / torch.pi)
    return ((1 - u) * torch.sinc((1 - u) * angle / torch.pi) * start + u * torch.sinc(u * angle / torch.pi) * end) / whole


def catmull_rom(
    keys: Annotated[Tensor, "M 3"], gap: Annotated[Tensor, "F"], u: Annotated[Tensor, "F"]
) -> Annotated[Tensor, "F 3"]:
    """Through every key, with a continuous direction; centripetal: knots are spaced by the root of the distance.

    Unlike the uniform form it makes no loops where keys are unevenly spaced (Yuksel et al. 2011). A missing neighbour
    at either end is the mirror image of the other one.
    """
    if len(keys) == 1:
        return keys[gap]
    padded = torch.cat([2 * keys[:1] - keys[1:2], keys, 2 * keys[-1:] - keys[-2:-1], keys[-1:]])
    before, start, end, after = (padded[gap + shift] for shift in range(4))
    left, here, right = ((b - a).norm(dim=-1, keepdim=True).sqrt() for a, b in ((before, start), (start, end), (end, after)))
    # Keys in one place have no spacing; any stands in, for their difference is 0.
    here = torch.where(here > 0, here, torch.ones_like(here))
    left, right = torch.where(left > 0, left, here), torch.where(right > 0, right, here)
    chord = end - start
    leave = chord + here * ((start - before) / left - (end - before) / (left + here))
    arrive = chord + here * ((after - end) / right - (after - start) / (here + right))
    u = u[:, None]
    square, cube = u**2, u**3
    return (
        (2 * cube - 3 * square + 1) * start
        + (cube - 2 * square + u) * leave
        + (3 * square - 2 * cube) * end
        + (cube - square) * arrive
    )
