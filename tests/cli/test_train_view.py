from dataclasses import replace
from pathlib import Path

import pytest
from tiny_world import World, flags, parameters, same

from fprf.cli import main as cli
from fprf.cli.train import ViewAddress, take_view
from fprf.errors import UsageError
from fprf.training import driver
from fprf.training.run import Run


@pytest.mark.parametrize(
    ("words", "rest", "place"),
    [
        ("--steps 3", "--steps 3", None),
        ("--view", "", ViewAddress()),
        ("--view --steps 3", "--steps 3", ViewAddress()),
        ("--steps 3 --view 9000 --seed 1", "--steps 3 --seed 1", ViewAddress("127.0.0.1", 9000)),
        ("--view=0.0.0.0:0", "", ViewAddress("0.0.0.0", 0)),
        ("--view [::1]:81", "", ViewAddress("::1", 81)),
        ("--view :81", "", ViewAddress("127.0.0.1", 81)),
    ],
)
def test_the_flag_is_taken_out_of_the_others(words: str, rest: str, place: ViewAddress | None) -> None:
    assert take_view(words.split()) == (rest.split(), place)


@pytest.mark.parametrize("words", ["--view everywhere", "--view=70000", "--view=", "--view host:", "--view=²"])
def test_what_is_no_place_is_refused(words: str) -> None:
    with pytest.raises(UsageError, match="--view"):
        take_view(words.split())


def test_what_is_trained_is_the_same_to_the_bit_whoever_looks(
    world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a viewer of its own process that cannot start, too."""
    monkeypatch.setattr(driver, "REPORT_SECONDS", 0.0)
    monkeypatch.setattr(driver, "_MIN_PAUSE", 0.0)
    monkeypatch.setattr(driver, "is_watched", lambda root: True)
    assert cli.main(["train", "fprf-lite", *flags(world, tmp_path / "run"), "--view", "256.0.0.1:1"]) == 0
    run = Run(tmp_path / "run")
    assert run.load_config() == (replace(world.config, output=None), "fprf-lite")
    assert same(parameters(run, 15), parameters(Run(world.run), 15))
    assert (run.root / "style.safetensors").read_bytes() == (world.run / "style.safetensors").read_bytes()
