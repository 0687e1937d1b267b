"""`fprf train`: refused, interrupted, watched, in blocks."""

import json
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
from tiny_world import World, flags, parameters, same

from fprf.cli import main as cli
from fprf.cli.main import main
from fprf.config import TrainConfig
from fprf.datamanagers.batches import RayBatches
from fprf.errors import UsageError
from fprf.methods import fprf_lite
from fprf.plugins import registry
from fprf.plugins.config import Need
from fprf.plugins.decoders.config import MlpDecoderConfig
from fprf.plugins.encoders.config import EncoderConfig
from fprf.training import checkpoint, driver
from fprf.training.driver import train
from fprf.training.run import Run


def test_a_config_json_goes_on_with_its_run_wherever_that_lies(world: World, tmp_path: Path) -> None:
    shutil.copytree(world.run, tmp_path / "moved")
    assert cli.main(["train", str(tmp_path / "moved" / "config.json"), "--steps", "17"]) == 0
    assert checkpoint.steps(tmp_path / "moved" / "checkpoints") == [15, 17]
    assert checkpoint.steps(world.run / "checkpoints") == [15]
    assert Run(tmp_path / "moved").load_config()[0].steps == 17


def test_another_config_in_an_existing_run_is_refused_before_any_work(
    world: World, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fprf.training.field_setup.prepare", None)
    before = (world.run / "config.json").read_bytes()
    assert (
        cli.main(["train", "fprf-lite", *flags(world, world.run), "--render.chunk", "77", "--seed", "5"]) == 2
    )
    *progress, line = capsys.readouterr().err.splitlines()
    assert all(each.startswith("{") for each in progress), "progress alone stands before it"
    assert f"{world.run}: holds a run with seed 0 (5 is asked), render.chunk 8192 (77 is asked)" in line
    assert f"--output {world.run}-2" in line
    assert (world.run / "config.json").read_bytes() == before


def test_an_interrupt_is_130_and_the_run_goes_on(
    world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = RayBatches.batch

    def stop(self: RayBatches, step: int) -> object:
        if step == 3:
            raise KeyboardInterrupt
        return whole(self, step)

    monkeypatch.setattr(RayBatches, "batch", stop)
    assert cli.main(["train", "fprf-lite", *flags(world, tmp_path / "run")]) == 130
    assert capsys.readouterr().err.endswith("interrupted\n")
    assert checkpoint.steps(tmp_path / "run" / "checkpoints") == [3]
    monkeypatch.setattr(RayBatches, "batch", whole)
    assert cli.main(["train", "fprf-lite", *flags(world, tmp_path / "run")]) == 0
    assert same(parameters(Run(tmp_path / "run"), 15), parameters(Run(world.run), 15))


def test_everything_that_is_missing_is_listed_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The plug-ins' own, the scene, and nothing is made. A stranger's encoder says its needs as ours do."""

    @dataclass(frozen=True, kw_only=True)
    class Strange(EncoderConfig):
        def needs(self) -> tuple[Need, ...]:
            return (
                Need("the model odd-1", "odd fetch odd-1"),
                Need("the file of labels", "odd labels", downloaded=True),
            )

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(registry, "name_of", lambda group, kind: "strange")
    semantic = replace(fprf_lite().semantic, encoder=Strange())
    decoder = MlpDecoderConfig(weights=tmp_path / "none.safetensors")
    config = replace(fprf_lite(), semantic=semantic, content=replace(fprf_lite().content, decoder=decoder))
    with pytest.raises(UsageError, match="4 things are missing; `fprf doctor m` looks again"):
        train(config, "m")
    told = capsys.readouterr().err
    for part in (
        "odd fetch odd-1",
        "odd labels",
        "none.safetensors: no such weights file",
        "no scene is named",
    ):
        assert part in told
    assert list(tmp_path.iterdir()) == []


def test_a_size_that_is_found_stays_with_the_run(
    world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a number in config.json; the same command goes on with it, whatever would be found today."""
    found = iter((2, 3))
    monkeypatch.setattr(
        TrainConfig, "planned", lambda config, scene, device: replace(config, downscale=next(found))
    )
    for steps in ("2", "3"):
        args = [*flags(world, tmp_path / "run"), "--steps", steps]
        assert cli.main(["train", "fprf-lite", *args[:4], *args[6:]]) == 0
    run = Run(tmp_path / "run")
    assert run.load_config()[0].downscale == 2 and run.load_known().cameras.size[0].tolist() == [16, 12]
    assert checkpoint.steps(run.checkpoints) == [2, 3]


def test_what_is_trained_is_the_same_to_the_bit_whoever_looks(
    world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a viewer of its own process that cannot start, too."""
    monkeypatch.setattr(driver, "REPORT_SECONDS", 0.0)
    monkeypatch.setattr(driver, "_MIN_PAUSE", 0.0)
    monkeypatch.setattr(driver, "is_watched", lambda root: True)
    assert cli.main(["train", "fprf-lite", *flags(world, tmp_path / "run"), "--view"]) == 0
    run = Run(tmp_path / "run")
    assert run.load_config() == (replace(world.config, output=None), "fprf-lite")
    assert same(parameters(run, 15), parameters(Run(world.run), 15))
    assert (run.root / "style.safetensors").read_bytes() == (world.run / "style.safetensors").read_bytes()


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
