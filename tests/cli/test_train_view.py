import json
from dataclasses import replace
from pathlib import Path

import pytest
from stand_in_viewers import DEAD, GREEDY, viewer
from tiny_world import World, flags, parameters, same

from fprf.cli import main as cli
from fprf.cli import train
from fprf.cli.train import take_view
from fprf.errors import UsageError
from fprf.training import trainer
from fprf.training.run import Run
from fprf.training.unfinished import UnfinishedFields
from fprf.viewer import live
from fprf.viewer.live import LiveViewer, ViewAddress


@pytest.mark.parametrize(
    ("words", "rest", "place"),
    [
        ("--steps 3", "--steps 3", None),
        ("--view", "", ViewAddress()),
        ("--view --steps 3", "--steps 3", ViewAddress()),
        ("--steps 3 --view 9000 --seed 1", "--steps 3 --seed 1", ViewAddress("127.0.0.1", 9000, True)),
        ("--view=0.0.0.0:0", "", ViewAddress("0.0.0.0", 0, True)),
        ("--view [::1]:81", "", ViewAddress("::1", 81, True)),
        ("--view :81", "", ViewAddress("127.0.0.1", 81, True)),
    ],
)
def test_the_flag_is_taken_out_of_the_others(words: str, rest: str, place: ViewAddress | None) -> None:
    assert take_view(words.split()) == (rest.split(), place)


@pytest.mark.parametrize("words", ["--view everywhere", "--view=70000", "--view=", "--view host:", "--view=²"])
def test_what_is_no_place_is_refused(words: str) -> None:
    with pytest.raises(UsageError, match="--view"):
        take_view(words.split())


@pytest.mark.parametrize("script", [GREEDY, DEAD])
def test_what_is_trained_is_the_same_to_the_bit_whoever_looks(
    world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, script: str, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "log"
    monkeypatch.setattr(train, "open_view", lambda place: LiveViewer(place, viewer(script, str(log))))
    monkeypatch.setattr(trainer, "REPORT_SECONDS", 0.0)  # look after every step
    assert cli.main(["train", "fprf-lite", *flags(world, tmp_path / "run"), "--view"]) == 0
    run = Run(tmp_path / "run")
    assert run.load_config() == (replace(world.config, output=None), "fprf-lite")
    assert same(parameters(run, 15), parameters(Run(world.run), 15))
    assert (tmp_path / "run" / "style.safetensors").read_bytes() == (world.run / "style.safetensors").read_bytes()
    assert "live at http://here/" in capsys.readouterr().err
    if script is GREEDY:
        assert "snapshot" in log.read_text()


def test_blocks_are_shown_one_after_the_other_and_trained_the_same(
    world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(train, "open_view", lambda place: LiveViewer(place, viewer(GREEDY, str(tmp_path / "log"))))
    monkeypatch.setattr(trainer, "REPORT_SECONDS", 0.0)
    monkeypatch.setattr(live, "_COPY_SHARE", 1e6)  # so short a training gives no time for more than one copy
    blocks = ["--blocks", "grid", "--blocks.cells", "2", "1", "--steps", "6"]
    for name, view in (("plain", []), ("shown", ["--view"])):
        assert cli.main(["train", "fprf-lite", *flags(world, tmp_path / name), *blocks, *view]) == 0
    for file in ("blocks/surroundings/block.safetensors", "blocks/00/block.safetensors", "style.safetensors"):
        assert (tmp_path / "plain" / file).read_bytes() == (tmp_path / "shown" / file).read_bytes()
    heard = [json.loads(line) for line in (tmp_path / "log").read_text().splitlines()]
    told = [(line["block"], line["what"]) for line in heard if "run" in line]
    assert told[0][1] == "surroundings" and {what for _, what in told} == {"surroundings", "block 00", "block 01"}
    shown = None
    for line in heard:
        shown = line["block"] if "run" in line else shown
        if "names" in line:  # what was handed over fits the model that the viewer builds
            assert line["names"] == sorted(UnfinishedFields(tmp_path / "shown", "cpu", shown).trained.model.state_dict())
    assert any("names" in line for line in heard)
