"""`benchmarks/gpu.sh`: which commands it runs, that it goes on where one fails, and what its JSON then holds."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import gpu_rows

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
METRICS = {"method": "fprf", "scene": "flower", "train_seconds": 179.0, "train_steps": 9000, "views": 5, "psnr": 26.5}


def script(folder: Path, *words: str, fails: str = "nothing") -> tuple[int, list[list[str]]]:
    """Exit status and commands of the script with an interpreter that runs none of them; its folder is kept."""
    folder.mkdir(exist_ok=True)
    stand_in = folder / "python"
    stand_in.write_text(INTERPRETER.replace("PYTHON", sys.executable, 1))
    stand_in.chmod(0o755)
    (folder / "metrics.json").write_text(json.dumps(METRICS))
    environment = {**os.environ, "PYTHON": str(stand_in), "KEPT": str(folder), "RESULTS": str(RESULTS), "FAILS": fails}
    command = ["bash", str(ROOT / "benchmarks" / "gpu.sh"), *words]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, cwd=folder, timeout=100)
    asked = folder / "commands"
    return done.returncode, [line.split("\t") for line in asked.read_text().splitlines()] if asked.is_file() else []


def test_a_failed_step_is_reported_and_the_others_go_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code, commands = script(tmp_path / "run", "--dry", fails="speed")
    assert code == 1, "what gpu_rows.py says"
    kinds = ["pytest", "train", "eval", "speed"]
    assert [next(word for word in command if word in kinds) for command in commands] == [*kinds, "train", "eval"]
    output = tmp_path / "gpu.json"
    monkeypatch.setattr(sys, "argv", ["gpu_rows.py", str(tmp_path / "run" / "work"), "--output", str(output)])
    assert gpu_rows.main() == 1
    found = json.loads(output.read_text())
    assert {each["step"]: each["passed"] for each in found["steps"]} == {
        "tests": True, "train": True, "eval": True, "speed": False, "gaussians": True, "eval-gaussians": True,
    }  # fmt: skip
    rows = {row["name"]: row for row in found["rows"]}
    assert rows["held-out PSNR"]["goal"] == 26 and rows["held-out PSNR"]["goal_is"] == "at least"
    assert "by the CPU's kernels" in rows["held-out PSNR of 3D Gaussians"]["note"]
    assert len(rows) == 3 and found["steps"][3]["said"] == "this is why\n"
