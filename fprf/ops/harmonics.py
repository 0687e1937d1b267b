"""Spherical harmonics, and affine maps of the view-dependent colours that they express: harmonics in,
harmonics out.

    colour' = colour A + b,   0.5 + Y0 dc' = (0.5 + Y0 dc) A + b,   higher harmonics' = harmonics A

exact from every direction, with the zeroth harmonic Y0.
"""

import functools
import math
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

HARMONIC = 0.28209479177387814
"""The zeroth spherical harmonic, 1 / (2 sqrt(pi))."""
_MIN_COLOUR = 1e-5
"""Colours below this may be rounded to less than 0; 0.003 of a step of 8 bits."""
MAX_COLOUR = 1.5
"""Mean colours are mapped no higher; with 1 pictures lose contrast (docs/gaussians.md)."""


class Directions(NamedTuple):
    """Directions in which colours are looked at."""

    values: Annotated[Tensor, "B D"]
    """Values of the first B = (degree + 1)^2 harmonics."""
    fit: Annotated[Tensor, "B D"]
    """Their coefficients out of values in the directions, in least squares."""


def spherical_harmonics(direction: Annotated[Tensor, "N 3"], degree: int) -> Annotated[Tensor, "N degree**2"]:
    """Values of the real spherical harmonics below a degree, 1 to 4, at unit directions.

    In the order and with the signs of 3D Gaussian splatting files, where a colour is 0.5 + their sum with the
    coefficients.
    """
    x, y, z = direction.unbind(-1)
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


def as_drawn(harmonics: Annotated[Tensor, "N K 3"], directions: Directions) -> Annotated[Tensor, "N K 3"]:
    """Harmonics of the colours that renderers show, which are cut at 0: a map would lift what was hidden
    below.

    Where some direction is cut, the cut colours of all directions are fitted again by the first B harmonics,
    B <= K.
    """
    count = len(directions.values)
    # In no direction harmonics of degree l are further from 0 than their norm times sqrt((2 l + 1) / 4 pi)
    # (addition theorem).
    square = harmonics[:, :count].square()
    low = 0.5 + HARMONIC * harmonics[:, 0]
    for degree in range(1, math.isqrt(count)):
        # Sums of slices: vectorised over rows, as reductions of a few numbers are not.
        norm = functools.reduce(torch.add, square[:, degree**2 : (degree + 1) ** 2].unbind(1)).sqrt()
        low -= math.sqrt((2 * degree + 1) / (4 * math.pi)) * norm
    some = (low.amin(1) < _MIN_COLOUR).nonzero()[:, 0]
    colour = 0.5 + torch.einsum("bd,nbc->ndc", directions.values, harmonics[some, :count])
    dark = colour.amin((1, 2)) < 0
    out = harmonics.clone()
    out[some[dark], :count] = torch.einsum("bd,ndc->nbc", directions.fit, colour[dark].clamp_min(0) - 0.5)
    return out


def recoloured(
    harmonics: Annotated[Tensor, "N K 3"],
    change: Annotated[Tensor, "N 4 3"],
    weight: Annotated[Tensor, "N"],
    directions: Directions,
) -> Annotated[Tensor, "N K 3"]:
    """Harmonics as drawn, mapped by A = 1 + change[:, :3] and b = change[:, 3]; those of no weight stay, bit
    for bit.

    Mean colours stay below `MAX_COLOUR`, but for those that were above it. Within 60 u of the largest
    harmonic and change, u = 2^-24.
    """
    # All harmonics by A; the zeroth again, as colour A + b within its limit.
    drawn = as_drawn(harmonics, directions)
    matrix = torch.eye(3).to(change) + change[:, :3]
    colour = 0.5 + HARMONIC * drawn[:, 0]
    moved = torch.einsum("nc,ncd->nd", colour, matrix) + change[:, 3]
    moved = moved.minimum(colour.clamp_min(MAX_COLOUR))
    new = torch.einsum("nkc,ncd->nkd", drawn, matrix)
    new[:, 0] = (moved - 0.5) / HARMONIC
    return torch.where((weight > 0)[:, None, None], new, harmonics)
