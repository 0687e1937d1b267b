"""Runs opened from their folder alone, in any quality and in the light of any view."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from fake_packages import METHOD, packages_in
from tiny_world import World

from fprf.cli import main as cli
from fprf.cli.parsing import load_method
from fprf.errors import CheckpointError, PluginError, UsageError, WeightsError
from fprf.plugins.encoders.config import BundledContentConfig, BundledSemanticConfig
from fprf.training.camera_optimizers import Tones
from fprf.training.driver import train
from fprf.training.field_scene import Trained, load_run
from fprf.training.field_setup import prepare
from fprf.training.model import Model
from fprf.training.prepare import read_scene
from fprf.training.quality import PRESETS, QualityConfig, at_quality


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
    here = world.load()
    there = load_run(moved)
    assert there.method == "fprf-lite" and there.step == 15 and there.seconds > 0
    assert there.known.data == "/nowhere/at/all"
    for v in there.known.test:
        a, b = (trained.render(trained.cameras, v) for trained in (here, there))
        assert torch.equal(a.rgb, b.rgb) and torch.equal(a.depth, b.depth)


def test_rendering_needs_no_encoder(moved: Path) -> None:
    path = moved / "config.json"
    path.write_text(
        path.read_text()
        .replace('"bundled-content"', '"gone-content"')
        .replace('"bundled-semantic"', '"gone"')
    )
    trained = load_run(moved)
    assert bool(trained.render(trained.cameras, 0).rgb.isfinite().all())


def test_all_weights_that_are_missing_are_told(world: World) -> None:
    trained = world.load()
    content = replace(trained.config.content, encoder=BundledContentConfig(weights=Path("a.pt")))
    semantic = replace(trained.config.semantic, encoder=BundledSemanticConfig(weights=Path("b.pt")))
    config = replace(trained.config, content=content, semantic=semantic)
    for act in (replace(trained, config=config).encoders, lambda: prepare(config, read_scene(config))):
        with pytest.raises(WeightsError, match=r"a\.pt: no such.*b\.pt: no such"):
            act()


def test_what_is_missing_is_named_with_what_to_do(moved: Path, tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="so it is no run folder; `fprf train` makes one"):
        load_run(tmp_path)
    shutil.rmtree(moved / "checkpoints")
    with pytest.raises(
        CheckpointError, match=r"no checkpoint yet; go on with `fprf train elsewhere/run/config\.json"
    ):
        load_run(moved)
    (moved / "scene.json").unlink()
    with pytest.raises(CheckpointError, match=r"scene\.json: cannot be read.*train the scene again"):
        load_run(moved)


def test_a_run_of_a_method_with_fields_of_its_own(world: World, moved: Path, tmp_path: Path) -> None:
    """It goes on with its own fields alone, and needs its method."""
    trained = load_run(moved)
    with packages_in(tmp_path / "site") as packages:
        packages.install(
            "acme-method", {"fprf.methods": {"acme": "acme_method2:acme"}}, code={"acme_method2": METHOD}
        )
        config = replace(load_method("acme")[0], **vars(trained.config))
        trained.run.save_config(config, "acme")
        with pytest.raises(UsageError, match=r"a run with knob 2 \(8 is asked\)"):
            train(replace(config, knob=8, output=moved), "acme", quiet=True)  # type: ignore[call-arg]
    with pytest.raises(PluginError, match=r"config\.json: .*acme.*; install acme-method"):
        load_run(moved)


def test_eval_takes_it(world: World, tmp_path: Path) -> None:
    shutil.copytree(world.run, tmp_path / "run")
    kept = {}
    for name in (None, *PRESETS):
        args = ["eval", str(tmp_path / "run"), "--no-images", *([] if name is None else ["--quality", name])]
        assert cli.main(args) == 0
        metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
        assert metrics["quality"] == name
        kept[name] = metrics["psnr"], metrics["kept_samples_share"]
    assert kept[None] == kept["standard"] != kept["draft"] and kept["best"][0] >= kept["draft"][0]


def test_a_reduced_view_is_the_small_one_enlarged(world: World) -> None:
    trained = world.load()
    known = trained.known
    whole, half = (trained.render(known.cameras, 2, resolution=resolution) for resolution in (1.0, 0.5))
    small = trained.render(known.cameras.scaled(2), 2)
    assert half.rgb.shape == whole.rgb.shape and half.depth.shape == whole.depth.shape == half.opacity.shape
    assert float(half.rgb.min()) >= 0 and float(half.rgb.max()) <= 1
    assert {*half.depth.flatten().tolist()} == {*small.depth.flatten().tolist()}, (
        "no depth that nobody measured"
    )
    blocks = half.opacity.view(12, 2, 16, 2).mean((1, 3))
    assert torch.allclose(blocks[1:-1, 1:-1], small.opacity[1:-1, 1:-1], atol=0.05)
    assert float((half.rgb - whole.rgb).abs().mean()) < 0.05 and not torch.equal(half.rgb, whole.rgb)


def lit(world: World) -> Trained:
    """The run, with tones as if they had been learnt."""
    trained = world.load()
    known = trained.known
    tones = Tones(torch.linspace(-0.5, 0.5, len(known.names)), known.test)
    with torch.no_grad():
        tones.gain.copy_(0.2 * torch.randn(len(known.names), 3, generator=torch.Generator().manual_seed(0)))
    return replace(trained, model=Model(trained.model.parts, tones))


def shown(trained: Trained, tone: str | None = None) -> tuple[torch.Tensor, torch.Tensor]:
    chosen = at_quality(trained, QualityConfig(tone=tone))
    view = chosen.known.cameras, chosen.known.test[0]
    return chosen.render(*view).rgb, chosen.cached(*view).restyled().rgb


def test_colours_are_multiplied_by_a_view_s_light(world: World) -> None:
    trained = lit(world)
    assert trained.model.tones is not None
    view = trained.known.train[1]
    wanted = (shown(trained)[0] * trained.model.tones(torch.tensor([view]))[0].detach()).clamp(0, 1)
    for text in (trained.known.names[view], str(view)):
        for image in shown(trained, text):
            torch.testing.assert_close(image, wanted, atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("tone", ["nowhere", "1=1", "99", "-1", "0"])
def test_what_is_no_light_of_a_training_view_is_refused(world: World, tone: str) -> None:
    for trained in (lit(world), world.load()):
        with pytest.raises(UsageError):
            shown(trained, tone)
