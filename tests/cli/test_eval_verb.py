import json
import shutil
from pathlib import Path

import cv2
import pytest
from tiny_world import World

from fprf.cli import main as cli
from fprf.cli.eval import write_scalars
from fprf.training.run import History

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


HISTORY = History("", [10, 20], [1.5, 3.0], {"psnr": [12.0, None], "colour": [0.5, 0.25]}, [])


def read(folder: Path) -> dict[str, list[tuple[int, float, float]]]:
    reader = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    events = reader.EventAccumulator(str(folder))
    events.Reload()
    return {tag: [(e.step, e.wall_time, e.value) for e in events.Scalars(tag)] for tag in events.Tags()["scalars"]}


def test_what_is_written_is_read(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard", reason="the extra `tensorboard` is not installed")
    block = HISTORY._replace(name="02")
    for _ in range(2):  # again, in place of the first
        assert write_scalars(tmp_path, [HISTORY, block]) == 6
    assert {path.name for path in tmp_path.iterdir()} == {"training", "02"}
    found = read(tmp_path / "training")
    assert found == {"psnr": [(10, 1.5, 12.0)], "colour": [(10, 1.5, 0.5), (20, 3.0, 0.25)]} == read(tmp_path / "02")
