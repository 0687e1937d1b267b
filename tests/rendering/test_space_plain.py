"""The plain form of a space's distances, number by number: what gradients and other devices are given."""

import pytest
import torch

from fprf.rendering.space import Space, uncontract

EYE = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def share(t: float) -> float:
    """How far along the contraction a distance lies, 0 to 1."""
    return t / 2 if t < 1 else 1 - 0.5 / t


def distance(g: float) -> float:
    return 2 * g if g < 0.5 else 0.5 / (1 - g)


@pytest.mark.parametrize("near", [0.05, 0.5, 1.0, 3.0])
@pytest.mark.parametrize("far", [0.6, 0.95, 1.0, 7.0, 1e4])
def test_distances_of_a_contraction_are_even_in_its_shares(near: float, far: float) -> None:
    if near > far:
        pytest.skip("nothing between")
    space = Space("contraction", (0.0, 0.0, 0.0), EYE, 1.0, 0.05, 1e3)
    s = torch.linspace(0, 1, 11, dtype=torch.float64)
    ends = torch.tensor([[near], [far]], dtype=torch.float64)
    found = space.distance(s[None], ends[0], ends[1])[0]
    low, high = share(near), share(far)
    exact = [distance(low + (high - low) * at) for at in s.tolist()]
    assert found.tolist() == pytest.approx(exact, rel=1e-9)


def test_the_way_back_has_a_gradient_at_the_origin() -> None:
    y = torch.zeros(2, 3, dtype=torch.float64)
    y[1] = 0.9
    y.requires_grad_(True)
    uncontract(y).sum().backward()
    assert y.grad is not None and bool(y.grad.isfinite().all()) and y.grad[0].tolist() == [2.0] * 3
