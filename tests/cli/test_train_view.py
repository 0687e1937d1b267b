import sys
from dataclasses import replace
from pathlib import Path

import pytest
from tiny_world import World, flags, parameters, same

from fprf.cli import main as cli
from fprf.cli import train
from fprf.cli.train import take_view
from fprf.errors import UsageError
from fprf.training.run import Run
from fprf.viewer.live import LiveViewer, ViewAddress

ADDRESS = "import sys, time; print('http://127.0.0.1:9/', flush=True); time.sleep(600)"
DEAD = "print('http://127.0.0.1:9/', flush=True)"
REFUSED = "import sys; sys.exit('error: --port 1: cannot listen there')"


def viewer(script: str, address: ViewAddress, run: Path) -> LiveViewer:
    return LiveViewer(address, run, (sys.executable, "-c", script))


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


@pytest.mark.parametrize("script", [ADDRESS, DEAD])
def test_what_is_trained_is_the_same_to_the_bit_whoever_looks(
    world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, script: str, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(train, "open_view", lambda place, run: viewer(script, place, run))
    assert cli.main(["train", "fprf-lite", *flags(world, tmp_path / "run"), "--view"]) == 0
    run = Run(tmp_path / "run")
    config = replace(world.config, output=None, checkpoint_minutes=0.2)
    assert run.load_config() == (config, "fprf-lite")
    assert same(parameters(run, 15), parameters(Run(world.run), 15))
    assert (tmp_path / "run" / "style.safetensors").read_bytes() == (world.run / "style.safetensors").read_bytes()
    told = capsys.readouterr().err
    assert "live at http://127.0.0.1:9/" in told and ("the viewer has ended" in told) == (script is DEAD)


def test_a_viewer_that_does_not_start_says_why(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="--view: --port 1: cannot listen there"):
        viewer(REFUSED, ViewAddress("127.0.0.1", 1, True), tmp_path)


def test_the_viewer_follows_the_run_folder_and_ends_with_training(world: World) -> None:
    with LiveViewer(ViewAddress("127.0.0.1", 0, True), world.run) as found:
        assert found.address.startswith("http://127.0.0.1:") and not found.looked_at and found.fault is None
        process = found._process
        found.wait()  # nobody looks
    assert process is not None and process.poll() is not None
