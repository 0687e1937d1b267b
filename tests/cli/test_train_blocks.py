"""`fprf train` with blocks on the command line: train, judge, restyle."""

import json
from pathlib import Path

import pytest
from tiny_world import World, flags

from fprf.cli.main import main

BLOCKS = ["--blocks", "grid", "--blocks.cells", "2", "1", "--steps", "4"]


def test_from_training_to_styles(world: World, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = tmp_path / "run"
    command = ["train", "fprf-lite", *flags(world, run), *BLOCKS]
    assert main(command) == 0
    assert main(["eval", str(run), "--max-memory", "1"]) == 0
    metrics = json.loads((run / "metrics.json").read_text())
    assert 5 < metrics["psnr"] < 40
    assert main(["stylize", str(run), "--references", *map(str, world.references), "--max-memory", "1"]) == 0
    assert len(list((run / "styles").rglob("*.png"))) >= 2
    film = ["render", str(run), "--path", "interpolate", "--frames", "3", "--output", str(tmp_path / "film")]
    assert main([*film, "--max-memory", "1"]) == 0
    assert len(list((tmp_path / "film").glob("*.png"))) >= 3
    before = (run / "blocks/00/done.json").read_bytes()
    capsys.readouterr()
    assert main(command) == 0
    assert "block 00 is finished already" in capsys.readouterr().err
    assert (run / "blocks/00/done.json").read_bytes() == before
