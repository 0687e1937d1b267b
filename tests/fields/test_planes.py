"""Learned planes as a module: seeded, positive at the start, continuous, and right where lookups are."""

import pytest
import torch

from fprf.fields.fields import ProposalField
from fprf.fields.planes import Planes
from fprf.ops import triplane


def planes_of(seed: int = 0, channels: int = 8) -> Planes:
    return Planes((4, 9), channels, generator=torch.Generator().manual_seed(seed))


def points_of(count: int) -> torch.Tensor:
    return torch.empty(count, 3).uniform_(-1, 1, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("channels", [8, 5])
def test_features_are_lookups_of_the_one_table(channels: int) -> None:
    planes = planes_of(channels=channels)
    assert [name for name, _ in planes.named_parameters()] == ["table"]
    assert planes.table.shape == (triplane.rows((4, 9)), channels)
    found = planes(points_of(30))
    assert found.shape == (30, planes.out) and planes.out == 2 * channels
    assert torch.equal(found, triplane.lookup(points_of(30), planes.table, (4, 9)))
    assert torch.equal(planes.variation(), triplane.variation(planes.table, (4, 9)))


def test_the_start_is_positive_and_seeded() -> None:
    one, same, other = planes_of(1).table, planes_of(1).table, planes_of(2).table
    assert torch.equal(one, same) and not torch.equal(one, other)
    assert one.min() >= 0.1 and one.max() <= 0.5
    # Mean 0.3 and deviation 0.4 / sqrt 12, to four standard errors.
    assert abs(one.mean().item() - 0.3) <= 4 * 0.1155 / one.numel() ** 0.5
    assert (planes_of()(points_of(50)) > 0).all()


def test_every_node_about_a_point_learns() -> None:
    planes = planes_of()
    planes(points_of(4000)).sum().backward()
    assert planes.table.grad is not None and (planes.table.grad > 0).all()


def test_planes_are_continuous_across_cells() -> None:
    planes = planes_of()
    line = torch.linspace(-1, 1, 4001)
    found = planes(torch.stack([line, -line, 0.3 * line], -1)).detach()
    # Values below 0.5, products below 0.125; the steepest step is 8 nodes across 4000.
    assert found.diff(dim=0).abs().max() <= 3 * 0.4 * 0.25 * 4 * 2 / 4000 * 2


def test_a_proposal_is_one_scale_and_a_linear_map() -> None:
    field = ProposalField(6, 8, seed=3)
    found = field(points_of(20))
    raw = field.to_density(field.planes(points_of(20)))[:, 0]
    assert found.shape == (20,) and torch.allclose(found, torch.exp(raw - 1))
    assert field.planes.resolutions == (6,) and field(points_of(0)).shape == (0,)
    same, other = ProposalField(6, 8, seed=3), ProposalField(6, 8, seed=4)
    assert torch.equal(same(points_of(20)), found) and not torch.equal(other(points_of(20)), found)
