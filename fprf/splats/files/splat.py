"""The .splat file (antimatter15): 32 bytes a Gaussian, without view dependence and without a header.

Position and standard deviations float32, RGBA bytes (sRGB mean colour, opacity), quaternion w x y z as bytes 128 q + 128.
"""

from pathlib import Path

import numpy as np

from ...errors import DataError
from ..gaussians import Gaussians, from_arrays
from .base import Bools, Capture, Floats, centred, colours_of, constants_of, logit, sigmoid, steps

_RECORD = np.dtype([("mean", "<f4", 3), ("deviation", "<f4", 3), ("rgba", "u1", 4), ("turn", "u1", 4)])
_LEAST = 1e-12
"""Standard deviations are at least this, so that their logarithm is finite."""


def read_splat(path: Path, data: bytes) -> Capture:
    """A .splat file. Raises DataError where its size is no multiple of 32 bytes."""
    if not data or len(data) % _RECORD.itemsize:
        raise DataError(f"{path}: {len(data)} bytes; a .splat file has {_RECORD.itemsize} for each Gaussian")
    table = np.frombuffer(data, _RECORD)
    share = table["rgba"] / 255
    means, shift = centred(table["mean"])
    gaussians = from_arrays(
        means,
        (table["turn"].astype(np.float32) - 128) / 128,
        np.log(np.maximum(table["deviation"], _LEAST)),
        logit(share[:, 3]),
        constants_of(share[:, :3]),
    )

    def recolour(harmonics: Floats, changed: Bools) -> bytes:
        out = bytearray(data)
        np.frombuffer(out, _RECORD)["rgba"][changed, :3] = steps(colours_of(harmonics[changed]), 255)
        return bytes(out)

    return Capture(path, gaussians, False, data, recolour, shift=shift)


def splat_bytes(gaussians: Gaussians, antialiased: bool) -> bytes:
    """The .splat file, in the order of the Gaussians. It cannot say that they are antialiased."""
    table = np.empty(len(gaussians), _RECORD)
    table["mean"] = gaussians.means.numpy()
    table["deviation"] = np.exp(gaussians.log_scales.numpy())
    table["rgba"][:, :3] = steps(colours_of(gaussians.harmonics.numpy()), 255)
    table["rgba"][:, 3] = steps(sigmoid(gaussians.logits.numpy()), 255)
    turn = gaussians.quaternions.numpy().astype(np.float64)
    turn = turn / np.linalg.norm(turn, axis=1, keepdims=True)
    table["turn"] = np.clip(np.rint(turn * 128 + 128), 0, 255)
    return table.tobytes()
