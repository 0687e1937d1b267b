"""Benchmarks on the tiny run, and the list of all of them."""

import json
from pathlib import Path

import pytest
import torch
from tiny_world import World

from benchmarks import stress_operators
from benchmarks.__main__ import BENCHMARKS, main
from benchmarks.stress import invariants
from benchmarks.styles import false_edges

SMALL = ["--repeats", "2", "--rays", "64", "--device", "cpu"]


def bench(world: World, name: str, output: Path, *more: str) -> dict[str, object]:
    references = [str(path) for path in world.references]
    args = [name, str(world.run), "--references", *references, *SMALL, "--output", str(output), *more]
    assert main(args) == 0
    document = json.loads(output.read_text())
    assert document["benchmark"] == name and document["settings"]["without"] == ""
    return document


def test_pareto(world: World, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    document = bench(world, "pareto", tmp_path / "pareto.json")
    plain, styled = ({point["name"]: point for point in points} for points in document["points"].values())
    assert {"run", "quality", "budget", "samples", "chunk", "resolution", "kernels"} == {name.split()[0] for name in styled}
    assert plain["budget 0"]["largest_error"] < 1e-4
    for text, budget in (("1/64", 1 / 64), ("1/16", 1 / 16)):
        assert plain[f"budget {text}"]["largest_error"] <= budget + 1e-5
    assert plain["quality standard"]["rms_error"] == plain["budget 1/512"]["rms_error"]
    assert plain["style at strength 0"]["rms_error"] == plain["run as trained"]["rms_error"]
    kept = [counters["kept_samples_share"] for counters in document["counters_by_budget"].values()]
    assert kept[-1] > 0 and kept == sorted(kept, reverse=True)
    for name, front in document["fronts"].items():
        assert front and {*front} <= {point["name"] for point in document["points"][name]}
    assert "time against error, plain" in capsys.readouterr().out


def test_every_benchmark_is_listed_and_says_what_it_needs(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = Path(__file__).parents[2] / "benchmarks"
    scripts = {path.stem for path in folder.glob("*.py") if "def main(argv" in path.read_text()}
    assert scripts | {"town"} == set(BENCHMARKS)
    absent = BENCHMARKS["fuzz_guided"]._replace(packages=("no_such_package",))
    monkeypatch.setitem(BENCHMARKS, "fuzz_guided", absent)
    assert main(["fuzz_guided", "--minutes", "1"]) == 2
    needs, error = capsys.readouterr().err.splitlines()
    assert needs.startswith("fuzz_guided needs the package atheris") and "no_such_package not installed" in error
    assert main([]) == 2 and main(["--help"]) == 0 and all(f"  {name} " in capsys.readouterr().out for name in ("paper",))
    assert main(["papers"]) == 2 and capsys.readouterr().err.startswith("error: papers: no such benchmark")


H, W, REACH = 36, 48, 3


def wall() -> torch.Tensor:
    """Even, with a quiet ramp of light."""
    return 0.4 + 0.1 * torch.linspace(0, 1, W).expand(H, W)[..., None].repeat(1, 1, 3)


def test_one_map_for_all_is_no_cut() -> None:
    plain = wall()
    for styled in (plain, 1 - plain, plain * 1.8, plain * torch.tensor([0.9, 0.2, 0.1]) + 0.1):
        assert false_edges(plain, styled) == 0


def test_a_style_that_ends_on_a_wall_cuts_the_pairs_across() -> None:
    plain, styled = wall(), wall()
    styled[:, : W // 2, 0] += 0.5
    pairs = H * (W - REACH) + (H - REACH) * W
    # Both pictures are blurred by a pixel, so that pairs which only touch the border count as well.
    assert false_edges(plain, styled) == pytest.approx(H * (REACH + 1) / pairs, rel=0.3)


def test_a_worse_formula_breaks_the_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    """1 - exp(-x) loses thin media: the report must see it."""

    def naive(density: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
        tau = density * (t[:, 1:] - t[:, :-1])
        return torch.exp(-(tau.cumsum(-1) - tau)) * (1 - torch.exp(-tau))

    monkeypatch.setattr(stress_operators, "transmittance_weights", naive)
    broken = {row.input for row in stress_operators.weights() if not row.passed}
    assert "fog of 1e-9 a step, N = 256" in broken


def test_whole_renders(world: World) -> None:
    trained = world.load()
    cameras = trained.known.cameras.select(torch.tensor([3]))
    rows = invariants(trained, world.prepared.scene, cameras, world.references)
    assert not [row for row in rows if not row.passed]
    names = {row.input for row in rows}
    assert {"world 1e6 m away", "rays in another order", "references in another order", "1 and 2 threads"} <= names
    without = invariants(trained, None, cameras, world.references)
    assert {row.input for row in without} < names
