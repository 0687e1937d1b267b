"""The list of benchmarks, each the whole way and small, what the larger ones say of the tiny run;
`benchmarks/gpu.sh`.
"""

import importlib.util
import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import pytest
import torch
from tiny_world import World

from benchmarks import gpu_rows, stress_operators
from benchmarks.__main__ import BENCHMARKS, main
from benchmarks.restyle import BOUND, FLAT, GLOBAL, GOALS, MATCHED, PLAIN, STYLIZERS
from benchmarks.speed import plain_planes
from benchmarks.subject import difference, exact, plainly, view_rays
from benchmarks.town.truth import set_stage, town_settings, true_views
from benchmarks.town.write import read_truth, write_town
from fprf.evaluation.metrics import psnr
from fprf.plugins.stylizers.config import LocalAdainConfig, RegionOtConfig
from fprf.style.config import StyleConfig
from fprf.style.files import StyleFile
from fprf.style.restyle import apply_style
from fprf.training.views import render_view


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
    assert (
        needs.startswith("fuzz_guided needs the package atheris") and "no_such_package not installed" in error
    )
    assert (
        main([]) == 2
        and main(["--help"]) == 0
        and all(f"  {name} " in capsys.readouterr().out for name in ("paper",))
    )
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
def test_a_mistake_is_one_line(
    line: str, told: str, world: World, capsys: pytest.CaptureFixture[str]
) -> None:
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


def test_a_peer_s_frames_are_judged_by_all_that_can_be_known(
    world: World, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The town at night as a peer's restyling of the town by day: exact, and nothing is missing."""
    write_town(tmp_path / "night", seed=0, palette="night", views=10, width=32, height=24)
    frames = str(tmp_path / "night" / "images")
    plain = str(world.town / "images")
    page = tmp_path / "page.md"
    output = tmp_path / "peer.json"
    words = [
        "--cameras",
        str(world.town / "transforms.json"),
        "--plain",
        plain,
        "--depth",
        str(world.town / "depth"),
    ]
    words += [
        "--truth",
        frames,
        "--references",
        str(world.references[0]),
        "--page",
        str(page),
        "--output",
        str(output),
    ]
    assert main(["peer", frames, *words, "--device", "cpu"]) == 0
    document = json.loads(output.read_text())
    assert document["frames"] == 10 and document["size"] == [32, 24] and document["missing"] == {}
    assert document["truth"] == {"psnr": 99.0, "cc_psnr": 99.0, "ssim": 1.0, "lpips": 0.0, "delta_e": 0.0}
    assert document["published"]["short"]["pairs"] > 0 and document["published"]["long"]["rmse"] > 0
    assert document["steadiness"]["sharpness"] > 0.5
    assert document["style"]["style_distance"] > 0 and 0 < document["style"]["structure"] < 1
    assert page.read_text() in capsys.readouterr().out


def test_the_truth_is_the_town_itself(world: World) -> None:
    trained = world.load()
    stage = set_stage(trained, trained.known, town_settings(trained.config), views=2, frames=8, longest=32)
    assert stage.settings.seed == 0 and stage.settings.palette == "day"
    assert len(stage.shown) == len(stage.truth) == 2 and len(stage.passed) == len(stage.path_truth) == 8
    held_out = world.load().known.test
    for truth, view in zip(stage.truth, held_out, strict=False):
        depth, labels = read_truth(world.town, view)
        assert torch.equal(truth.labels, torch.from_numpy(labels.astype("int64")))
        assert torch.allclose(truth.depth, torch.from_numpy(depth))
    photographs = [world.prepared.manager.image(view) for view in held_out[:2]]
    for rendered, taken in zip(true_views(stage, "day"), photographs, strict=True):
        assert psnr(rendered, taken) > 60
    night = true_views(stage, "night")
    day = true_views(stage, "day")
    assert float(night[0].mean()) < 0.5 * float(day[0].mean())


SMALL = ["--palettes", "night", "--views", "1", "--longest", "24", "--clusters", "4", "--device", "cpu"]
UNMATCHED = {PLAIN, *GLOBAL, MATCHED, BOUND}
METHODS = {*UNMATCHED, FLAT, *STYLIZERS, "nearest-code"}


def test_every_method_is_in_the_table(
    world: World, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "docs/page.md"
    sheet = tmp_path / "docs/sheets/all.png"
    files = ["--output", str(tmp_path / "a.json"), "--page", str(page), "--sheet", str(sheet)]
    assert main(["restyle", str(world.run), *SMALL, *files]) == 0
    document = json.loads((tmp_path / "a.json").read_text())
    assert set(document["means"]) == {"one", "three"}
    found = document["palettes"]["night"]["three"]
    assert set(found["rows"]) == METHODS and set(found["delta_e_by_class"]) == METHODS
    for name, row in found["rows"].items():
        assert 0 < row["psnr"] < 99 and -1 <= row["ssim"] <= 1 and row["delta_e"] > 0
        assert (row["match"] is not None) == (name not in UNMATCHED)
        assert (row["consistency"] is None) == (name in (MATCHED, BOUND))
    assert found["rows"]["no change"]["consistency"] == 0
    assert document["recommended"] == "region-tone" and document["means"]["three"]["no change"]["lpips"] > 0
    assert set(document["verdict"]["goals"]) == set(document["verdict"]["met"]) == set(GOALS)
    # A map that knows the truth is nearer to it than doing nothing, whatever the scene.
    assert found["rows"][BOUND]["psnr"] > found["rows"]["no change"]["psnr"]
    assert document["provenance"]["torch"] and document["settings"]["town_seed"] == 0
    text = page.read_text()
    assert "](sheets/all.png)" in text and all(name in text for name in METHODS)
    assert cv2.imread(str(sheet)) is not None
    assert "region-tone" in capsys.readouterr().out


def test_exact_is_double_and_every_way_comes_near_it(world: World) -> None:
    trained = world.load()
    known = trained.known
    model = trained.model
    rays = view_rays(model, known.cameras, 1)
    for stylizer in (None, RegionOtConfig(), LocalAdainConfig()):
        look = (
            None
            if stylizer is None
            else apply_style(
                trained, StyleFile(StyleConfig(references=world.references, stylizer=stylizer))
            ).restyle
        )
        truth = exact(model, known.facts, rays, look)
        assert truth.dtype == torch.float64 and truth.shape == (24 * 32, 3)
        render = replace(trained.config.render, budget=0.0)
        ways = {
            "ours": render_view(model, known.facts, known.cameras, 1, render, look).rgb.view(-1, 3),
            "plain": plainly(model, known.facts, rays, render, look),
        }
        with plain_planes(model):
            ways["naive"] = plainly(model, known.facts, rays, render, look)
        for name, found in ways.items():
            assert difference(found, truth).largest < 1e-4, name
    assert all(p.dtype == torch.float32 for p in model.parameters()), "the run's own model stays as it is"


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("name", BENCHMARKS)
def test_it_runs(name: str, capfd: pytest.CaptureFixture[str]) -> None:
    for package in BENCHMARKS[name].packages:
        if importlib.util.find_spec(package) is None:
            pytest.skip(f"{package} is not installed")
    assert main([name, "--quick"]) == 0
    assert capfd.readouterr().err.startswith(f"{name} needs ")


ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "benchmarks" / "results"
INTERPRETER = """#!PYTHON
import os, shutil, sys
from pathlib import Path
words, kept = sys.argv[1:], Path(os.environ["KEPT"])
if words[0].endswith("gpu_check.py"):
    os.execv(sys.executable, [sys.executable, *words])
if words[1] == "benchmarks.gpu_rows":
    shutil.copytree(words[2], kept / "work")
    sys.exit(1)
with open(kept / "commands", "a") as file:
    print(*words, sep="\\t", file=file)
if os.environ["FAILS"] in words:
    print("this is why")
    sys.exit(3)
if "eval" in words:
    Path(words[3]).mkdir()
    shutil.copy(kept / "metrics.json", words[3])
if "speed" in words:
    shutil.copy(os.environ["RESULTS"] + "/speed_fox.json", words[words.index("--output") + 1])
"""
METRICS = {
    "method": "fprf",
    "scene": "flower",
    "train_seconds": 179.0,
    "train_steps": 9000,
    "views": 5,
    "psnr": 26.5,
}


def script(folder: Path, *words: str, fails: str = "nothing") -> tuple[int, list[list[str]]]:
    """Exit status and commands of the script with an interpreter that runs none of them; its folder is
    kept.
    """
    folder.mkdir(exist_ok=True)
    stand_in = folder / "python"
    stand_in.write_text(INTERPRETER.replace("PYTHON", sys.executable, 1))
    stand_in.chmod(0o755)
    (folder / "metrics.json").write_text(json.dumps(METRICS))
    environment = {
        **os.environ,
        "PYTHON": str(stand_in),
        "KEPT": str(folder),
        "RESULTS": str(RESULTS),
        "FAILS": fails,
    }
    command = ["bash", str(ROOT / "benchmarks" / "gpu.sh"), *words]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, cwd=folder, timeout=100)
    asked = folder / "commands"
    return done.returncode, [
        line.split("\t") for line in asked.read_text().splitlines()
    ] if asked.is_file() else []


def test_a_failed_step_is_reported_and_the_others_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code, commands = script(tmp_path / "run", "--dry", fails="speed")
    assert code == 1, "what gpu_rows.py says"
    kinds = ["pytest", "train", "eval", "speed"]
    found = [next(word for word in command if word in (*kinds, "gaussians")) for command in commands]
    assert found == [*kinds, "train", "eval", "gaussians"]
    output = tmp_path / "gpu.json"
    monkeypatch.setattr(sys, "argv", ["gpu_rows.py", str(tmp_path / "run" / "work"), "--output", str(output)])
    assert gpu_rows.main() == 1
    made = json.loads(output.read_text())
    assert {each["step"]: each["passed"] for each in made["steps"]} == {
        "tests": True, "train": True, "eval": True, "speed": False, "gaussians": True, "eval-gaussians": True, "steps": True,
    }  # fmt: skip
    rows = {row["name"]: row for row in made["rows"]}
    assert rows["held-out PSNR"]["goal"] == 26 and rows["held-out PSNR"]["goal_is"] == "at least"
    assert "by the CPU's kernels" in rows["held-out PSNR of 3D Gaussians"]["note"]
    assert len(rows) == 3 and made["steps"][3]["said"] == "this is why\n"
