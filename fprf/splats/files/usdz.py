"""USDZ with a `ParticleField3DGaussianSplat` (OpenUSD 26.03 and later): written by usd-core, and written
alone.

Sizes are linear, opacities shares, and all harmonics of a Gaussian lie one after the other. Axes are right up
back, with the turn of 180 degrees about x from those of PLY files in the Gaussians themselves, so that it
needs no transform of the prim.
"""

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from ...errors import DataError
from ...plugins.config import Need
from ...types import Origin
from ..gaussians import COUNTS, Gaussians
from . import base
from .base import Capture, CaptureFormat, Data

_MIRROR = np.array([1.0, -1.0, -1.0])
"""The diagonal of the turn from right down front to right up back."""


@dataclass(frozen=True, kw_only=True)
class Usdz(CaptureFormat):
    """OpenUSD's .usdz."""

    reads: ClassVar[bool] = False

    def needs(self) -> tuple[Need, ...]:
        try:
            from pxr import UsdVol

            UsdVol.ParticleField3DGaussianSplat  # noqa: B018
        except (ImportError, AttributeError):
            return (Need("usd-core 26.3 or later", "pip install usd-core, or name a .ply or .glb"),)
        return ()

    def recognises(self, head: bytes, size: int) -> bool:
        return head.startswith(b"PK")

    def read(self, path: Path, data: Data) -> Capture:
        raise DataError(f"{path}: .usdz is written, not read; take the file that it was made from")

    def pack(self, gaussians: Gaussians, antialiased: bool, origin: Origin) -> list[bytes]:
        """A stage of one prim, Y up, in metres; harmonics of degree 4 are left out."""
        base.check_needs(self)
        from pxr import Gf, Sdf, Usd, UsdGeom, UsdUtils, UsdVol, Vt

        means, turns, scales, logits, harmonics = base.arrays(gaussians)
        bands = min(harmonics.shape[1], COUNTS[3])
        harmonics = np.matmul(base.turned_harmonics(np.diag(_MIRROR), bands), harmonics[:, :bands])
        # The product of the turn, a quaternion of x alone, and those of the Gaussians; w is last in memory.
        w, x, y, z = base.unit_quaternions(turns).T
        columns = [
            ("Positions", Vt.Vec3fArray, means * _MIRROR),
            ("Orientations", Vt.QuatfArray, np.stack([w, -z, y, -x], 1)),
            ("Scales", Vt.Vec3fArray, np.exp(scales.clip(-80, 80))),
            ("Opacities", Vt.FloatArray, base.sigmoid(logits)),
            ("RadianceSphericalHarmonicsCoefficients", Vt.Vec3fArray, harmonics.reshape(-1, 3)),
        ]
        with tempfile.TemporaryDirectory() as folder:
            layer = f"{folder}/capture.usdc"
            package = f"{folder}/capture.usdz"
            stage = Usd.Stage.CreateNew(layer)
            UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
            UsdGeom.SetStageMetersPerUnit(stage, 1.0)
            field = UsdVol.ParticleField3DGaussianSplat.Define(stage, Sdf.Path("/capture"))
            stage.SetDefaultPrim(field.GetPrim())
            for name, kind, values in columns:
                array = kind.FromNumpy(np.ascontiguousarray(values, np.float32))
                getattr(field, f"Create{name}Attr")(array)
            field.CreateRadianceSphericalHarmonicsDegreeAttr(round(bands**0.5) - 1)
            field.CreateSortingModeHintAttr(UsdVol.Tokens.cameraDistance)
            bounds = np.stack([(means * _MIRROR).min(0), (means * _MIRROR).max(0)])
            field.CreateExtentAttr([Gf.Vec3f(*map(float, corner)) for corner in bounds])
            stage.GetRootLayer().Save()
            if not UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(layer), package):
                raise DataError(
                    ".usdz: usd-core could not write the package; see its message, or name a .ply or .glb"
                )
            return [Path(package).read_bytes()]
