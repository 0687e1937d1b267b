"""The semantic basis: orthonormal, centred, ordered, and the same every time."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from fprf.datamanagers.basis import Basis, fit_basis
from fprf.errors import ConfigError, DataError, NumericsError

UNIT = 2.0**-24


@given(samples=st.integers(1, 40), channels=st.integers(1, 12), dim=st.integers(1, 15), seed=st.integers(0, 99))
def test_columns_are_orthonormal_and_energy_is_a_share(samples: int, channels: int, dim: int, seed: int) -> None:
    x = torch.randn(samples, channels, generator=torch.Generator().manual_seed(seed))
    basis = fit_basis(x, dim)
    kept = min(dim, channels)
    assert basis.mean.shape == (channels,) and basis.matrix.shape == (channels, kept)
    assert (basis.matrix.T @ basis.matrix - torch.eye(kept)).abs().max() <= 8 * channels * UNIT
    assert 0 <= basis.energy <= 1 + 1e-12
    assert (basis.matrix.gather(0, basis.matrix.abs().argmax(0, keepdim=True)) > 0).all()


def test_against_the_singular_values() -> None:
    x = torch.randn(200, 10, dtype=torch.float64) * torch.logspace(1, -2, 10, dtype=torch.float64) + 5
    basis = fit_basis(x, 4)
    centred = x - x.mean(0)
    _, values, rows = torch.linalg.svd(centred, full_matrices=False)
    assert abs(basis.energy - float(values[:4].square().sum() / values.square().sum())) <= 1e-12
    assert ((rows[:4] @ basis.matrix.double()).diagonal().abs() - 1).abs().max() <= 1e-6
    variance = basis.project(x).var(0)
    assert (variance.diff() <= 0).all()


def test_a_plane_is_found_under_a_large_offset() -> None:
    """float32 samples at an offset of 1000 keep 6e-5 each; the plane they lie on must come out to that, not worse."""
    plane = torch.linalg.qr(torch.randn(20, 3, dtype=torch.float64))[0]
    flat = torch.randn(500, 3, dtype=torch.float64) @ plane.T
    basis = fit_basis((flat + 1000).float(), 3)
    assert 1 - basis.energy <= (1000 * UNIT) ** 2 * 20
    back = basis.project((flat + 1000).float()).double() @ basis.matrix.double().T
    assert (back - (flat - flat.mean(0))).abs().max() <= 1000 * UNIT * 16


def test_what_cannot_be_fitted_or_read_is_named() -> None:
    with pytest.raises(ConfigError, match=r"semantic\.dim"):
        fit_basis(torch.randn(3, 3), 0)
    with pytest.raises(DataError, match="at least one"):
        fit_basis(torch.zeros(0, 3), 1)
    with pytest.raises(NumericsError, match="not finite"):
        fit_basis(torch.tensor([[1.0, float("nan")]]), 1)
    with pytest.raises(DataError, match="matrix missing"):
        Basis.from_tensors({"mean": torch.zeros(2), "energy": torch.tensor(1.0)})
    with pytest.raises(DataError, match="must be"):
        Basis.from_tensors({"mean": torch.zeros(2), "matrix": torch.zeros(3, 1), "energy": torch.tensor(1.0)})
