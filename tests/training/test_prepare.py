from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tiny_world import World

from fprf.datamanagers.scene import Scene
from fprf.errors import PluginError
from fprf.training.prepare import cache_folder, device_of, exposure_of, prepare


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


def test_devices() -> None:
    assert device_of("cpu") == torch.device("cpu")
    assert device_of("auto").type in ("cpu", "cuda", "mps")
    for name in ("gpu", "", "cuda:99"):
        with pytest.raises(PluginError, match="not available here; use cpu or auto"):
            device_of(name)


def test_tones_are_learnt_where_exposures_differ(world: World) -> None:
    """Unless the config decides; a run that goes on keeps what it began with."""
    scene, image = world.prepared.scene, world.prepared.manager.image
    evenly = replace(scene, exposure=torch.full((len(scene.paths),), 3.0, dtype=torch.float64))
    unevenly = replace(scene, exposure=torch.linspace(1.0, 4.0, len(scene.paths), dtype=torch.float64))

    def learnt(tones: bool | None, scene: Scene) -> bool:
        return bool(exposure_of(tones, scene, image))

    assert [learnt(None, each) for each in (scene, evenly, unevenly)] == [False, False, True]
    assert [learnt(own, each) for own in (True, False) for each in (evenly, unevenly)] == [True, True, False, False]
    saved = replace(world.prepared.facts, exposure=(0.0,) * len(scene.paths))
    for facts in (saved, world.prepared.facts):
        assert exposure_of(world.config.tones, unevenly, image, facts) == facts.exposure
