import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tiny_world import World

from benchmarks import stress_operators
from benchmarks.stress import invariants
from benchmarks.stress_operators import Check, exact_weights


def check(measured: float, bound: float, *, at_least: bool = False) -> Check:
    return Check(stage="s", input="a|b", reference="r", measured=measured, bound=bound, at_least=at_least)


@given(st.floats(), st.floats(allow_nan=False))
def test_a_bound_holds_or_it_does_not(measured: float, bound: float) -> None:
    assert check(measured, bound).passed == (measured <= bound)
    assert check(measured, bound, at_least=True).passed == (measured >= bound)


def test_the_exact_weights_are_those_of_a_plain_loop() -> None:
    drawn = torch.Generator().manual_seed(3)
    density = torch.rand(3, 7, generator=drawn).double() * 3
    t = torch.rand(3, 8, generator=drawn).cumsum(1)
    found = exact_weights(density, t)
    for ray in range(3):
        through = 1.0
        for i in range(7):
            tau = float(density[ray, i]) * (float(t[ray, i + 1]) - float(t[ray, i]))
            assert float(found[ray, i]) == pytest.approx(-through * math.expm1(-tau), rel=1e-12)
            through *= math.exp(-tau)
    wanted = exact_weights(density.requires_grad_(True), t)
    assert torch.allclose(wanted, found, rtol=1e-9, atol=0)


def test_a_worse_formula_breaks_the_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    """1 - exp(-x) loses thin media: the report must see it."""

    def naive(density: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
        tau = density * (t[:, 1:] - t[:, :-1])
        return torch.exp(-(tau.cumsum(-1) - tau)) * (1 - torch.exp(-tau))

    monkeypatch.setattr(stress_operators, "transmittance_weights", naive)
    broken = {row.input for row in stress_operators.weights() if not row.passed}
    assert "fog of 1e-9 a step, N = 256, plain" in broken and not [name for name in broken if name.endswith("compiled")]


def test_whole_renders(world: World) -> None:
    trained = world.load()
    cameras = trained.known.cameras.select(torch.tensor([3]))
    rows = invariants(trained, world.prepared.scene, cameras, world.references)
    assert not [row for row in rows if not row.passed]
    names = {row.input for row in rows}
    assert {"world 1e6 m away", "rays in another order", "references in another order", "1 and 2 threads"} <= names
    without = invariants(trained, None, cameras, world.references)
    assert {row.input for row in without} < names
