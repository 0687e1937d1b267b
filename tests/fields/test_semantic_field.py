"""The semantic field: the contract, no direction, no penalty."""

import inspect

import pytest
import torch

from fprf.fields.config import SemanticPlanesConfig
from fprf.fields.fields import SemanticPlanes
from fprf.testing import check_semantic_field

SMALL = SemanticPlanesConfig(resolutions=(4, 9), channels=8, hidden=16)


@pytest.mark.parametrize("config", [SMALL, SemanticPlanesConfig(resolutions=(3,), channels=5, hidden=4, layers=0)])
def test_the_contract(config: SemanticPlanesConfig) -> None:
    check_semantic_field(config)


def test_it_is_planes_then_a_network() -> None:
    field = SMALL.build(channels=7, seed=0)
    assert isinstance(field, SemanticPlanes)
    points = torch.empty(20, 3).uniform_(-1, 1, generator=torch.Generator().manual_seed(0))
    assert torch.allclose(field(points), field.network(field.planes(points)), atol=1e-6) and field(points).shape == (20, 7)
    learnt = field(points)
    with torch.no_grad():
        assert torch.equal(field(points), learnt)
    assert field.penalties() == {}
    assert list(inspect.signature(field.forward).parameters) == ["points"]
