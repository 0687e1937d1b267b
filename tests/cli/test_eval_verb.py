import json
import shutil
from pathlib import Path

import cv2
import pytest
from tiny_world import World

from fprf.cli import main as cli

KEYS = {
    "method", "scene", "split", "psnr", "cc_psnr", "ssim", "lpips", "views", "render_seconds", "seconds_per_view",
    "rays_per_second", "kept_samples_share", "peak_rss_mib", "train_seconds", "train_steps", "consistency", "per_view",
}  # fmt: skip


def test_metrics_table_and_pictures(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["eval", str(run)]) == 0
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics.keys() >= KEYS and "fitted_poses" not in metrics
    assert (metrics["method"], metrics["split"]) == ("fprf-lite", "test")
    assert sorted(p.name for p in (run / "renders" / "test").iterdir()) == ["0000.png", "0008.png"]
    assert cv2.imread(str(run / "renders" / "test" / "0000.png")).shape == (24, 32, 3)
    table = capsys.readouterr().out
    assert "psnr" in table and f"{metrics['psnr']:.3f}" in table and "rays/s" in table


def test_data_that_has_moved(run: Path, world: World, tmp_path: Path) -> None:
    config = run / "config.json"
    config.write_text(config.read_text().replace(str(world.town), str(tmp_path / "gone")))
    shutil.copytree(world.town, tmp_path / "there")
    assert cli.main(["eval", str(run), "--data", str(tmp_path / "there"), "--no-images"]) == 0
