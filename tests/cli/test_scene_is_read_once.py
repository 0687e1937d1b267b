"""Each command parses a scene folder once."""

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from tiny_world import World, flags

from fprf.cli import main as cli
from fprf.datamanagers.parsers import transforms


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """How often scenes were assembled from files."""
    count: Counter[str] = Counter()
    real: Callable[..., Any] = transforms.assemble_scene

    def assemble_scene(data: Path, *rest: Any, **options: Any) -> Any:
        count[data.name] += 1
        return real(data, *rest, **options)

    monkeypatch.setattr(transforms, "assemble_scene", assemble_scene)
    return count


@pytest.mark.parametrize("size", [[], ["--downscale", "1"], ["--downscale", "1.5"]])
@pytest.mark.parametrize("kind", ["gaussians", "fields"])
def test_training_reads_the_folder_once(
    world: World, tmp_path: Path, counted: Counter[str], size: list[str], kind: str
) -> None:
    words = ["train", "fprf-lite", *flags(world, tmp_path / "run"), "--steps", "2"]
    if kind == "gaussians":
        base = ["--data", str(world.town), "--output", str(tmp_path / "run"), "--device", "cpu"]
        words = ["train", "fprf-splats", *base, "--steps", "2", "--initial", "100", "--minutes", "1"]
    assert cli.main([*words, *size]) == 0
    assert counted == {"town": 1}
    counted.clear()
    assert cli.main([*words, *size, "--steps", "3"]) == 0, "it goes on"
    assert counted == {"town": 1}


def test_judging_and_looking_read_it_once(world: World, run: Path, counted: Counter[str]) -> None:
    assert cli.main(["eval", str(run), "--device", "cpu", "--images", "false"]) == 0
    assert counted == {"town": 1}
    counted.clear()
    assert cli.main(["doctor", str(world.town)]) == 0
    assert counted == {"town": 1}
