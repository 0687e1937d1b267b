"""What lines the street: trees, hedges, lamps and cars, as lists of solids."""

import math

import numpy as np

from .shapes import Finish, Material, Shape, box, cylinder, ellipsoid, extrude

__all__ = ["LANTERN", "bush", "car", "forest", "hedge", "lamp", "tree"]

LANTERN = 4.0
"""Height of the light of a lamp."""
_HIDDEN = Finish(Material.TRIM)


def tree(x: float, y: float, size: float, rng: np.random.Generator) -> list[Shape]:
    """A round crown of several ellipsoids, about 2 + 2 size metres high, or a slim poplar, 5.6 + 2 size high."""
    leaf = Finish(Material.FOLIAGE, tint=int(rng.integers(0, 6)))
    bark = Finish(Material.TRUNK)
    if rng.random() < 0.2:
        tall = 2.3 + size
        return [
            cylinder(x, y, 0.0, 1.6, 0.14, bark),
            ellipsoid((x, y, 1.0 + tall), (0.55 * size, 0.55 * size, tall), leaf),
        ]
    stem = 2.1 + 0.4 * size
    shapes: list[Shape] = [cylinder(x, y, 0.0, stem + 0.8, 0.11 + 0.05 * size, bark)]
    shapes.append(ellipsoid((x, y, stem + 0.95 * size), (0.85 * size, 0.85 * size, 0.95 * size), leaf))
    turn = float(rng.uniform(0, 2 * math.pi))
    count = 7
    for k in range(count):
        angle = turn + 2.4 * k
        away, up = float(rng.uniform(0.5, 0.75)) * size, (0.3 + 1.1 * k / count) * size
        radius = float(rng.uniform(0.42, 0.62)) * size
        centre = (x + away * math.cos(angle), y + away * math.sin(angle), stem + up)
        shapes.append(ellipsoid(centre, (radius, radius, 0.85 * radius), leaf))
    return shapes


def bush(x: float, y: float, size: float, rng: np.random.Generator) -> list[Shape]:
    """A shrub resting on the ground."""
    leaf = Finish(Material.FOLIAGE, tint=int(rng.integers(0, 6)))
    return [ellipsoid((x, y, 0.35 * size), (size, size * 0.8, 0.75 * size), leaf)]


def hedge(low: tuple[float, float], high: tuple[float, float], height: float) -> Shape:
    """A clipped hedge."""
    return box((*low, 0.0), (*high, height), [Finish(Material.FOLIAGE, tint=6)] * 6)


def forest(x: float, y: float, size: float, rng: np.random.Generator) -> Shape:
    """One crown of the wood that hides the horizon."""
    leaf = Finish(Material.FOLIAGE, style=1, tint=int(rng.integers(0, 6)))
    tall = size * float(rng.uniform(1.3, 1.9))
    return ellipsoid((x, y, 0.25 * tall), (size, size, tall), leaf)


def lamp(x: float, y: float) -> list[Shape]:
    """A street lamp: post, lantern and cap."""
    post = Finish(Material.POST)
    return [
        cylinder(x, y, 0.0, 0.5, 0.13, post),
        cylinder(x, y, 0.0, LANTERN - 0.2, 0.06, post),
        ellipsoid((x, y, LANTERN), (0.24, 0.24, 0.33), Finish(Material.LANTERN)),
        ellipsoid((x, y, LANTERN + 0.3), (0.3, 0.3, 0.12), post),
    ]


def car(x: float, y: float, axis: int, rng: np.random.Generator) -> list[Shape]:
    """A parked car, 4.2 m long, along x (axis 0) or along y (axis 1); its middle at (x, y)."""
    paint = Finish(Material.PAINT, tint=int(rng.integers(0, 6)))
    glass = Finish(Material.GLASS, tint=paint.tint)
    pane = glass._replace(style=1)
    middle, side = (x, y) if axis == 0 else (y, x)
    facing = 1 if rng.random() < 0.5 else -1

    def profile(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
        placed = [(middle + facing * a, b) for a, b in points]
        return placed if facing > 0 else placed[::-1]

    body = profile([(-2.05, 0.28), (2.05, 0.28), (2.1, 0.62), (1.95, 0.8), (0.95, 0.98), (-1.95, 0.98), (-2.1, 0.7)])
    cabin = profile([(-1.75, 0.95), (1.05, 0.95), (0.35, 1.5), (-1.15, 1.5)])
    top = 2 if facing > 0 else 0
    cover = [glass, glass, glass, glass]
    cover[top] = paint
    sweep = 1 - axis
    shapes: list[Shape] = [
        extrude(body, sweep, side - 0.85, side + 0.85, [paint] * 9),
        extrude(cabin, sweep, side - 0.72, side + 0.72, [*cover, pane, pane]),
    ]
    for along in (-1.3, 1.3):
        for beside in (-0.78, 0.78):
            a, b = middle + along, side + beside
            centre, radii = ((a, b, 0.33), (0.34, 0.13, 0.34)) if axis == 0 else ((b, a, 0.33), (0.13, 0.34, 0.34))
            shapes.append(ellipsoid(centre, radii, Finish(Material.TYRE)))
    return shapes
