import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from tiny_world import World

import fprf.methods
from fprf.cli import main as cli
from fprf.datamanagers.parsers.config import TownConfig


@pytest.fixture
def _small(world: World, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The demo's own code on a smaller town and a smaller model."""
    monkeypatch.setattr(fprf.methods, "fprf_lite", lambda: replace(world.config, output=None, steps=10))
    made = TownConfig.__init__
    monkeypatch.setattr(made, "__kwdefaults__", made.__kwdefaults__ | {"views": 10, "width": 32, "height": 24})
    monkeypatch.setattr("fprf.cli.demo.LOOKS", {"autumn": (3, 9), "night": (2, 4)})
    monkeypatch.chdir(tmp_path)


@pytest.mark.usefixtures("_small")
def test_the_demo_from_nothing_to_a_gallery(world: World, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    args = ["demo", "--output", "out", "--minutes", "5", "--frames", "4"]
    out = tmp_path / "out"
    (out / "references").mkdir(parents=True)
    shutil.copy(world.references[1], out / "references" / "night.png")
    assert cli.main(args) == 0, "and pictures that lie there already are not painted again"
    assert {p.name for p in out.iterdir()} >= {"run", "references", "film.mp4", "metrics.json", "gallery.html"}
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics.keys() >= {
        "method", "scene", "psnr", "ssim", "dictionary_seconds", "restyled_seconds_per_view", "total_seconds", "per_view",
    }  # fmt: skip
    assert (metrics["scene"], metrics["views"], metrics["train_steps"]) == ("town", 2, 10)
    assert sorted(p.name for p in (out / "references").iterdir()) == ["autumn.png", "night.png"]
    assert (out / "references" / "night.png").read_bytes() == world.references[1].read_bytes()
    page = (out / "gallery.html").read_text()
    assert "autumn + night" in page and "http://" not in page.replace("http://www.w3.org", "")
    assert "open out/gallery.html" in capsys.readouterr().out


@pytest.mark.parametrize(("args", "told"), [(["--minutes", "0"], "--minutes: 0.0 must be above 0"),
                                            (["--frames", "1"], "--frames: 1 must be at least 2"),
                                            (["--data", "x"], "--data: no such flag")])  # fmt: skip
def test_mistakes(args: list[str], told: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["demo", *args]) == 2
    assert told in capsys.readouterr().err
