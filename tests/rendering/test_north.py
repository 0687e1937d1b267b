"""North from places in a world and positions on the earth."""

import math

import pytest
import torch
from torch import Tensor

from fprf.rendering.north import MAX_UNCERTAINTY_DEGREES, USUAL_ACCURACY_METRES, fit_north, metres_from
from fprf.rendering.splines import rotations

UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
NORTH = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)


def turn(seed: int) -> Tensor:
    """A rotation of the world, whatever its axes."""
    draw = torch.Generator().manual_seed(seed)
    return rotations(torch.nn.functional.normalize(torch.randn(1, 4, generator=draw).double(), dim=1))[0]


def walk(length: float, count: int, seed: int) -> Tensor:
    """Places [N 3] in metres east, north and up along a line of some length, a tenth of it to its sides."""
    draw = torch.Generator().manual_seed(seed)
    heading = 2 * math.pi * torch.rand(1, generator=draw).double()
    along = torch.linspace(-0.5, 0.5, count).double() * length
    across = 0.1 * length * (torch.rand(count, generator=draw).double() - 0.5)
    east = along * heading.sin() + across * heading.cos()
    north = along * heading.cos() - across * heading.sin()
    return torch.stack([east, north, torch.rand(count, generator=draw).double()], 1)


def error(found: Tensor, wanted: Tensor) -> float:
    """Degrees between two directions."""
    apart = torch.linalg.cross(found, wanted).norm()
    return math.degrees(math.atan2(float(apart), float(found @ wanted)))


@pytest.mark.parametrize("seed", range(4))
def test_exact_positions_tell_north_in_any_world(seed: int) -> None:
    here = walk(50.0, 9, seed)
    world = turn(seed)
    places = 0.037 * here @ world.T + torch.tensor([3.0, -8.0, 100.0]).double()
    found = fit_north(places, here[:, :2] + 1000, world @ UP)
    assert error(found.direction, world @ NORTH) < 1e-6 and abs(float(found.direction @ (world @ UP))) < 1e-9
    assert found.kept == 9 and found.extent == pytest.approx(50, rel=0.05) and found.uncertainty < 6


@pytest.mark.parametrize("length", [30.0, 100.0])
def test_the_direction_is_as_certain_as_it_is_said_to_be(length: float) -> None:
    metres = 3.0
    count = 20
    # Noise of deviation s turns a line of evenly spread positions by s / (length sqrt(N / 12)).
    deviation = math.degrees(metres / (length * math.sqrt(count / 12)))
    errors = []
    said = []
    for seed in range(20):
        here = walk(length, count, seed)
        world = turn(seed)
        draw = torch.Generator().manual_seed(100 + seed)
        noise = metres * torch.randn(count, 2, generator=draw).double()
        found = fit_north(0.2 * here @ world.T, here[:, :2] + noise, world @ UP)
        errors.append(error(found.direction, world @ NORTH))
        said.append(found.uncertainty)
    assert max(errors) < 4 * deviation
    assert math.sqrt(sum(each**2 for each in errors) / 20) < 1.5 * deviation
    # Beside it errors may drift, which only the extent tells. Noise of 20 positions is measured to a fifth.
    drift = math.degrees(USUAL_ACCURACY_METRES / length)
    assert math.hypot(0.6 * deviation, 0.7 * drift) < min(said)
    assert max(said) < math.hypot(2.2 * deviation, 1.4 * drift)
    assert sorted(said)[15] < MAX_UNCERTAINTY_DEGREES


def test_a_third_of_wrong_positions_is_left_out() -> None:
    here = walk(60.0, 24, 3)
    known = here[:, :2].clone()
    known[::3] += torch.tensor([400.0, -150.0]).double()
    found = fit_north(here, known, UP)
    assert error(found.direction, NORTH) < 1e-6 and found.kept == 16
    # Of wrong ones that do not agree either nothing is known.
    draw = torch.Generator().manual_seed(0)
    known[::2] = 500 * torch.randn(12, 2, generator=draw).double()
    assert fit_north(here, known, UP).uncertainty > MAX_UNCERTAINTY_DEGREES


@pytest.mark.parametrize(
    "places",
    [torch.zeros(8, 3).double(), walk(1.0, 8, 0), walk(4.0, 300, 0)],
    ids=["one place", "an arm's length", "many within a room"],
)
def test_cameras_close_together_tell_nothing(places: Tensor) -> None:
    draw = torch.Generator().manual_seed(0)
    known = places[:, :2] + 3 * torch.randn(len(places), 2, generator=draw).double()
    assert fit_north(places, known, UP).uncertainty > MAX_UNCERTAINTY_DEGREES
    # Nor do positions that are all one, as of a phone that has just been switched on.
    assert fit_north(places, known[:1].expand(len(places), 2), UP).uncertainty > MAX_UNCERTAINTY_DEGREES


def test_errors_that_drift_are_less_certain_than_as_many_independent_ones() -> None:
    here = walk(60.0, 60, 1)
    turns = torch.linspace(0, 6 * math.pi, 60).double()
    slow = 8 * torch.stack([turns.sin(), turns.cos()], 1)
    mixed = slow[torch.randperm(60, generator=torch.Generator().manual_seed(0))]
    drifting = fit_north(here, here[:, :2] + slow, UP)
    assert drifting.uncertainty > 2 * fit_north(here, here[:, :2] + mixed, UP).uncertainty
    for seed in range(10):
        draw = torch.Generator().manual_seed(seed)
        drift = torch.randn(60, 2, generator=draw).double().cumsum(0)
        found = fit_north(here, here[:, :2] + drift / drift.std(), UP)
        assert error(found.direction, NORTH) < 3 * found.uncertainty


def test_receivers_that_say_they_are_inexact_are_believed() -> None:
    here = walk(60.0, 20, 0)
    usual = fit_north(here, here[:, :2], UP)
    inexact = fit_north(here, here[:, :2], UP, 12.0)
    assert inexact.uncertainty == pytest.approx(12 / USUAL_ACCURACY_METRES * usual.uncertainty)


def test_metres_are_those_of_the_ellipsoid() -> None:
    # A minute of arc along a meridian is a nautical mile at 45 degrees, to a metre; across it shrinks by the cosine.
    latitude = torch.tensor([45.0, 45 + 1 / 60, 45.0]).double()
    longitude = torch.tensor([179.99, 179.99, -179.99]).double()
    metres = metres_from(latitude, longitude)
    assert float(metres[1, 1]) == pytest.approx(1852, abs=1) and float(metres[1, 0]) == pytest.approx(
        0, abs=1e-9
    )
    assert metres[2].tolist() == pytest.approx([0.02 * 78_847, 0], rel=1e-3, abs=1e-9), "over the date line"
    south = metres_from(torch.tensor([-33.0, -33.1]).double(), torch.tensor([18.0, 18.0]).double())
    assert float(south[1, 1]) == pytest.approx(-11_091, rel=1e-3)
