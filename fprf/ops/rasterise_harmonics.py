"""View-dependent colours in the compiled rasteriser: values of the spherical harmonics at a vector of Gaussians, and slopes.

Blocks of parameters are those of `rasterise_kernels`; K = 1, 4, 9 or 16 `bands` are the harmonics of a colour channel.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, misc, untyped-decorator, import-untyped, call-arg, var-annotated"

from .simd import LANES, load, maximum, splat, square_root

FIXED = 11
"""Rows of a block of Gaussians before its harmonics."""


def direction(mean, view):
    """Unit vectors from the camera to the means, and 1 / distance."""
    dx, dy, dz = mean[0] - view[16], mean[1] - view[17], mean[2] - view[18]
    shrink = 1 / square_root(maximum(dx * dx + dy * dy + dz * dz, 1e-24))
    return dx * shrink, dy * shrink, dz * shrink, shrink


def basis(x, y, z, bands):
    """The first `bands` of the 16 real spherical harmonics at unit vectors, as in `harmonics.spherical_harmonics`."""
    values = [splat(x, 0.28209479177387814)]
    if bands > 1:
        values += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    if bands > 4:
        values += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * z * z - x * x - y * y),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (x * x - y * y),
        ]
    if bands > 9:
        values += [
            -0.5900435899266435 * y * (3 * x * x - y * y),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
            0.3731763325901154 * z * (2 * z * z - 3 * (x * x + y * y)),
            -0.4570457994644658 * x * (4 * z * z - x * x - y * y),
            1.445305721320277 * z * (x * x - y * y),
            -0.5900435899266435 * x * (x * x - 3 * y * y),
        ]
    return values


def colour(blocks, at, basis):
    """0.5 + harmonics times the basis: three vectors, before they are cut at 0."""
    colours = [splat(basis[0], 0.5)] * 3
    for k, b in enumerate(basis):
        colours = [each + b * load(blocks, at + (FIXED + 3 * k + c) * LANES) for c, each in enumerate(colours)]
    return colours


def direction_slopes(x, y, z, bands, blocks, at, red, green, blue):
    """The gradient of the colour in a unit direction, from that of its channels; components along the direction are left in."""
    gx = gy = gz = splat(x, 0)
    c1 = 0.4886025119029199
    for k in range(1, bands):
        o = at + (FIXED + 3 * k) * LANES
        s = red * load(blocks, o) + green * load(blocks, o + LANES) + blue * load(blocks, o + 2 * LANES)
        if k == 1:
            gy = gy - c1 * s
        elif k == 2:
            gz = gz + c1 * s
        elif k == 3:
            gx = gx - c1 * s
        elif k == 4:
            s = s * 1.0925484305920792
            gx, gy = gx + s * y, gy + s * x
        elif k == 5:
            s = s * -1.0925484305920792
            gy, gz = gy + s * z, gz + s * y
        elif k == 6:
            s = s * 0.31539156525252005
            gx, gy, gz = gx - 2 * s * x, gy - 2 * s * y, gz + 4 * s * z
        elif k == 7:
            s = s * -1.0925484305920792
            gx, gz = gx + s * z, gz + s * x
        elif k == 8:
            s = s * 0.5462742152960396
            gx, gy = gx + 2 * s * x, gy - 2 * s * y
        elif k == 9:
            s = s * -0.5900435899266435
            gx, gy = gx + s * 6 * x * y, gy + s * 3 * (x * x - y * y)
        elif k == 10:
            s = s * 2.890611442640554
            gx, gy, gz = gx + s * y * z, gy + s * x * z, gz + s * x * y
        elif k == 11:
            s = s * -0.4570457994644658
            gx, gy, gz = gx - 2 * s * x * y, gy + s * (4 * z * z - x * x - 3 * y * y), gz + 8 * s * y * z
        elif k == 12:
            s = s * 0.3731763325901154
            gx, gy, gz = gx - 6 * s * x * z, gy - 6 * s * y * z, gz + s * (6 * z * z - 3 * (x * x + y * y))
        elif k == 13:
            s = s * -0.4570457994644658
            gx, gy, gz = gx + s * (4 * z * z - 3 * x * x - y * y), gy - 2 * s * x * y, gz + 8 * s * x * z
        elif k == 14:
            s = s * 1.445305721320277
            gx, gy, gz = gx + 2 * s * x * z, gy - 2 * s * y * z, gz + s * (x * x - y * y)
        else:
            s = s * -0.5900435899266435
            gx, gy = gx + s * 3 * (x * x - y * y), gy - s * 6 * x * y
    return gx, gy, gz
