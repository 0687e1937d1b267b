"""The parts of the lens models: derivatives against autograd, the inverse where Newton alone would run away."""

import math

import pytest
import torch

from fprf.rendering.lens import (
    OPENCV,
    PANORAMA,
    PINHOLE,
    _brown_step,
    _powers,
    _radial_inverse,
    bend,
    lens_reach,
    unbend,
)

DOUBLE = torch.float64


def test_where_the_lens_is_singular_a_step_is_finite() -> None:
    """k1 = -1/3: the radius turns at 1, and the Jacobian has no inverse there."""
    distortion, xy = torch.tensor([[-1 / 3, 0, 0, 0, 0, 0]], dtype=DOUBLE), torch.tensor([[1.0, 0.0]], dtype=DOUBLE)
    assert _brown_step(distortion, xy, torch.tensor([[0.1, 0.1]], dtype=DOUBLE)).isfinite().all()


@pytest.mark.parametrize("k1", [-0.3, -0.1, -1.0, 0.2])
@pytest.mark.parametrize("flat", [0.451, 0.6])
def test_a_radius_that_hardly_grows_is_inverted(k1: float, flat: float) -> None:
    """With k2 = 0.45 k1² the slope touches 0; above it u grows for ever, but Newton overshoots by far and needs its bracket."""
    k = torch.tensor([[k1, flat * k1 * k1, 0.0, 0.0]], dtype=DOUBLE)
    assert lens_reach(torch.cat([k, k.new_zeros(1, 2)], 1), torch.tensor([OPENCV])).item() == math.inf
    u = torch.cat([torch.linspace(0, 3, 301, dtype=DOUBLE), torch.tensor([1e-9, 30.0, 1e4], dtype=DOUBLE)]) / abs(k1) ** 0.5
    rho = _radial_inverse(k.expand(len(u), 4), u, torch.full_like(u, math.inf))
    share, slope = _powers(k.expand(len(u), 4), rho)
    assert ((share * rho - u).abs() <= 1e-13 * (1 + u) + 1e-14 * slope * rho).all()
    assert (rho.diff()[:300] > 0).all()


def test_beyond_the_reach_lies_the_reach() -> None:
    k, reach = torch.tensor([[-1 / 3, 0, 0, 0]], dtype=DOUBLE).expand(3, 4), torch.ones(3, dtype=DOUBLE)
    rho = _radial_inverse(k, torch.tensor([0.0, 2 / 3, 5.0], dtype=DOUBLE), reach)
    assert rho[0] == 0 and rho[1].item() == pytest.approx(1.0, abs=1e-6) and rho[2] == 1


def test_tangential_terms_are_undone_to_rounding() -> None:
    draw = torch.Generator().manual_seed(0)
    distortion = torch.tensor([[-0.1, 0.05, -0.01, 0.002, 0.02, -0.015]], dtype=DOUBLE).expand(500, 6)
    lens, reach = torch.full((500,), OPENCV), lens_reach(distortion, torch.full((500,), OPENCV))
    plane = torch.rand(500, 2, dtype=DOUBLE, generator=draw) * 1.2 - 0.6
    back = bend(distortion, lens, reach, unbend(distortion, lens, reach, plane))
    assert ((back - plane).norm(dim=1) <= 1e-13).all()


def test_a_panorama_s_coordinates_are_angles() -> None:
    lens, none = torch.full((4,), PANORAMA), torch.zeros(4, 6, dtype=DOUBLE)
    angles = torch.tensor([[0.0, 0.0], [math.pi / 2, 0.0], [0.0, math.pi / 2], [-2.0, -0.5]], dtype=DOUBLE)
    reach = lens_reach(none, lens)
    directions = unbend(none, lens, reach, angles)
    assert torch.allclose(directions[:3], torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]], dtype=DOUBLE), atol=1e-15)
    found = bend(none, lens, reach, 7 * directions)[[0, 1, 3]]
    assert torch.allclose(found, angles[[0, 1, 3]], atol=1e-14)


def test_panoramas_and_pinholes_side_by_side() -> None:
    lens = torch.tensor([PANORAMA, PINHOLE, PANORAMA])
    plane = torch.tensor([[0.3, 0.2], [0.3, 0.2], [-1.0, 0.5]], dtype=DOUBLE)
    none = torch.zeros(3, 6, dtype=DOUBLE)
    reach = lens_reach(none, lens)
    together = unbend(none, lens, reach, plane)
    alone = torch.cat([unbend(none[:1], lens[k : k + 1], reach[k : k + 1], plane[k : k + 1]) for k in range(3)])
    assert torch.equal(together, alone) and not torch.allclose(together[0], together[1], atol=1e-3)
