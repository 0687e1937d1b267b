"""Points with normals as 3D Gaussians: flat discs on the surface, in the two formats that splat viewers read.

.ply     one vertex a Gaussian, as Kerbl et al. (2023) write it: f_dc the colour's zeroth harmonic, opacity before the
         sigmoid, scale_* the logarithm of the standard deviations, rot_* a quaternion w x y z
.splat   32 bytes a Gaussian: position and standard deviations float32, colour and opacity RGBA, quaternion as 4 bytes
         (q * 128 + 128); the largest and most opaque first, for viewers that draw while they load
"""

from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..io.atomic import write_bytes
from ..ops.harmonics import HARMONIC
from ..rendering.local_frame import added_and_beside, write_offset
from ..splats.files.ply import ply_bytes
from ..splats.gaussians import Gaussians
from ..types import Origin
from .point_cloud import Cloud

_WIDTH = 0.55
"""Standard deviation along the surface, in spacings."""
_THICKNESS = 0.1
"""Standard deviation across the surface, as a share of that along it."""
_OPACITY = 0.95


class Splats(NamedTuple):
    """N Gaussians without colour."""

    point: Annotated[Tensor, "N 3"]
    """float64, local."""
    normal: Annotated[Tensor, "N 3"]
    deviation: Annotated[Tensor, "N 3"]
    """Standard deviations along the Gaussian's own axes, world units, float32; the third is the normal's."""
    rotation: Annotated[Tensor, "N 4"]
    """Own axes to world, unit quaternion w x y z, float32."""
    opacity: Annotated[Tensor, "N"]
    """0 to 1, float32."""


def surface_discs(cloud: Cloud) -> Splats:
    """A disc a point, as wide as its neighbours are apart, so that they cover the surface."""
    along = (_WIDTH * cloud.space).float()
    return Splats(
        cloud.point,
        cloud.normal,
        torch.stack([along, along, _THICKNESS * along], 1),
        rotation_to_normal(cloud.normal),
        torch.full((len(cloud.point),), _OPACITY),
    )


def rotation_to_normal(normal: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N 4"]:
    """The shortest turns, as quaternions w x y z, that bring the z axis to unit vectors."""
    x, y, z = normal.unbind(-1)
    turn = torch.stack([1 + z, -y, x, torch.zeros_like(z)], -1)
    # Half a turn has no shortest way: round x.
    back = torch.tensor([0.0, 1.0, 0.0, 0.0], dtype=normal.dtype)
    none = torch.linalg.vector_norm(turn, dim=-1, keepdim=True) < 1e-6
    return torch.nn.functional.normalize(torch.where(none, back, turn), dim=-1)


def write_gaussians(
    path: Path, splats: Splats, colour: Annotated[Tensor, "N 3"], origin: Origin, *, local: bool = False
) -> None:
    """Write the 3D Gaussian PLY, in the world or `local`. Colours are sRGB in [0, 1], without view dependence."""
    gaussians = Gaussians(
        means=splats.point.float(),
        quaternions=splats.rotation,
        log_scales=splats.deviation.log(),
        logits=torch.logit(splats.opacity.double()).float(),
        harmonics=((colour.double() - 0.5) / HARMONIC).float()[:, None],
    )
    added, beside = added_and_beside(origin, local)
    write_bytes(path, ply_bytes(gaussians, False, added))
    write_offset(path, beside)


def write_splat(path: Path, splats: Splats, colour: Annotated[Tensor, "N 3"], origin: Origin) -> None:
    """Write the .splat file, which is local."""
    order = (splats.deviation.log().sum(-1) + splats.opacity.log()).argsort(descending=True, stable=True).numpy()
    table = np.empty(len(order), dtype=[("at", "<f4", 3), ("deviation", "<f4", 3), ("rgba", "u1", 4), ("turn", "u1", 4)])
    table["at"] = splats.point.numpy()[order]
    table["deviation"] = splats.deviation.numpy()[order]
    rgba = torch.cat([colour.float(), splats.opacity[:, None]], 1)
    table["rgba"] = (rgba.clamp(0, 1) * 255).round().numpy()[order]
    table["turn"] = (splats.rotation * 128 + 128).round().clamp(0, 255).numpy()[order]
    write_bytes(path, table.tobytes())
    write_offset(path, origin)
