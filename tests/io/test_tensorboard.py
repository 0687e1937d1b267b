"""Scalars for TensorBoard, read back by its own reader."""

import sys
from pathlib import Path

import pytest
from tiny_world import World

from fprf.cli import main as cli
from fprf.errors import UsageError
from fprf.io.report import write_scalars
from fprf.training.events import History, read_history

HISTORY = History("", [10, 20], [1.5, 3.0], {"psnr": [12.0, None], "colour": [0.5, 0.25]}, {}, [])


def test_without_the_package_one_line_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard.writer", None)
    with pytest.raises(UsageError, match=r"--tensorboard: .* pip install 'fprf\[tensorboard\]'"):
        write_scalars(tmp_path, [HISTORY])
    assert list(tmp_path.iterdir()) == []


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


def test_the_verb_writes_a_run(world: World, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("tensorboard", reason="the extra `tensorboard` is not installed")
    words = ["report", str(world.run), "--output", str(tmp_path / "r.html"), "--tensorboard", str(tmp_path / "tb")]
    assert cli.main(words) == 0
    [history] = read_history(world.run)
    found = read(tmp_path / "tb" / "training")
    assert found.keys() == {name for name, values in history.values.items() if any(v is not None for v in values)}
    assert "tensorboard --logdir" in capsys.readouterr().out
