"""The content field: the contract, what moves what, and that ranges are checked."""

import pytest
import torch
from torch import Tensor

from fprf.fields.config import PlanesConfig
from fprf.fields.fields import PlanesField
from fprf.fields.planes import density, harmonics
from fprf.testing import check_content_field

SMALL = PlanesConfig(resolutions=(4, 9), channels=8, hidden=16)


def cloud(count: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    draw = torch.Generator().manual_seed(seed)
    view = torch.nn.functional.normalize(torch.randn(count, 3, generator=draw), dim=-1)
    return torch.empty(count, 3).uniform_(-1, 1, generator=draw), view


@pytest.mark.parametrize(
    "config",
    [
        SMALL,
        PlanesConfig(resolutions=(5,), channels=3, hidden=4, layers=0, degree=1),
        PlanesConfig(resolutions=(3, 4, 6), channels=24, hidden=8, layers=3, degree=2),
    ],
)
def test_the_contract(config: PlanesConfig) -> None:
    check_content_field(config)


def test_it_is_planes_then_a_linear_density_and_a_network() -> None:
    field = SMALL.build(channels=6, seed=0)
    assert isinstance(field, PlanesField)
    points, view = cloud(20)
    sample = field.density(points)
    assert torch.equal(sample.latent, field.planes(points)) and sample.latent.shape == (20, 16)
    assert torch.allclose(sample.density, density(sample.latent @ field.to_density.weight[0]), rtol=1e-6)
    with torch.no_grad():
        field.offset.copy_(torch.arange(6.0))
    found = field.content(sample.latent, view)
    network = field.to_content(torch.cat([sample.latent, harmonics(view, 4)], -1))
    assert torch.allclose(found, network + torch.arange(6.0), atol=1e-5)
    assert list(field.penalties()) == ["variation"]
    assert torch.equal(field.penalties()["variation"], field.planes.variation())


def test_kernels_and_plain_form_agree() -> None:
    field = SMALL.build(channels=6, seed=0)
    points, view = cloud(200)
    view = view[::5].repeat_interleave(5, 0)
    latent = field.density(points).latent
    with torch.no_grad():
        found = field.content(latent, view)
        assert field.content(latent[:0], view[:0]).shape == (0, 6)
        exact = field.double().content(latent.double(), view.double())
    assert torch.allclose(found.double(), exact, atol=1e-5)


def test_direction_changes_content_unless_there_is_none() -> None:
    points, view = cloud(20)
    for degree, changes in ((1, False), (2, True), (4, True)):
        field = PlanesConfig(resolutions=(4,), channels=8, hidden=16, degree=degree).build(channels=5, seed=0)
        latent = field.density(points).latent
        assert torch.equal(field.content(latent, view), field.content(latent, -view)) != changes


def test_density_does_not_meet_the_network() -> None:
    field = SMALL.build(channels=6, seed=0)
    assert isinstance(field, PlanesField)
    field.density(cloud(30)[0]).density.sum().backward()
    assert all(p.grad is None for p in field.to_content.parameters()) and field.offset.grad is None
    assert field.planes.table.grad is not None and field.to_density.weight.grad is not None


def test_the_start_is_thin_and_different_for_each_seed() -> None:
    points, _ = cloud(2000)
    thickness = [
        PlanesConfig(channels=8, resolutions=(8, 16)).build(channels=4, seed=s).density(points).density for s in range(5)
    ]
    for values in thickness:
        assert 0.2 < values.detach().mean().item() < 0.8
    assert not torch.equal(thickness[0], thickness[1])


def test_nothing_kept_has_no_features() -> None:
    """Rays through thin air may keep no sample at all, with kernels (no gradients) and without."""
    field = SMALL.build(channels=6, seed=0)
    points, view = cloud(12)
    for quiet in (True, False):
        with torch.set_grad_enabled(not quiet):
            latent = field.density(points).latent
            assert field.content(latent[:0], view[:0]).shape == (0, 6)
