import math
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tiny_world import World

from fprf.benchmarking.config import StressConfig
from fprf.errors import FprfError
from fprf.io.atomic import write_json
from fprf.stress import files, pipeline, rays, styles
from fprf.stress.check import Check, markdown, relative, scaled, unsound
from fprf.stress.rays import exact_weights


def check(measured: float, bound: float, *, at_least: bool = False) -> Check:
    return Check(stage="s", input="a|b", reference="r", measured=measured, bound=bound, at_least=at_least)


@given(st.floats(), st.floats(allow_nan=False))
def test_a_bound_holds_or_it_does_not(measured: float, bound: float) -> None:
    assert check(measured, bound).passed == (measured <= bound)
    assert check(measured, bound, at_least=True).passed == (measured >= bound)


def test_rows_are_json_and_markdown_whatever_was_measured(tmp_path: Path) -> None:
    rows = [check(value, 1.0) for value in (0.5, 2.0, math.nan, math.inf)]
    write_json(tmp_path / "x.json", [row.json() for row in rows])
    text = markdown(rows)
    assert text.count("**broken**") == 3 and text.count("a\\|b") == 4 and len(text.splitlines()) == 6
    assert [row.json()["verdict"] for row in rows] == ["holds", "BROKEN", "BROKEN", "BROKEN"]


def test_measures_see_what_is_wrong() -> None:
    truth = torch.tensor([1.0, 1e-40, -2.0], dtype=torch.float64)
    assert relative(truth * (1 + 1e-9), truth, 1e-30) == pytest.approx(1e-9, rel=1e-3)
    assert relative(torch.tensor([1.0, math.nan, -2.0]), truth) == math.inf == scaled(torch.tensor([math.inf, 0, 0]), truth)
    assert scaled(torch.tensor([1.0, 0.0, -2.1]), truth) == pytest.approx(0.05, rel=1e-5)
    assert unsound(torch.tensor([1.0, math.nan]), torch.tensor([math.inf])) == 2
    assert relative(torch.zeros(0), torch.zeros(0)) == 0


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


@pytest.mark.parametrize(
    "stage", [rays.weights, rays.sampling, styles.statistics, styles.clusters, styles.matching, styles.stylizers, styles.guided]
)
def test_every_bound_of_a_stage_holds(stage) -> None:  # type: ignore[no-untyped-def]
    rows = stage()
    assert len(rows) >= 7 and not [row for row in rows if not row.passed]


def test_a_worse_formula_breaks_the_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    """1 - exp(-x) loses thin media: the report must see it."""

    def naive(density: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
        tau = density * (t[:, 1:] - t[:, :-1])
        return torch.exp(-(tau.cumsum(-1) - tau)) * (1 - torch.exp(-tau))

    monkeypatch.setattr(rays, "transmittance_weights", naive)
    broken = {row.input for row in rays.weights() if not row.passed}
    assert "fog of 1e-9 a step, N = 256, plain" in broken and not [name for name in broken if name.endswith("compiled")]


def test_readers_and_damage(tmp_path: Path) -> None:
    rows = [*files.readers(tmp_path / "r", 3, 0), *files.damage(tmp_path / "d", 40, 0)]
    assert len(rows) > 15 and not [row for row in rows if not row.passed]
    assert "3 mutations" in rows[0].input and "40 flipped bits" in rows[-1].input


def test_whole_renders(world: World) -> None:
    trained = world.load()
    cameras = trained.known.cameras.select(torch.tensor([3]))
    rows = pipeline.invariants(trained, world.prepared.scene, cameras, world.references)
    assert not [row for row in rows if not row.passed]
    names = {row.input for row in rows}
    assert {"world 1e6 m away", "rays in another order", "references in another order", "1 and 2 threads"} <= names
    without = pipeline.invariants(trained, None, cameras, world.references)
    assert {row.input for row in without} < names


def test_knobs_have_ranges() -> None:
    for wrong in ({"mutations": 0}, {"flips": -1}, {"steps": 0}):
        with pytest.raises(FprfError):
            StressConfig(**wrong)  # type: ignore[arg-type]
