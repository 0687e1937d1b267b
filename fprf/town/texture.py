"""Deterministic noise and patterns on coordinates in metres. Values lie in [0, 1] unless said otherwise."""

import numpy as np
from numpy.typing import NDArray

__all__ = ["band", "cells", "fractal2", "fractal3", "hashed", "mix", "noise2", "noise3", "step"]

Array = NDArray[np.float32]
_PRIMES = (0x9E3779B1, 0x85EBCA77, 0xC2B2AE3D)


def hashed(seed: int, *cell: NDArray[np.int64]) -> Array:
    """A uniform number per integer cell: up to three coordinates."""
    h = np.full(np.broadcast_shapes(*(c.shape for c in cell)), (seed * 0x27D4EB2F + 0x165667B1) & 0xFFFFFFFF, np.uint32)
    for c, prime in zip(cell, _PRIMES, strict=False):
        h = (h ^ c.astype(np.uint32)) * np.uint32(prime)
        h ^= h >> np.uint32(15)
    h *= np.uint32(0x2C1B3C6D)
    h ^= h >> np.uint32(13)
    return (h >> np.uint32(8)).astype(np.float32) * np.float32(2.0**-24)


def _split(x: NDArray[np.floating]) -> tuple[NDArray[np.int64], Array]:
    whole = np.floor(x)
    part = (x - whole).astype(np.float32)
    return whole.astype(np.int64), np.asarray(part * part * (3 - 2 * part), np.float32)


def noise2(x: NDArray[np.floating], y: NDArray[np.floating], seed: int) -> Array:
    """Smooth value noise with unit cells."""
    (i, a), (j, b) = _split(x), _split(y)
    low = hashed(seed, i, j) * (1 - a) + hashed(seed, i + 1, j) * a
    high = hashed(seed, i, j + 1) * (1 - a) + hashed(seed, i + 1, j + 1) * a
    return np.asarray(low * (1 - b) + high * b, np.float32)


def noise3(x: NDArray[np.floating], y: NDArray[np.floating], z: NDArray[np.floating], seed: int) -> Array:
    """Smooth value noise with unit cells in space."""
    (i, a), (j, b), (k, c) = _split(x), _split(y), _split(z)

    def plane(m: NDArray[np.int64]) -> Array:
        low = hashed(seed, i, j, m) * (1 - a) + hashed(seed, i + 1, j, m) * a
        high = hashed(seed, i, j + 1, m) * (1 - a) + hashed(seed, i + 1, j + 1, m) * a
        return np.asarray(low * (1 - b) + high * b, np.float32)

    return np.asarray(plane(k) * (1 - c) + plane(k + 1) * c, np.float32)


def fractal2(x: NDArray[np.floating], y: NDArray[np.floating], seed: int) -> Array:
    """Two octaves of noise2."""
    return noise2(x, y, seed) * np.float32(0.65) + noise2(2.3 * x, 2.3 * y, seed + 1) * np.float32(0.35)


def fractal3(p: NDArray[np.floating], rate: float, seed: int) -> Array:
    """Two octaves of noise3 at points [N 3], with `rate` cells per metre."""
    x, y, z = p.T * rate
    return noise3(x, y, z, seed) * np.float32(0.65) + noise3(2.3 * x, 2.3 * y, 2.3 * z, seed + 1) * np.float32(0.35)


def step(x: NDArray[np.floating], low: float, high: float) -> Array:
    """Smooth rise from 0 at low to 1 at high."""
    s = np.clip((x - low) / (high - low), 0.0, 1.0).astype(np.float32)
    return np.asarray(s * s * (3 - 2 * s), np.float32)


def band(x: NDArray[np.floating], half: float | NDArray[np.floating], soft: float = 0.02) -> Array:
    """1 where |x| < half, falling to 0 within `soft` metres on both sides of the edge."""
    return np.asarray(np.clip((half - np.abs(x)) / (2 * soft) + 0.5, 0.0, 1.0), np.float32)


def cells(
    u: NDArray[np.floating], v: NDArray[np.floating], width: float, height: float, joint: float, shift: float, seed: int
) -> tuple[Array, Array]:
    """Bricks, slabs, tiles: a number per cell, and 1 in the joints. Every other row moves by `shift` of a cell."""
    row = np.floor(v / height)
    column = u / width + shift * (row % 2)
    across = (column - np.floor(column) - 0.5) * width
    along = (v / height - row - 0.5) * height
    inside = band(across, width / 2 - joint) * band(along, height / 2 - joint)
    return hashed(seed, np.floor(column).astype(np.int64), row.astype(np.int64)), 1 - inside


def mix(a: NDArray[np.floating], b: NDArray[np.floating], share: NDArray[np.floating]) -> Array:
    """Colours a and b ([3] or [N 3]) mixed by share [N] of b: [N 3]."""
    s = share[:, None].astype(np.float32)
    return np.asarray(a * (1 - s) + b * s, np.float32)
