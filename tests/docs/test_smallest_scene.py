"""The kind of scene that docs/plugins.md shows works as it stands there."""

import json
import re
from pathlib import Path

import pytest
from fake_packages import packages_in
from tiny_world import World

from fprf.cli.main import main

TEXT = (Path(__file__).parents[2] / "docs" / "plugins.md").read_text("utf-8")


def test_it_trains_resumes_and_is_judged(
    world: World, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shown = TEXT.partition("## The smallest kind of scene")[2]
    code = re.findall(r"```python\n(.*?)```", shown, re.S)[0]
    points = {
        "fprf.methods": {"even": "acme_even:EvenConfig"},
        "fprf.scenes": {"even": "acme_even:open_even"},
    }
    run = tmp_path / "run"
    train = ["train", "even", "--data", str(world.town), "--downscale", "1", "--output", str(run)]
    with packages_in(tmp_path / "site") as packages:
        packages.install("acme-even", points, code={"acme_even": code})
        assert main(train) == 0
        assert main([*train, "--steps", "25"]) == 0
        assert main(["eval", str(run)]) == 0
        metrics = json.loads((run / "metrics.json").read_text())
        assert metrics["train_steps"] == 25
        assert 5 < metrics["psnr"] < 20
        style = ["--references", str(world.references[0]), "--output", str(tmp_path / "dusk")]
        assert main(["stylize", str(run), *style]) == 2
        assert "takes no style" in capsys.readouterr().err
