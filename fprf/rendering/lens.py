"""Lens models: between ideal and distorted coordinates on the image plane at depth 1, and their inverse.

Letters: x y ideal, r = |(x, y)|, θ = angle to the axis; axes are OpenCV's here (x right, y down, z forward).
A radial model is u(ρ) = ρ (1 + k1 ρ² + k2 ρ⁴ + k3 ρ⁶ + k4 ρ⁸), with ρ = r for OpenCV's lens and ρ = θ for the
fisheye; OpenCV's adds tangential terms p1 p2. u grows only up to a *reach* ρ*: what lies beyond folds back
onto the image, and pixels farther out than u(ρ*) see nothing. Everything is float64; the inverse is good to
1e-12 of the focal length.
"""

import math
from typing import Annotated

import torch
from torch import Tensor

# Kinds of lens: numbers in the files of a run.
PINHOLE = 0
OPENCV = 1  # k1 k2 k3 k4 p1 p2
FISHEYE = 2  # k1 k2 k3 k4 of the angle
_MIN_COEFFICIENT = 1e-80
"""Coefficients of a lens that count: with rho^2 below 1e12, 9 k4 rho^8 of a smaller one is below 1e-31."""
_MAX_INVERSE_ERROR = 1e-14
"""Error of the inverse in focal lengths; pixels are some 1e3 to 1e4 times smaller, which leaves 1e-10 px."""
_MAX_ITERATIONS = 60
"""Bisection alone halves a bracket to rounding in that many; Newton mostly needs five."""


def _powers(k: Tensor, rho: Tensor) -> tuple[Tensor, Tensor]:
    """u / ρ and du / dρ of the radial polynomial with k [R 4] at ρ [R]."""
    s = rho.square()
    k1, k2, k3, k4 = k.unbind(-1)
    share = 1 + s * (k1 + s * (k2 + s * (k3 + s * k4)))
    slope = 1 + s * (3 * k1 + s * (5 * k2 + s * (7 * k3 + s * 9 * k4)))
    return share, slope


def lens_reach(distortion: Annotated[Tensor, "V 6"], lens: Annotated[Tensor, "V"]) -> Annotated[Tensor, "V"]:
    """The largest ρ up to which u grows: infinite for a pinhole, at most π for a fisheye.

    It is the smallest positive root of 1 + 3 k1 s + 5 k2 s² + 7 k3 s³ + 9 k4 s⁴, s = ρ². In z = 1/s that
    polynomial is monic whatever the k are, so that its companion matrix always exists.
    """
    rows, inverse = torch.unique(distortion[:, :4], dim=0, return_inverse=True)
    # Below the least that any root within reach feels, a coefficient only keeps the eigenvalues from converging.
    rows = torch.where(rows.abs() < _MIN_COEFFICIENT, torch.zeros(()).to(rows), rows)
    companion = torch.zeros(len(rows), 4, 4, dtype=rows.dtype, device=rows.device)
    companion[:, 0] = -rows * torch.tensor([3.0, 5.0, 7.0, 9.0], dtype=rows.dtype, device=rows.device)
    companion[:, [1, 2, 3], [0, 1, 2]] = 1.0
    z = torch.linalg.eigvals(companion)
    # A double root splits into a complex pair by about the square root of the rounding error.
    real = (z.imag.abs() <= 1e-7 * z.abs()) & (z.real > 1e-12)
    largest = torch.where(real, z.real, torch.zeros_like(z.real)).amax(-1)
    turn = torch.where(largest > 0, largest.clamp_min(1e-12).rsqrt(), math.inf)[inverse]
    reach = torch.where(lens == FISHEYE, turn.clamp_max(math.pi), turn)
    return torch.where(lens == PINHOLE, math.inf, reach)


def _radial_inverse(k: Tensor, u: Tensor, reach: Tensor) -> Tensor:
    """ρ in [0, reach] with u(ρ) = u, by Newton kept inside a bracket; `reach` itself where u lies beyond
    u(reach).
    """
    low = torch.zeros_like(u)
    # Without a turning point u grows without bound: double until the bracket holds the root.
    high = torch.where(torch.isfinite(reach), reach, u.clamp_min(1e-3))
    for _ in range(_MAX_ITERATIONS):
        short = (_powers(k, high)[0] * high < u) & (high < reach)
        if not short.any():
            break
        high = torch.where(short, torch.minimum(2 * high, reach), high)
    beyond = _powers(k, high)[0] * high <= u
    rho = torch.minimum(u, high)
    for _ in range(_MAX_ITERATIONS):
        share, slope = _powers(k, rho)
        error = share * rho - u
        done = (error.abs() <= _MAX_INVERSE_ERROR * (1 + u)) | beyond
        if bool(done.all()):
            break
        high = torch.where(error > 0, rho, high)
        low = torch.where(error > 0, low, rho)
        step = rho - error / torch.where(slope > 0, slope, torch.ones_like(slope))
        step = torch.where((slope > 0) & (step > low) & (step < high), step, (low + high) / 2)
        rho = torch.where(done, rho, step)
    return torch.where(beyond, torch.where(torch.isfinite(reach), reach, high), rho)


def _brown(distortion: Tensor, xy: Tensor) -> Tensor:
    """OpenCV's distortion of ideal points [R 2]."""
    x, y = xy.unbind(-1)
    p1 = distortion[:, 4]
    p2 = distortion[:, 5]
    rr = x * x + y * y
    share, _ = _powers(distortion[:, :4], rr.sqrt())
    xd = x * share + 2 * p1 * x * y + p2 * (rr + 2 * x * x)
    yd = y * share + p1 * (rr + 2 * y * y) + 2 * p2 * x * y
    return torch.stack([xd, yd], -1)


def _brown_newton(distortion: Tensor, xy: Tensor, target: Tensor, reach: Tensor) -> Tensor:
    """Solve `_brown`(xy) = target by Newton steps that are halved until the residual shrinks; stop where none
    does.
    """
    solved = xy.clone()
    live = torch.arange(len(xy), device=xy.device)
    keep = torch.ones_like(live, dtype=torch.bool)
    for _ in range(_MAX_ITERATIONS):
        error = _brown(distortion, xy) - target
        # Solved pixels leave: most need few steps, and stragglers shall not pay for all.
        size = error.norm(dim=-1)
        keep &= size > _MAX_INVERSE_ERROR * (1 + target.norm(dim=-1))
        if not bool(keep.any()):
            break
        live = live[keep]
        xy = xy[keep]
        target = target[keep]
        reach = reach[keep]
        distortion = distortion[keep]
        size = size[keep]
        # Far from the axis a whole step may overshoot the fold: halve it until the residual shrinks.
        trial = xy - _brown_step(distortion, xy, error[keep])
        for _ in range(8):
            worse = (_brown(distortion, trial) - target).norm(dim=-1) >= size
            worse |= trial.norm(dim=-1) > 1.1 * reach
            if not bool(worse.any()):
                break
            trial = torch.where(worse[:, None], (xy + trial) / 2, trial)
        keep = ~worse
        xy = torch.where(worse[:, None], xy, trial)
        solved[live] = xy
    return solved


def _brown_step(distortion: Tensor, xy: Tensor, error: Tensor) -> Tensor:
    """The Newton step: the inverse of the distortion's Jacobian at xy, times the error."""
    k1, k2, k3, k4, p1, p2 = distortion.unbind(-1)
    x, y = xy.unbind(-1)
    s = x * x + y * y
    share, _ = _powers(distortion[:, :4], s.sqrt())
    change = 2 * (k1 + s * (2 * k2 + s * (3 * k3 + s * 4 * k4)))
    xx = share + change * x * x + 2 * p1 * y + 6 * p2 * x
    yy = share + change * y * y + 6 * p1 * y + 2 * p2 * x
    across = change * x * y + 2 * p1 * x + 2 * p2 * y
    det = xx * yy - across.square()
    # Where the map is singular any long step will do: it is halved until it helps.
    det = torch.where(det.abs() > 1e-12, det, torch.full_like(det, 1e-12))
    ex, ey = error.unbind(-1)
    return torch.stack([(yy * ex - across * ey) / det, (xx * ey - across * ex) / det], -1)


def bend(
    distortion: Annotated[Tensor, "R 6"],
    lens: Annotated[Tensor, "R"],
    reach: Annotated[Tensor, "R"],
    points: Annotated[Tensor, "R 3"],
) -> Annotated[Tensor, "R 2"]:
    """Image-plane coordinates, in focal lengths, of points in OpenCV's camera axes; NaN where none sees the
    point.
    """
    x, y, z = points.unbind(-1)
    radius = torch.hypot(x, y)
    ideal = points[:, :2] / torch.where(z > 0, z, math.nan)[:, None]
    flat = torch.where((ideal.norm(dim=-1) <= reach)[:, None], ideal, math.nan)
    if not bool((lens != PINHOLE).any()):
        return flat
    theta = torch.atan2(radius, z)
    share, _ = _powers(distortion[:, :4], theta)
    # On the axis the direction on the plane is open and the length 0.
    round_ = (
        points[:, :2]
        * (torch.where(theta <= reach, share * theta, math.nan) / radius.clamp_min(1e-300))[:, None]
    )
    bent = torch.where((lens == OPENCV)[:, None], _brown(distortion, flat), flat)
    return torch.where((lens == FISHEYE)[:, None], round_, bent)


def unbend(
    distortion: Annotated[Tensor, "R 6"],
    lens: Annotated[Tensor, "R"],
    reach: Annotated[Tensor, "R"],
    plane: Annotated[Tensor, "R 2"],
) -> Annotated[Tensor, "R 3"]:
    """Unit directions in OpenCV's camera axes of image-plane coordinates in focal lengths.

    Coordinates that no direction maps to get the direction at the lens's reach.
    """
    ideal = torch.cat([plane, torch.ones_like(plane[:, :1])], -1)
    # Only lenses that bend are solved.
    bent = lens != PINHOLE
    if bool(bent.any()):
        index = bent.nonzero()[:, 0]
        distortion = distortion[index]
        lens = lens[index]
        reach = reach[index]
        plane = plane[index]
        # Radial terms keep the direction around the axis: one number a pixel is solved for.
        radius = plane.norm(dim=-1)
        rho = _radial_inverse(distortion[:, :4], radius, reach)
        outward = plane / radius.clamp_min(1e-300)[:, None]
        fisheye = torch.cat([outward * rho.sin()[:, None], rho.cos()[:, None]], -1)
        xy = outward * rho[:, None]
        # Tangential terms do not: Newton in two dimensions starts from the radial solution.
        tangential = (lens == OPENCV) & (distortion[:, 4:] != 0).any(-1)
        if bool(tangential.any()):
            own = tangential.nonzero()[:, 0]
            xy[own] = _brown_newton(distortion[own], xy[own], plane[own], reach[own])
        brown = torch.cat([xy, torch.ones_like(radius)[:, None]], -1)
        ideal[index] = torch.where((lens == FISHEYE)[:, None], fisheye, brown)
    return torch.nn.functional.normalize(ideal, dim=-1)
