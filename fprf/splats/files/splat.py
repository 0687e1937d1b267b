"""The .splat file (antimatter15): 32 bytes a Gaussian, without view dependence and without a header.

Position and standard deviations float32, RGBA bytes (sRGB mean colour, opacity), quaternion w x y z as bytes
128 q + 128.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from ...errors import DataError
from ...types import Origin
from ..gaussians import Gaussians
from . import base
from .base import Bools, Capture, CaptureFormat, Data, Floats

_SPLAT_RECORD = np.dtype([("mean", "<f4", 3), ("deviation", "<f4", 3), ("rgba", "u1", 4), ("turn", "u1", 4)])
"""A Gaussian, in 32 bytes."""
_MIN_DEVIATION = 1e-12
"""Standard deviations are at least this, so that their logarithm is finite."""


@dataclass(frozen=True, kw_only=True)
class Splat(CaptureFormat):
    """antimatter15's .splat."""

    view_dependent: ClassVar[bool] = False

    def recognises(self, head: bytes, size: int) -> bool:
        return size > 0 and size % _SPLAT_RECORD.itemsize == 0

    def read(self, path: Path, data: Data) -> Capture:
        if not self.recognises(b"", len(data)):
            raise DataError(
                f"{path}: {len(data)} bytes; a .splat file has {_SPLAT_RECORD.itemsize} for each Gaussian"
            )
        whole = np.frombuffer(data, _SPLAT_RECORD)

        def part(rows: slice) -> tuple[Floats, ...]:
            table = whole[rows]
            # Bytes stand for shares; opacities of 0 and 1 keep a finite logit.
            share = table["rgba"] / 255
            turns = (table["turn"].astype(np.float32) - 128) / 128
            scales = np.log(np.maximum(table["deviation"], _MIN_DEVIATION))
            return table["mean"], turns, scales, base.logit(share[:, 3]), base.constants_of(share[:, :3])

        def recolour(harmonics: Floats, changed: Bools) -> list[bytes]:
            out = whole.copy()
            out["rgba"][changed, :3] = base.steps(base.colours_of(harmonics[changed]), 255)
            return [out.tobytes()]

        gaussians, shift = base.decoded(1, (len(whole), part))
        return Capture(path, gaussians, False, data, recolour, shift=shift)

    def pack(self, gaussians: Gaussians, antialiased: bool, origin: Origin) -> list[bytes]:
        """In the order of the Gaussians. The file cannot say that they are antialiased."""
        means, turns, scales, logits, harmonics = base.arrays(gaussians)
        table = np.empty(len(gaussians), _SPLAT_RECORD)
        table["mean"] = means
        table["deviation"] = np.exp(scales)
        table["rgba"][:, :3] = base.steps(base.colours_of(harmonics), 255)
        table["rgba"][:, 3] = base.steps(base.sigmoid(logits), 255)
        # 128 is 0: a component of 1 does not fit by half a step.
        table["turn"] = np.clip(np.rint(base.unit_quaternions(turns) * 128 + 128), 0, 255)
        return [table.tobytes()]
