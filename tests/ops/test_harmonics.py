"""Affine maps of view-dependent colours: float32 against fp64 at its bound, and what renderers cut."""

import pytest
import torch
from torch import Tensor

from fprf.ops.harmonics import HARMONIC, MAX_COLOUR, Directions, as_drawn, recoloured
from fprf.ops.harmonics import spherical_harmonics as functions
from fprf.splats.restyle import all_around

U = 2.0**-24
"""Unit round-off of float32."""


def inputs(count: int, bands: int) -> tuple[Tensor, Tensor, Tensor]:
    """Colours of which about half are below 0 from some directions; a seventh has no weight."""
    draw = torch.Generator().manual_seed(bands)
    harmonics = 0.15 * torch.randn(count, bands, 3, generator=draw)
    harmonics[:, 0] = 1.5 * torch.randn(count, 3, generator=draw)
    weight = torch.rand(count, generator=draw)
    weight[::7] = 0
    return harmonics, 0.3 * torch.randn(count, 4, 3, generator=draw), weight


def double(directions: Directions) -> Directions:
    return Directions(*(part.double() for part in directions))


@torch.no_grad()
@pytest.mark.parametrize("bands", [1, 4, 9, 16, 25])
@pytest.mark.parametrize("count", [0, 1, 1300])
def test_maps_stay_within_the_bound(bands: int, count: int) -> None:
    """Each number is a sum of 48 products (fitted again) and one of 4, of numbers that the largest input
    bounds.
    """
    harmonics, change, weight = inputs(count, bands)
    directions = all_around(bands)
    exact = recoloured(harmonics.double(), change.double(), weight.double(), double(directions))
    found = recoloured(harmonics, change, weight, directions)
    assert exact.dtype == torch.float64 and found.shape == harmonics.shape
    if count:
        bound = 60 * U * float(harmonics.abs().max()) * (1 + float(change.abs().max()))
        assert ((found.double() - exact).abs() <= bound).all()
    assert torch.equal(found[weight == 0], harmonics[weight == 0])


@torch.no_grad()
def test_mean_colours_are_not_mapped_above_the_limit() -> None:
    harmonics, change, weight = inputs(2000, 4)
    directions = all_around(4)
    before = 0.5 + HARMONIC * as_drawn(harmonics, directions)[:, 0]
    after = 0.5 + HARMONIC * recoloured(harmonics, 9 * change, weight, directions)[:, 0]
    some = (weight > 0)[:, None].expand_as(before)
    assert (after[some] <= before[some].clamp_min(MAX_COLOUR) + 1e-5).all() and int(some.sum()) > 2000
    assert (after[some] > MAX_COLOUR - 1e-5).any() and (after[some] < 0).any()


@torch.no_grad()
def test_harmonics_become_those_of_colours_as_they_are_drawn() -> None:
    made = torch.zeros(3, 4, 3)
    made[0, 0], made[0, 2] = 1.0, 0.2  # nowhere below 0
    made[1, 0] = -5.0  # black from everywhere
    made[2, 2] = 3.0  # below 0 on one side
    around = torch.nn.functional.normalize(
        torch.randn(500, 3, generator=torch.Generator().manual_seed(2)), dim=1
    )
    cut = (0.5 + torch.einsum("db,bc->dc", functions(around, 2), made[2])).clamp_min(0)
    nothing = torch.zeros(3, 4, 3), torch.ones(3), all_around(4)
    for out in (as_drawn(made, all_around(4)), recoloured(made, *nothing)):
        assert torch.allclose(out[0], made[0], atol=1e-6)
        assert (
            torch.allclose(0.5 + HARMONIC * out[1, 0], torch.zeros(3), atol=1e-5)
            and out[1, 1:].abs().max() < 1e-5
        )
        fitted, plain = (
            0.5 + torch.einsum("db,bc->dc", functions(around, 2), each) for each in (out[2], made[2])
        )
        assert (fitted - cut).square().mean() < 0.4 * (plain - cut).square().mean()
