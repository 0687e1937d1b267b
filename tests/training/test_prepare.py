"""Before training: features, tones, the size of images, the first model; and what training came to."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tiny_world import World, prepared_for

from fprf.errors import PluginError, UsageError
from fprf.methods import fprf_lite
from fprf.training.field_learner import training_summary
from fprf.training.model import build_model
from fprf.training.prepare import device_of, exposure_of, planned, read_scene
from fprf.training.run import Run


def test_without_semantics(world: World) -> None:
    found = prepared_for(replace(world.config, semantic=replace(world.config.semantic, encoder=None)))
    assert (
        found.facts.of_field.dim == 0 and found.facts.of_field.semantic_encoder == "" and found.basis is None
    )
    assert found.manager.batch(0).semantic is None


def test_tones_are_learnt_where_exposures_differ(world: World) -> None:
    """Unless the config decides; a run that goes on keeps what it began with."""
    scene = world.prepared.scene
    image = world.prepared.manager.image
    evenly = replace(scene, exposure=torch.full((len(scene.paths),), 3.0, dtype=torch.float64))
    unevenly = replace(scene, exposure=torch.linspace(1.0, 4.0, len(scene.paths), dtype=torch.float64))

    for tones, expected in ((None, [False, False, True]), (True, [True] * 3), (False, [False] * 3)):
        assert [bool(exposure_of(tones, each, image)) for each in (scene, evenly, unevenly)] == expected
    saved = replace(world.prepared.facts, exposure=(0.0,) * len(scene.paths))
    for facts in (saved, world.prepared.facts):
        assert exposure_of(world.config.tones, unevenly, image, facts) == facts.exposure


def test_the_start_is_a_function_of_the_seed(world: World) -> None:
    """And its parts draw independently."""
    first, second, other = (
        build_model(replace(world.config, seed=seed), world.prepared.facts).state_dict() for seed in (0, 0, 1)
    )
    torch.testing.assert_close(first, second, atol=0, rtol=0)
    moved = {name for name in first if not torch.equal(first[name], other[name])}
    assert moved == {name for name in first if not name.startswith("decoder.")} - {"field.offset"}, (
        "that one starts at 0"
    )
    tables = [value.flatten()[:8] for name, value in first.items() if name.endswith("planes.table")]
    assert len(tables) == 3
    assert not any(torch.equal(a, b) for i, a in enumerate(tables) for b in tables[:i])


def factor(width: int, height: int, views: int, minutes: float | None = None, device: str = "cpu") -> int:
    size = torch.tensor([[width, height]] * views)
    scene = SimpleNamespace(cameras=SimpleNamespace(size=size), train=torch.arange(views))
    planned = replace(fprf_lite(), minutes=minutes).planned(scene, torch.device(device))  # type: ignore[arg-type]
    assert isinstance(planned.downscale, int)
    return planned.downscale


def test_photographs_are_reduced_as_far_as_docs_say() -> None:
    assert (factor(2832, 2128, 9, 8), factor(2832, 2128, 9, 60)) == (5, 3)
    assert (factor(1920, 1080, 131, 8), factor(4032, 3024, 262, 8)) == (3, 8)
    assert factor(1008, 756, 29) == 2 and factor(1008, 756, 29, device="cuda") == 1


@given(
    side=st.integers(1, 9000),
    views=st.integers(1, 2000),
    minutes=st.floats(0.01, 1000),
    more=st.floats(1, 10),
    gpu=st.booleans(),
)
def test_more_time_and_fewer_images_never_reduce_further(
    side: int, views: int, minutes: float, more: float, gpu: bool
) -> None:
    device = "cuda" if gpu else "cpu"
    found = factor(side, side, views, minutes, device)
    assert factor(side, side, views, minutes * more, device) <= found
    assert factor(side, side, max(1, views // 2), minutes, device) <= found
    assert factor(max(1, side // 2), side, views, minutes, device) <= found
    least = (1e6 if gpu else 0.2e6) / 4
    assert found == 1 or side * side / found**2 > least / 2.25


def test_a_config_gets_the_size_of_its_scene(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    config = planned(replace(world.config, downscale=None))
    assert config == world.config and planned(config) is config
    half = read_scene(replace(config, downscale=2))
    assert half.cameras.size[0].tolist() == [16, 12]
    with pytest.raises(UsageError, match="--data FOLDER, or --data garden"):
        read_scene(replace(config, data=None))
    # A large capture takes long to parse: once is enough to find its size too.
    monkeypatch.setattr("fprf.training.prepare.parse_scene", once := Mock(return_value=world.prepared.scene))
    assert read_scene(replace(config, downscale=None)) is world.prepared.scene and once.call_count == 1


def test_what_training_came_to(world: World, tmp_path: Path) -> None:
    config = world.config
    scene = world.prepared.scene
    told = training_summary(Run(world.run), config, scene)
    assert told.startswith(
        f"warning: too few steps to judge the scene by: 15 steps, {15 * 256 / (8 * 32 * 24):.2g} rays"
    )
    assert f"fprf train {world.run}/config.json --steps 600" in told
    assert training_summary(Run(tmp_path), config, scene) == "no step was made"
    Run(tmp_path).log({"step": 4000, "seconds": 9.0, "psnr": 24.5})
    timed, reduced = (
        training_summary(Run(tmp_path), replace(fprf_lite(), **field), scene)
        for field in ({"minutes": 8.0}, {"downscale": 5})
    )
    assert "--minutes 16" in timed and "--downscale" not in timed
    assert "--steps 24000" in reduced and "--downscale 4" in reduced


@pytest.mark.parametrize("name", ["gpu", "", "cuda:99"])
def test_devices_that_are_not_there_are_refused(name: str) -> None:
    with pytest.raises(PluginError):
        device_of(name)
