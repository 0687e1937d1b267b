"""Step functions on weights and edges that should not be: no ray harms another, and no index leaves its array."""

import pytest
import torch

from fprf.rendering.stepfun import interlevel, resample, scale_gradient


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_ray_of_bad_weights_harms_no_other_and_stays_in_its_edges(bad: float) -> None:
    s = torch.linspace(0, 1, 9).repeat(3, 1)
    w = torch.rand(3, 8, generator=torch.Generator().manual_seed(0))
    good = resample(s, w, 16, padding=1e-3, generator=None)
    for at in (0, 7):
        spoilt = w.clone()
        spoilt[1, at] = bad
        found = resample(s, spoilt, 16, padding=1e-3, generator=None)
        assert torch.equal(found[[0, 2]], good[[0, 2]]) and found.shape == good.shape


@pytest.mark.parametrize("weight", [0.0, 1e-9, 5e-8, 1e-7, 2e-7, 1e-3])
def test_faint_weights_cost_a_finite_share(weight: float) -> None:
    s, w = torch.tensor([[0.0, 1.0]]), torch.tensor([[weight]])
    found = float(interlevel(s, w, s, torch.zeros(1, 1)))
    assert found == pytest.approx(weight**2 / (weight + 1e-7), rel=1e-5)


def test_a_proposal_on_the_same_edges_bounds_each_step_alone() -> None:
    s = torch.tensor([[0.0, 0.25, 0.5, 1.0]])
    w, bound = torch.tensor([[0.2, 0.5, 0.3]]), torch.tensor([[0.1, 0.5, 0.1]])
    wanted = (0.1**2 / 0.2 + 0.2**2 / 0.3) / 3
    assert float(interlevel(s, w, s, bound)) == pytest.approx(wanted, rel=1e-4)


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -1.0])
def test_edges_that_lie_nowhere_are_looked_up_within_the_array(bad: float) -> None:
    s, w = torch.linspace(0, 1, 4).repeat(2, 1), torch.full((2, 3), 0.3)
    for at in (0, 3):
        spoilt = s.clone()
        spoilt[1, at] = bad
        assert interlevel(spoilt, w, s, w).shape == () and interlevel(s, w, spoilt, w).shape == ()


def test_gradients_are_scaled_and_values_are_not() -> None:
    x, by = torch.tensor([1.0, -2.0, 3.0], requires_grad=True), torch.tensor([0.5, 0.0, 4.0])
    found = scale_gradient(x, by)
    (found * torch.tensor([1.0, 1.0, -1.0])).sum().backward()
    assert found.tolist() == x.tolist() and x.grad is not None and x.grad.tolist() == [0.5, 0.0, -4.0]
