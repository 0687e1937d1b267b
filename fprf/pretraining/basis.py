"""Centred principal components, accumulated in float64."""

from dataclasses import dataclass
from typing import Annotated

import torch
from torch import Tensor

from ..ops.precision import double

__all__ = ["Basis", "fit_basis"]


@dataclass(frozen=True, kw_only=True)
class Basis:
    """y = (x - mean) @ axes.T / scale. One scale for all channels: distances keep their proportions."""

    mean: Annotated[Tensor, "F"]
    axes: Annotated[Tensor, "C F"]
    """Orthonormal rows, most energy first."""
    scale: float
    """Makes the mean variance per channel 1."""
    kept: float
    """Share of the centred energy on the axes."""

    def project(self, x: Annotated[Tensor, "B F h w"]) -> Annotated[Tensor, "B C h w"]:
        """Feature maps on the axes."""
        centred = x - self.mean.to(x).view(1, -1, 1, 1)
        return torch.einsum("cf,bfhw->bchw", self.axes.to(x) / self.scale, centred)


def fit_basis(samples: Annotated[Tensor, "N F"], choices: tuple[int, ...], energy: float) -> Basis:
    """The fewest channels among `choices` that keep `energy` of the centred variance (or the most, if none does)."""
    x = double(samples)
    mean = x.mean(0)
    centred = x - mean
    values, vectors = torch.linalg.eigh(centred.T @ centred / len(x))
    values, vectors = values.flip(0).clamp_min(0), vectors.flip(1)
    shares = values.cumsum(0) / values.sum()
    enough = [n for n in sorted(choices) if n <= len(values) and float(shares[n - 1]) >= energy]
    channels = enough[0] if enough else min(max(choices), len(values))
    axes = vectors[:, :channels].T
    axes = axes * axes.sum(1, keepdim=True).sign()  # eigenvectors have no sign of their own
    return Basis(
        mean=mean.float(),
        axes=axes.float(),
        scale=float((values[:channels].mean()).sqrt()),
        kept=float(shares[channels - 1]),
    )
