import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import pytest
from tiny_world import World

from fprf.cli import main as cli

KEYS = {
    "method", "scene", "split", "psnr", "ssim", "lpips", "views", "render_seconds", "seconds_per_view", "rays_per_second",
    "kept_samples_share", "peak_rss_mib", "train_seconds", "train_steps", "consistency", "per_view",
}  # fmt: skip


def evaluated(run: Path, *words: str) -> dict[str, Any]:
    assert cli.main(["eval", str(run), *words]) == 0
    return json.loads((run / "metrics.json").read_text())


def test_metrics_table_and_pictures(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    metrics = evaluated(run)
    assert metrics.keys() >= KEYS
    assert (metrics["method"], metrics["split"], metrics["views"], metrics["train_steps"]) == ("fprf-lite", "test", 2, 15)
    assert metrics["per_view"].keys() == {"0000", "0008"}
    assert metrics["psnr"] == pytest.approx(sum(v["psnr"] for v in metrics["per_view"].values()) / 2)
    assert sorted(p.name for p in (run / "renders" / "test").iterdir()) == ["0000.png", "0008.png"]
    assert cv2.imread(str(run / "renders" / "test" / "0000.png")).shape == (24, 32, 3)
    table = capsys.readouterr().out
    assert "psnr" in table and f"{metrics['psnr']:.3f}" in table and "rays/s" in table


def test_poses_are_fitted_where_that_is_asked_and_told(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    few = {"steps": 20, "rays": 256, "rate": 2e-3}
    monkeypatch.setattr("fprf.evaluation.evaluate.AlignmentConfig.__init__.__kwdefaults__", few)
    plain, metrics = (evaluated(run, "--no-images", *words) for words in ([], ["--fit-poses"]))
    assert "fitted_poses" not in plain
    assert metrics["fitted_poses"].keys() == {"0000", "0008"}
    for move in metrics["fitted_poses"].values():
        assert move.keys() == {"turn_degrees", "shift"} and move["turn_degrees"] > 0
    assert metrics["psnr"] > plain["psnr"] - 0.05


def test_data_that_has_moved(run: Path, world: World, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = run / "config.json"
    config.write_text(config.read_text().replace(str(world.town), str(tmp_path / "gone")))
    assert cli.main(["eval", str(run)]) == 2
    assert f"error: {tmp_path / 'gone'}: no such folder" in capsys.readouterr().err
    shutil.copytree(world.town, tmp_path / "there")
    assert cli.main(["eval", str(run), "--data", str(tmp_path / "there"), "--no-images"]) == 0
