import json
import re
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import cv2
import pytest
import torch

import fprf.methods
from fprf.cli import main as cli
from fprf.datamanagers.parsers.config import parse_scene
from fprf.splats.files import read_capture

GARDEN = Path(str(files("fprf") / "garden"))


def test_the_demo_from_nothing_to_a_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    small = replace(fprf.methods.fprf_splats(), steps=10, initial=800, cap=900)
    monkeypatch.setattr(fprf.methods, "fprf_splats", lambda: small)
    out = tmp_path / "out"
    args = ["demo", "--output", str(out), "--minutes", "5", "--downscale", "8"]
    assert cli.main(args) == 0
    styles = ["all-together.ply", "autumn.ply", "night.ply", "sunset.ply", "winter.ply"]
    assert {p.name for p in out.iterdir()} >= {"run", "metrics.json", "garden.html", *styles}
    plain, *others = [read_capture(out / name).gaussians for name in ("night.ply", "autumn.ply", "winter.ply")]
    assert all(torch.equal(plain.means, each.means) and not torch.equal(plain.harmonics, each.harmonics) for each in others)
    metrics = json.loads((out / "metrics.json").read_text())
    assert (metrics["method"], metrics["scene"], metrics["views"], metrics["train_steps"]) == ("fprf-splats", "garden", 4, 10)
    assert metrics["total_seconds"] > metrics["new_style_seconds"] > 0
    page = (out / "garden.html").read_text()
    assert "CC BY 4.0" in page and not re.findall(r"""(?:src|href)=["'](?!data:|#)""", page), "it loads nothing"
    assert f"open {out / 'garden.html'}" in capsys.readouterr().out


def test_held_out_views_of_the_garden_are_surrounded_by_others() -> None:
    scene = parse_scene(GARDEN, 1, None)
    assert len(scene.train) == 21 and scene.points is not None
    train, test = ([int(view) for view in views] for views in (scene.train, scene.test))
    assert len(test) == 4 and all({view - 1, view + 1} <= {*train} for view in test)


def test_photographs_that_ship_are_credited_and_small() -> None:
    credits = (GARDEN / "README.md").read_text()
    references = sorted((GARDEN / "references").iterdir())
    assert references and all(path.stem in credits for path in references)
    assert all(max(cv2.imread(str(path)).shape) <= 640 for path in references)
    assert sum(path.stat().st_size for path in GARDEN.rglob("*") if path.is_file()) < 3e6
