"""Pareto and scaling of the tiny run, and the list of all benchmarks."""

import json
from pathlib import Path

import cv2
import pytest
from tiny_world import World

from benchmarks.__main__ import BENCHMARKS, main

SMALL = ["--repeats", "2", "--rays", "64", "--device", "cpu"]


def bench(world: World, name: str, output: Path, *more: str) -> dict[str, object]:
    references = [str(path) for path in world.references]
    args = [name, str(world.run), "--references", *references, *SMALL, "--output", str(output), *more]
    assert main(args) == 0
    document = json.loads(output.read_text())
    assert (
        document["benchmark"] == {"profiling": "profile", "peak_memory": "memory"}.get(name, name)
        and document["settings"]["without"] == ""
    )
    return document


def test_pareto(world: World, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    document = bench(world, "pareto", tmp_path / "pareto.json", "--also", str(world.run))
    plain, styled = document["points"].values()
    knobs = {point["knob"] for point in plain}
    assert knobs >= {"run", "quality", "budget", "samples", "chunk", "resolution", "precision", "kernels", "method", "style"}
    assert "semantic channels" in {point["knob"] for point in styled}
    by_name = {f"{point['knob']} {point['value']}": point for point in plain}
    assert by_name["budget 0"]["largest_error"] < 1e-4
    for text, budget in (("1/64", 1 / 64), ("1/16", 1 / 16)):
        assert by_name[f"budget {text}"]["largest_error"] <= budget + 1e-5
    assert by_name["quality standard"]["rms_error"] == by_name["budget 1/512"]["rms_error"]
    assert by_name["run as trained"]["psnr"] == pytest.approx(by_name["method fprf-lite"]["psnr"])
    assert by_name["style at strength 0"]["rms_error"] == by_name["run as trained"]["rms_error"]
    assert 0 < by_name["precision planes stored in float16"]["rms_error"] < 1e-2
    kept = [counters["kept_samples_share"] for counters in document["counters_by_budget"].values()]
    assert kept[-1] > 0 and kept == sorted(kept, reverse=True)
    for name, front in document["fronts"].items():
        assert front["rms_error"] and {*front["rms_error"]} <= {f"{p['knob']} {p['value']}" for p in document["points"][name]}
    assert cv2.imread(str(tmp_path / "pareto.png")).std() > 5
    assert "time against error, plain" in capsys.readouterr().out


def test_scaling(world: World, tmp_path: Path) -> None:
    sizes = ["--images", "2", "3", "--downscales", "2", "1", "--styles", "1", "2", "--points", "200", "400"]
    document = bench(world, "scaling", tmp_path / "scaling.json", *sizes)
    series = {each["name"]: each for each in document["series"]}
    assert [each["of"] for each in document["series"]] == ["images", "images", "pixels", "references", "references", "points"]
    assert series["a batch"]["sizes"] == [2, 3] and series["tri-plane forward + backward"]["sizes"] == [200, 400]
    assert all(cost > 0 for each in series.values() for cost in each["milliseconds"])
    assert all(each["exponent"] is not None for each in series.values())


def test_profile(world: World, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    document = bench(world, "profiling", tmp_path / "profile.json", "--operators", "3")
    step, plain, styled = document["parts"].values()
    for taken in (step, plain, styled):
        shares = {name: part["share"] for name, part in taken["parts"].items()}
        assert sum(shares.values()) == pytest.approx(1) and all(share > -1e-6 for share in shares.values())
        assert taken["low"] <= taken["milliseconds"] <= taken["high"] and len(taken["operators"]) == 3
    assert step["parts"].keys() >= {
        "batch", "sampler", "density", "content", "semantic", "decoder", "losses", "optimizer",
        "backward of density", "backward of content", "backward of decoder", "backward of semantic", "rest",
    }  # fmt: skip
    assert "stylizer" in styled["parts"] and "stylizer" not in plain["parts"]
    assert not any(name.startswith("backward") for name in plain["parts"])
    captured = capsys.readouterr()
    assert "training step" in captured.out and all(line.startswith("{") for line in captured.err.splitlines())


@pytest.mark.slow
def test_memory(world: World, tmp_path: Path) -> None:
    document = bench(world, "peak_memory", tmp_path / "memory.json")
    rows = {row["name"]: row["figure"] for row in document["rows"]}
    assert 20 < rows["interpreter and packages"] < rows["and a loaded run"] < rows["and training steps"] < 4000
    assert rows["parameters of the field"] > 0


def test_every_benchmark_runs_and_none_is_forgotten(capsys: pytest.CaptureFixture[str]) -> None:
    folder = Path(__file__).parents[2] / "benchmarks"
    scripts = {path.stem for path in folder.glob("*.py") if "def main(argv" in path.read_text()}
    assert scripts == set(BENCHMARKS)
    assert main([]) == 2 and main(["--help"]) == 0 and all(f"  {name} " in capsys.readouterr().out for name in ("paper",))
    assert main(["papers"]) == 2 and capsys.readouterr().err.startswith("error: papers: no such benchmark")


def test_the_package_imports_no_benchmark() -> None:
    import ast

    for path in (Path(__file__).parents[2] / "fprf").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not any(name.split(".")[0] == "benchmarks" for name in names), path
