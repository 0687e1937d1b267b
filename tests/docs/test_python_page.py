"""The code of docs/python.md, word for word, on the tiny run."""

import json
import os
import re
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import cv2
import pytest
from splat_ball import ball
from tiny_world import World

from fprf.methods import fprf_splats
from fprf.splats.files import read_capture, write_gaussians
from fprf.training.driver import train

DOCS = Path(__file__).resolve().parents[2] / "docs"
PAGE, NOTEBOOK = DOCS / "python.md", DOCS / "tour.ipynb"


def test_the_page_runs(
    world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").mkdir()
    os.symlink(world.run, tmp_path / "runs" / "town-fprf-lite")
    for name, reference in zip(("autumn.jpg", "night.jpg"), world.references, strict=True):
        cv2.imwrite(name, cv2.imread(str(reference)))
    write_gaussians(Path("scan.ply"), ball(200))
    names: dict[str, object] = {}
    for block in re.findall(r"^```python\n(.*?)^```", PAGE.read_text("utf-8"), re.DOTALL | re.MULTILINE):
        exec(compile(block, str(PAGE), "exec"), names)
    told = capsys.readouterr().out
    assert "torch.Size([120, 160, 3])" in told and "'autumn.jpg'" in told and "'night.jpg'" in told
    made = {path.name for path in tmp_path.iterdir()}
    assert {"autumn.png", "film.mp4", "mine.json", "between-0.png", "between-2.png"} <= made
    assert "(200, 3) True" in told
    scans = [f"scan{name}" for name in ("_autumn.spz", "-0.5.ply", "-1.0.ply", "_night.splat", "_grey.ply", ".glb")]
    assert all(len(read_capture(Path(name)).gaussians) == 200 for name in scans)


def cells(kind: str) -> list[str]:
    return ["".join(cell["source"]) for cell in json.loads(NOTEBOOK.read_text("utf-8"))["cells"] if cell["cell_type"] == kind]


def test_every_cell_runs_in_order_on_the_garden(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    few = replace(fprf_splats(), steps=10, initial=800, cap=900, downscale=8)
    train(replace(few, data=Path(str(files("fprf") / "garden")), output=Path("demo/run")), "fprf-splats", quiet=True)
    names: dict[str, object] = {}
    for number, source in enumerate(cells("code"), 1):
        exec(compile(source, f"cell {number}", "exec"), names)
    told = capsys.readouterr().out
    assert "25 captured views" in told and "film.mp4:" in told and "'night.jpg'" in told
    assert len(read_capture(Path("night.ply")).gaussians) > 500
    made = {path.name for path in tmp_path.iterdir()}
    assert {"plain.png", "wide.png", "autumn.png", "mine.json", "film.mp4"} <= made
