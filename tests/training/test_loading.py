import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from fake_packages import METHOD, packages_in
from tiny_world import World

from fprf.cli.parsing import load_method
from fprf.config import IncompleteConfig
from fprf.errors import CheckpointError, UsageError
from fprf.training.driver import train
from fprf.training.loading import load_run


@pytest.fixture
def moved(world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The run on a stranger's machine: another place, no images, no cache."""
    shutil.copytree(world.run, tmp_path / "elsewhere" / "run")
    for name in ("scene.json", "config.json"):
        file = tmp_path / "elsewhere" / "run" / name
        file.write_text(file.read_text().replace(str(world.town), "/nowhere/at/all"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "no-cache"))
    monkeypatch.chdir(tmp_path)
    return Path("elsewhere/run")


def test_a_moved_run_renders_the_same_bits(world: World, moved: Path) -> None:
    here, there = world.load(), load_run(moved)
    assert there.method == "fprf-lite" and there.step == 15 and there.seconds > 0
    assert there.known.data == "/nowhere/at/all"
    for v in there.known.test:
        a, b = (trained.render(trained.cameras, v) for trained in (here, there))
        assert torch.equal(a.rgb, b.rgb) and torch.equal(a.depth, b.depth)


def test_rendering_needs_no_encoder(moved: Path) -> None:
    path = moved / "config.json"
    path.write_text(path.read_text().replace('"bundled-content"', '"gone-content"').replace('"bundled-semantic"', '"gone"'))
    trained = load_run(moved)
    assert bool(trained.render(trained.cameras, 0).rgb.isfinite().all())


def test_what_is_missing_is_named_with_what_to_do(moved: Path, tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="so it is no run folder; `fprf train` makes one"):
        load_run(tmp_path)
    shutil.rmtree(moved / "checkpoints")
    with pytest.raises(CheckpointError, match=r"no checkpoint yet; go on with `fprf train elsewhere/run/config\.json"):
        load_run(moved)
    (moved / "scene.json").unlink()
    with pytest.raises(CheckpointError, match=r"scene\.json: cannot be read.*train the scene again"):
        load_run(moved)


def test_a_run_of_a_method_with_fields_of_its_own(world: World, moved: Path, tmp_path: Path) -> None:
    """It goes on with its own fields alone, and renders where the method is not installed."""
    trained, site = load_run(moved), tmp_path / "site"
    site.mkdir()
    with packages_in(site) as packages:
        packages.install("acme-method", {"fprf.methods": {"acme": "acme_method2:acme"}}, code={"acme_method2": METHOD})
        config = replace(load_method("acme")[0], **vars(trained.config))
        trained.run.save_config(config, "acme")
        saved = (moved / "config.json").read_text()
        with pytest.raises(UsageError, match=r"a run with knob 2 \(8 is asked\)"):
            train(replace(config, knob=8, output=moved), "acme", quiet=True)  # type: ignore[call-arg]
    there = load_run(moved)
    assert isinstance(there.config, IncompleteConfig) and there.method == "acme"
    assert torch.equal(trained.render(trained.cameras, 0).rgb, there.render(there.cameras, 0).rgb)
    there.run.save_config(there.config, there.method)
    assert (moved / "config.json").read_text() == saved
