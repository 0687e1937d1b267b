"""Rays through points of the reconstruction: where they should end."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from pretend_cuda import CUDA, pretend_cuda
from torch import Tensor

from fprf.training.losses import NEARBY, ending

NAN = float("nan")
EDGES = torch.linspace(0.0, 10.0, 101)


def rays(count: int) -> Tensor:
    return EDGES.expand(count, -1)


def spike(*at: float) -> Tensor:
    """All weight of each ray in the interval around a distance."""
    weights = torch.zeros(len(at), 100)
    for row, t in enumerate(at):
        weights[row, int(t * 10)] = 1.0
    return weights


def test_a_ray_that_ends_at_its_point_costs_nothing() -> None:
    found = ending(rays(3), spike(3.0, 5.0, 9.5), torch.tensor([3.0, 5.0, 9.5]))
    assert found is not None and float(found) == 0.0


def test_before_the_point_costs_two_behind_it_one() -> None:
    before, behind = (ending(rays(1), spike(t), torch.tensor([5.0])) for t in (3.0, 8.0))
    assert before is not None and behind is not None
    assert float(before) == 2.0 and float(behind) == 1.0


def test_an_empty_ray_costs_one_and_wants_weight_at_its_point_alone() -> None:
    weights = torch.zeros(1, 100, requires_grad=True)
    found = ending(rays(1), weights, torch.tensor([5.05]))
    assert found is not None and float(found.detach()) == 1.0
    found.backward()
    assert weights.grad is not None
    near = (EDGES[1:] > 5.05 * (1 - NEARBY)) & (EDGES[:-1] < 5.05 * (1 + NEARBY))
    assert bool((weights.grad[0, near] < 0).all()) and bool((weights.grad[0, ~near] == 0).all())


@settings(deadline=None)
@given(st.lists(st.floats(0.5, 9.5) | st.just(float("nan")), min_size=1, max_size=6), st.integers(0, 1000))
def test_only_known_rays_count_and_the_mean_is_theirs(distances: list[float], seed: int) -> None:
    count = len(distances)
    weights = torch.rand(count, 100, generator=torch.Generator().manual_seed(seed))
    weights = weights / weights.sum(1, keepdim=True)
    distance = torch.tensor(distances)
    found = ending(rays(count), weights, distance)
    each = [float(one) for k in range(count) if (one := ending(rays(1), weights[k : k + 1], distance[k : k + 1])) is not None]
    if not each:
        assert found is None
        return
    assert found is not None and 0 <= float(found) <= 2
    torch.testing.assert_close(found, torch.tensor(each).mean(), atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("found", [3.0, 5.0, 8.0])
def test_in_device_coordinates_it_is_about_depths_too(found: float) -> None:
    """Straight ahead of a near plane at 1, depth z has the ray parameter 1 - 1/z."""
    depths, end = rays(1)[:, 10:], torch.tensor([5.0])
    weights = spike(found)[:, 10:]
    expected = ending(depths, weights, end)
    assert expected is not None
    torch.testing.assert_close(ending(1 - 1 / depths, weights, 1 - 1 / end, ndc=True), expected)


def test_it_does_not_depend_on_the_scale_of_space() -> None:
    weights = torch.rand(4, 100, generator=torch.Generator().manual_seed(1)) / 100
    distance = torch.tensor([1.03, 4.04, 5.02, 7.01])
    one, other = ending(rays(4), weights, distance), ending(rays(4) * 8, weights, distance * 8)
    assert one is not None and other is not None
    torch.testing.assert_close(one, other)


@pytest.mark.parametrize("known", [[1.0, NAN, 5.0, NAN], [NAN] * 4])
def test_a_device_gives_the_same_without_waiting(known: list[float]) -> None:
    """But for 0 where nothing is known."""
    weights, distance = torch.rand(4, 100), torch.tensor(known)
    here = weights.clone().requires_grad_()
    expected = ending(rays(4), here, distance)
    if expected is not None:
        expected.backward()
    with pretend_cuda() as seen:
        there = weights.to(CUDA).requires_grad_()
        given = rays(4).to(CUDA), there, distance.to(CUDA)
        found = ending(*given)
        assert found is not None
        found.backward()
        assert not seen.syncs
        gradient = there.grad
        assert gradient is not None
        torch.testing.assert_close(found.detach().cpu(), torch.zeros(()) if expected is None else expected.detach())
        torch.testing.assert_close(gradient.cpu(), torch.zeros_like(weights) if here.grad is None else here.grad)
