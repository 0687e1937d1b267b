from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tiny_world import World

from fprf.datamanagers.batches import RayBatches
from fprf.datamanagers.scene import Scene
from fprf.errors import ConfigError, DataError, PluginError
from fprf.training.prepare import cache_folder, device_of, exposure_of, prepare


def test_what_is_found_out(world: World) -> None:
    facts, scene = world.prepared.facts, world.prepared.scene
    assert len(scene.paths) == 10 and facts.dim == 8 and facts.channels > 8
    assert facts.content_encoder.startswith("bundled-content:")
    assert facts.semantic_encoder.startswith("bundled-semantic:")
    batch = world.prepared.manager.batch(0)
    assert batch.content is not None and batch.semantic is not None and world.prepared.basis is not None
    assert batch.content.shape == (256, facts.channels) and batch.semantic.shape == (128, facts.dim)
    # The scales are the unit of the losses: the RMS deviation of the targets.
    many = [world.prepared.manager.batch(step) for step in range(8)]
    content = torch.cat([b.content for b in many if b.content is not None])
    assert facts.content_scale == pytest.approx(float(content.var(0).mean().sqrt()), rel=0.2)


def test_features_are_computed_once(world: World) -> None:
    told: list[tuple[int, int, str]] = []

    def files() -> dict[Path, int]:
        return {p: p.stat().st_ino for p in cache_folder().rglob("*") if p.is_file() and p.suffix != ".json"}

    before = files()
    again = prepare(world.config, lambda *of: told.append(of))
    assert again.facts == world.prepared.facts
    assert before and files() == before, "nothing new, nothing written twice"
    assert told[-1][:2] == (8, 8) and told[-1][2].startswith("features of bundled-semantic")


def test_without_semantics(world: World) -> None:
    found = prepare(replace(world.config, semantic=replace(world.config.semantic, encoder=None)))
    assert found.facts.dim == 0 and found.facts.semantic_encoder == "" and found.basis is None
    assert found.manager.batch(0).semantic is None


def test_the_background_of_the_config_counts(world: World) -> None:
    found = prepare(replace(world.config, render=replace(world.config.render, background=(0.0, 0.0, 0.0))))
    assert found.facts.background == (0.0, 0.0, 0.0) and world.prepared.facts.background is None


def test_no_data_is_told(world: World, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no such folder"):
        prepare(replace(world.config, data=tmp_path / "absent"))


def test_devices() -> None:
    assert device_of("cpu") == torch.device("cpu")
    assert device_of("auto").type in ("cpu", "cuda", "mps")
    for name in ("gpu", "", "cuda:99"):
        with pytest.raises(PluginError, match="not available here; use cpu or auto"):
            device_of(name)


def test_the_cache_follows_the_environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "fprf"
    for unset in ("", None):
        monkeypatch.setenv("XDG_CACHE_HOME", "") if unset == "" else monkeypatch.delenv("XDG_CACHE_HOME")
        assert cache_folder() == Path.home() / ".cache" / "fprf"


def test_images_and_renders_show_the_same_background(world: World) -> None:
    given = (0.5, 0.25, 0.0)
    found = prepare(replace(world.config, render=replace(world.config.render, background=given)))
    assert found.facts.background == given
    assert isinstance(found.manager, RayBatches) and found.manager.background == given
    for wrong in (1.5, -0.1, float("nan")):
        with pytest.raises(ConfigError, match=r"render\.background"):
            replace(world.config.render, background=(0.0, wrong, 0.0))


def test_tones_are_learnt_where_exposures_differ(world: World) -> None:
    """Unless the config decides; a run that goes on keeps what it began with."""
    scene, image = world.prepared.scene, world.prepared.manager.image
    evenly = replace(scene, exposure=torch.full((len(scene.paths),), 3.0, dtype=torch.float64))
    unevenly = replace(scene, exposure=torch.linspace(1.0, 4.0, len(scene.paths), dtype=torch.float64))

    def learnt(tones: bool | None, scene: Scene) -> bool:
        return bool(exposure_of(replace(world.config, tones=tones), scene, image))

    assert [learnt(None, each) for each in (scene, evenly, unevenly)] == [False, False, True]
    assert [learnt(own, each) for own in (True, False) for each in (evenly, unevenly)] == [True, True, False, False]
    saved = replace(world.prepared.facts, exposure=(0.0,) * len(scene.paths))
    for facts in (saved, world.prepared.facts):
        assert exposure_of(world.config, unevenly, image, facts) == facts.exposure
