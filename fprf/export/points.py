"""Clouds as point files, and the frame that their numbers are in."""

from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .fusion import Cloud
from .ply import write_ply

__all__ = ["columns", "origin_of", "told", "write_points"]

_FINE = 1 / 16
"""Largest rounding of a coordinate that is accepted, in edges of the finest voxel."""


def origin_of(cloud: Cloud) -> Annotated[Tensor, "3"]:
    """What is taken off coordinates so that float32 holds them: nothing, unless the capture lies far from its origin."""
    finest = float(cloud.edge.amin())
    if float(cloud.point.abs().amax()) * 2**-24 <= _FINE * finest:
        return torch.zeros(3, dtype=torch.float64)
    return cloud.point.mean(0).round()


def write_points(path: Path, cloud: Cloud, colour: Annotated[Tensor, "N 3"], origin: Annotated[Tensor, "3"]) -> None:
    """The coloured cloud with normals as PLY."""
    write_ply(path, columns(cloud.point - origin, cloud.normal, colour), comments=told(origin))


def columns(
    point: Annotated[Tensor, "N 3"], normal: Annotated[Tensor, "N 3"], colour: Annotated[Tensor, "N 3"]
) -> dict[str, NDArray[np.generic]]:
    """What a PLY says of vertices: float x y z nx ny nz, uchar red green blue, rounded as pictures are."""
    real = torch.cat([point, normal.to(point)], 1).float().numpy()
    shade = (colour.clamp(0, 1) * 255 + 0.5).to(torch.uint8).numpy()
    table: dict[str, NDArray[np.generic]] = dict(zip(("x", "y", "z", "nx", "ny", "nz"), real.T, strict=True))
    return table | dict(zip(("red", "green", "blue"), shade.T, strict=True))


def told(origin: Annotated[Tensor, "3"]) -> list[str]:
    """What a file says about its frame."""
    if not bool(origin.any()):
        return []
    return [f"coordinates are relative to {' '.join(f'{value:.0f}' for value in origin.tolist())}"]
