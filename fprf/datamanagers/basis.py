"""Principal components of a scene's semantic features: centred, orthonormal, fitted in float64.

y = (x - mean) matrix. Distances and inner products of centred features survive up to the energy that is
dropped, so scores between a scene and its references, both projected, are what they were. Inner products of
features as the encoder gives them are those of y - origin, up to a constant that all keys of a query share: x
. x' = (y - origin) . y' + c(y).
"""

from collections.abc import Mapping
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ..errors import DataError, NumericsError


class Basis(NamedTuple):
    """I = Cin channels in, D out. float32."""

    mean: Annotated[Tensor, "I"]
    matrix: Annotated[Tensor, "I D"]
    """Orthonormal columns, most variance first."""
    energy: float = 1.0
    """Share of the samples' variance that the columns keep, in [0, 1]."""

    def project(self, x: Annotated[Tensor, "... I"]) -> Annotated[Tensor, "... D"]:
        """Features in the basis, on the device and in the type of `x`."""
        return (x - self.mean.to(x)) @ self.matrix.to(x)

    def beyond(
        self, x: Annotated[Tensor, "N I"], projected: Annotated[Tensor, "N D"]
    ) -> Annotated[Tensor, "N 1"]:
        """Squared length that features lose by projection, above what those of the samples lose on average;
        at least 0.
        """
        inside = projected.square().sum(1, keepdim=True)
        lost = (x - self.mean.to(x)).square().sum(1, keepdim=True) - inside
        return (lost - inside * (1 / max(self.energy, 1e-6) - 1)).clamp_min(0)

    def lift(self, y: Annotated[Tensor, "... D"]) -> Annotated[Tensor, "... I"]:
        """Back to the encoder's channels: what `project` gives `y` for, as near to the mean as can be."""
        return y @ self.matrix.to(y).T + self.mean.to(y)

    def origin(self) -> Annotated[Tensor, "D"]:
        """The encoder's zero, projected."""
        return -(self.mean @ self.matrix)

    def tensors(self) -> dict[str, Tensor]:
        """Tensors by name for a tensor file, as `from_tensors` takes them."""
        return {
            "mean": self.mean,
            "matrix": self.matrix.contiguous(),
            "energy": torch.tensor(self.energy, dtype=torch.float64),
        }

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Tensor]) -> "Basis":
        """The basis of `tensors()`. Raises DataError where a tensor is missing or shapes do not fit."""
        missing = {"mean", "matrix", "energy"} - tensors.keys()
        if missing:
            raise DataError(f"basis: {', '.join(sorted(missing))} missing; it needs mean, matrix and energy")
        mean = tensors["mean"]
        matrix = tensors["matrix"]
        if mean.ndim != 1 or matrix.ndim != 2 or len(mean) != len(matrix):
            raise DataError(
                f"basis: mean {tuple(mean.shape)} and matrix {tuple(matrix.shape)}; they must be [I] and [I D]"
            )
        return cls(mean, matrix, float(tensors["energy"]))


def fit_basis(samples: Annotated[Tensor, "N I"], dim: int) -> Basis:
    """The min(dim, I) directions of most variance; with all of them, a rotation. The sign is such that each
    column's largest entry is positive. Raises DataError without samples, NumericsError where one is not
    finite.
    """
    if samples.ndim != 2 or not samples.numel():
        raise DataError(f"basis: samples {tuple(samples.shape)}; at least one feature vector [N I] is needed")
    if not torch.isfinite(samples).all():
        raise NumericsError(
            f"basis: some of the {len(samples)} feature samples are not finite; check the encoder"
        )
    # Eigenvectors of the covariance, most variance first.
    x = samples.detach().cpu().double()
    mean = x.mean(0)
    centred = x - mean
    values, vectors = torch.linalg.eigh(centred.T @ centred / len(x))
    values = values.flip(0).clamp_min(0)
    vectors = vectors.flip(1)[:, :dim]
    # An eigenvector has either sign.
    largest = vectors.abs().argmax(0, keepdim=True)
    vectors = vectors * vectors.gather(0, largest).sign()
    total = values.sum()
    if total > 0:
        energy = float(values[:dim].sum() / total)
    else:
        energy = 1.0
    return Basis(mean.float(), vectors.float().contiguous(), energy)
