"""Benchmarks on the tiny run, and the list of all of them."""

from pathlib import Path

import pytest
import torch
from tiny_world import World

from benchmarks import stress_operators
from benchmarks.__main__ import BENCHMARKS, main


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


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("speed nowhere", "nowhere: no config.json"),
        ("restyle RUN --device cpu --seeds 0 1 2", "is the town of the run itself"),
        ("restyle RUN --device cpu --palettes noon", "noon"),
        ("restyle --frames 7", "--frames"),
    ],
)
def test_a_mistake_is_one_line(line: str, told: str, world: World, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(line.replace("RUN", str(world.run)).split()) == 2
    lines = [each for each in capsys.readouterr().err.splitlines() if not each.startswith("{")]
    assert len(lines) == 2 and " needs " in lines[0], "needs are said first"
    assert lines[1].startswith("error: ") and told in lines[1]


def test_a_worse_formula_breaks_the_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    """1 - exp(-x) loses thin media: the report must see it."""

    def naive(density: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
        tau = density * (t[:, 1:] - t[:, :-1])
        return torch.exp(-(tau.cumsum(-1) - tau)) * (1 - torch.exp(-tau))

    monkeypatch.setattr(stress_operators, "transmittance_weights", naive)
    broken = {row.input for row in stress_operators.weights() if not row.passed}
    assert "fog of 1e-9 a step, N = 256" in broken
