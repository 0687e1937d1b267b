"""Every leaf of the knob tree: a second value is another config, survives JSON and the command line, and changes something.

What it changes is named beside it; a field without an entry fails the test, so that no dead knob can be added.
"""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from pretend_cuda import CUDA, pretend_cuda
from tiny_world import World, prepared_for, trained_for

from fprf.cli.parsing import parse
from fprf.config import TrainConfig
from fprf.datamanagers.batches import RayBatches
from fprf.datamanagers.parsers.config import parse_scene
from fprf.io.images import write_image
from fprf.methods import fprf_lite
from fprf.plugins.codec import from_json, to_json
from fprf.plugins.encoders.config import BundledSemanticConfig
from fprf.plugins.slots import replace as replaced
from fprf.plugins.slots import slots
from fprf.plugins.typed_json import leaves
from fprf.training import checkpoint
from fprf.training.driver import schedule_of
from fprf.training.learner import FieldLearner
from fprf.training.model import build_model
from fprf.training.prepare import device_of
from fprf.training.style_pass import measure_style
from fprf.training.views import render_view

SECOND: dict[str, tuple[Any, str]] = {
    "data": (Path("other"), "scene"),
    "output": (Path("run"), "command"),
    "downscale": (2, "scene"),
    "steps": (7, "training"),
    "minutes": (0.25, "schedule"),
    "seed": (1, "model"),
    "device": ("tpu", "device"),
    "device_memory": (0.25, "accelerator"),
    "precision": ("tf32", "accelerator"),
    "checkpoint_minutes": (1e-9, "saving"),
    "datamanager.rays": (128, "training"),
    "datamanager.semantic_share": (0.75, "training"),
    "datamanager.depth_share": (0.5, "points"),
    "datamanager.masks": (False, "masks"),
    "datamanager.guided.radius": (0.3, "targets"),
    "datamanager.guided.eps": (0.1, "targets"),
    "datamanager.guided.stride": (2, "targets"),
    "sampler.samples": ((24,), "training"),
    "sampler.final": (6, "training"),
    "sampler.resolutions": ((16,), "model"),
    "sampler.channels": (16, "model"),
    "sampler.anneal_steps": (2, "training"),
    "sampler.anneal_slope": (2.0, "training"),
    "sampler.padding": (0.5, "training"),
    "sampler.update_every": (2, "training"),
    "sampler.warm_up": (1, "training"),
    "content.moves_density": (True, "training"),
    "content.field.resolutions": ((8,), "model"),
    "content.field.channels": (24, "model"),
    "content.field.hidden": (16, "model"),
    "content.field.layers": (2, "model"),
    "content.field.degree": (2, "model"),
    "content.encoder.weights": (Path("w.safetensors"), "file"),
    "content.decoder.weights": (Path("w.safetensors"), "file"),
    "content.decoder.objective": ("paper", "model"),
    "semantic.encoder.weights": (Path("w.safetensors"), "file"),
    "semantic.field.resolutions": ((8, 16), "model"),
    "semantic.field.channels": (24, "model"),
    "semantic.field.hidden": (32, "model"),
    "semantic.field.layers": (2, "model"),
    "semantic.dim": (4, "targets"),
    "semantic.samples": (4, "training"),
    "loss.rgb": (0.5, "training"),
    "loss.content": (0.5, "training"),
    "loss.semantic": (0.0, "training"),
    "loss.variation": (0.5, "training"),
    "loss.proposal_variation": (0.5, "training"),
    "loss.penalties": ((("opacity", 0.5), ("other", 2.0)), "penalties"),
    "loss.penalty_every": (3, "training"),
    "loss.interlevel": (0.25, "training"),
    "loss.distortion": (0.5, "training"),
    "loss.depth": (0.9, "points"),
    "loss.sky": (0.9, "masks"),
    "optimizer.rate": (1e-3, "training"),
    "optimizer.hold": (2, "training"),
    "optimizer.final": (0.5, "training"),
    "optimizer.warm_up": (1, "training"),
    "optimizer.beta2": (0.9, "training"),
    "optimizer.eps": (1e-3, "training"),
    "render.budget": (0.4, "render"),
    "render.train_budget": (0.4, "training"),
    "render.resolution": (0.5, "render"),
    "render.chunk": (100, "chunks"),
    "render.background": ((1.0, 0.0, 1.0), "background"),
    "render.tone": ((0.5, 1.0, 0.8), "render"),
    "tones": (True, "facts"),
    "poses": (0.05, "facts"),
    "statistics.rays": (64, "style"),
    "statistics.regions": (1, "style"),
}
"""A second value of every field of `fprf-lite`, valid for the tiny config too, and where it shows."""


def differ(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return a.keys() != b.keys() or any(a[name].shape != b[name].shape or not torch.equal(a[name], b[name]) for name in a)


def spelled(value: Any) -> list[str]:
    return [word for each in value for word in spelled(each)] if isinstance(value, tuple) else [str(value)]


def shown(where: str) -> list[str]:
    return [path for path, (_, place) in SECOND.items() if place == where]


LITE = replaced(fprf_lite(), "semantic.encoder", BundledSemanticConfig())


def test_every_leaf_has_a_second_value() -> None:
    places = {slot.path for slot in slots(LITE)}
    assert set(leaves(LITE)) - places == set(SECOND)


def test_all_second_values_survive_the_command_line_and_json() -> None:
    wanted, args = LITE, []
    for path, (value, _) in SECOND.items():
        assert replaced(wanted, path, value) != wanted, path
        wanted = replaced(wanted, path, value)
        args += [f"--{path.replace('_', '-')}", *spelled(value)]
    assert parse(LITE, args, prog="x", description="") == wanted
    assert from_json(json.loads(json.dumps(to_json(wanted))), TrainConfig) == wanted


@pytest.mark.parametrize("path", shown("model"))
def test_it_changes_the_model(path: str, world: World) -> None:
    def start(config: TrainConfig) -> dict[str, torch.Tensor]:
        return build_model(config, world.prepared.facts).state_dict()

    assert differ(start(world.config), start(replaced(world.config, path, SECOND[path][0])))


@pytest.fixture(scope="module")
def _trained() -> dict[int, dict[str, torch.Tensor]]:
    return {}


@pytest.mark.parametrize("path", shown("training"))
def test_it_changes_the_training(path: str, world: World, tmp_path: Path, _trained: dict[int, dict[str, torch.Tensor]]) -> None:
    """Parameters after a few steps differ."""

    def after(config: TrainConfig, folder: Path) -> dict[str, torch.Tensor]:
        run = trained_for(world, folder, config)
        return checkpoint.load(run.checkpoints, config.steps).model

    base = replace(world.config, steps=5)
    soon = 1 if path == "sampler.update_every" else 5000
    base = replaced(base, "sampler.warm_up", soon)  # until then the proposals learn at every step
    if soon not in _trained:
        _trained[soon] = after(base, tmp_path / "base")
    config = replaced(base, path, SECOND[path][0])
    if path.startswith("datamanager."):
        made = config.datamanager
        assert isinstance(made, type(world.config.datamanager)) and isinstance(world.prepared.manager, RayBatches)
        world = replace(world, prepared=prepared_for(config))
    assert differ(_trained[soon], after(config, tmp_path / "other"))


@pytest.mark.parametrize("path", shown("targets"))
def test_it_changes_the_targets(path: str, world: World) -> None:
    def of(config: TrainConfig) -> dict[str, torch.Tensor]:
        batch = prepared_for(config).manager.batch(0)
        assert batch.content is not None and batch.semantic is not None
        return {"content": batch.content, "semantic": batch.semantic}

    # On so small a picture the window would otherwise be narrower than a stride.
    base = replaced(world.config, "datamanager.guided.radius", 0.9 if path.endswith("stride") else 0.08)
    assert differ(of(base), of(replaced(base, path, SECOND[path][0])))


@pytest.mark.parametrize("path", shown("style"))
def test_it_changes_the_style(path: str, world: World) -> None:
    trained, scene = world.load(), world.prepared.scene
    first, second = (
        measure_style(config, trained.model, scene.cameras, scene.train)._asdict()
        for config in (world.config, replaced(world.config, path, SECOND[path][0]))
    )
    assert differ(first, second)


@pytest.mark.parametrize("path", shown("file"))
def test_it_names_a_file(path: str, world: World) -> None:
    """What does not exist is missed, so it is looked for."""
    config = replaced(world.config, path, SECOND[path][0])
    builds: dict[str, Callable[[], object]] = {
        "content.encoder.weights": lambda: config.content.encoder.build(),
        "content.decoder.weights": lambda: build_model(config, world.prepared.facts),
        "semantic.encoder.weights": lambda: config.semantic.encoder.build() if config.semantic.encoder else None,
    }
    with pytest.raises(Exception, match=r"w\.safetensors"):
        builds[path]()


def test_it_changes_what_an_accelerator_does(world: World) -> None:
    """Where images lie, and how matrices are multiplied."""
    assert shown("accelerator") == ["device_memory", "precision"]
    manager = world.prepared.manager
    assert isinstance(manager, RayBatches)
    size = manager.held_bytes
    with pretend_cuda(memory=3 * size):
        for config, there in ((world.config, True), (replaced(world.config, "device_memory", 0.25), False)):
            prepared = prepared_for(config)
            loop = FieldLearner(config, prepared, CUDA, build_model(config, prepared.facts))
            assert (loop.manager.batch(0).rgb.device == CUDA) == there
        products = []
        loop.model.learned()[0].register_hook(lambda gradient: products.append(torch.get_float32_matmul_precision()))
        loop.step(0, 0.0)
        lower = FieldLearner(replaced(config, "precision", "tf32"), prepared, CUDA, loop.model)
        lower.step(0, 0.0)
        assert products == ["highest", "high"] and torch.get_float32_matmul_precision() == "highest"


def test_tones_and_poses_are_facts_of_the_scene(world: World) -> None:
    assert shown("facts") == ["tones", "poses"]
    first, second, third = (
        prepared_for(config).facts
        for config in (world.config, *(replaced(world.config, path, SECOND[path][0]) for path in shown("facts")))
    )
    assert first.exposure == () and len(second.exposure) == 10 and len(second.held) == 2
    assert first.centres == second.centres == () and len(third.centres) == 10 and len(third.held) == 2 and third.reach > 0


@pytest.mark.parametrize("where", ["points", "masks"])
def test_it_counts_where_the_capture_has_them(where: str, world: World, tmp_path: Path) -> None:
    """Rays through points and the loss on those; masks of what is used and of the sky."""
    scene, base, found = replace(world.prepared.scene, seen=None), replace(world.config, steps=5), []
    if where == "masks":
        width, height = scene.cameras.size[0].tolist()
        half = np.zeros((height, width, 3), np.uint8)
        half[: height // 2] = 255
        write_image(tmp_path / "half.png", half)
        paths = (tmp_path / "half.png",) * len(scene.paths)
        scene = replace(scene, masks=paths, sky_masks=paths)
    for name in ("", *shown(where)):
        config = replaced(base, name, SECOND[name][0]) if name else base
        manager = config.datamanager.build(
            scene=scene, content=None, semantic=None, dim=8, cache=tmp_path / "cache", seed=config.seed
        )
        there = replace(world, prepared=world.prepared._replace(scene=scene, manager=manager))
        found.append(checkpoint.load(trained_for(there, tmp_path / f"run{name}", config).checkpoints, 5).model)
    assert len(found) == 3 and all(differ(found[0], other) for other in found[1:])


def test_the_rest(world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []

    def second(path: str) -> TrainConfig:
        seen.append(path)
        return replaced(world.config, path, SECOND[path][0])

    with pytest.raises(Exception, match="other: no such folder"):
        parse_scene(second("data").data, 1, None)
    assert second("output").output != world.config.output
    half = parse_scene(world.town, second("downscale").downscale, None)
    assert half.cameras.size.tolist()[0] == [16, 12]
    assert schedule_of(second("minutes"), 8).share(0, 15.0) == 1 > schedule_of(world.config, 8).share(0, 15.0)
    with pytest.raises(Exception, match="tpu"):
        device_of(second("device").device)
    run = trained_for(world, tmp_path / "a", replace(second("checkpoint_minutes"), steps=3))
    assert checkpoint.steps(run.checkpoints) == [2, 3]
    trained = world.load()
    known, plain = trained.known, world.config.render

    def view(config: TrainConfig) -> torch.Tensor:
        return render_view(trained.model, known.facts, known.cameras, 0, config.render).rgb

    assert not torch.equal(view(world.config), view(second("render.budget")))
    assert not torch.equal(view(world.config), view(second("render.resolution")))
    assert torch.allclose(view(second("render.tone")), view(world.config) * torch.tensor([0.5, 1.0, 0.8]))
    calls: list[int] = []
    whole = trained.model.field.density
    monkeypatch.setattr(trained.model.field, "density", lambda points: calls.append(len(points)) or whole(points))
    view(world.config)
    assert (len(calls), plain.chunk) == (1, 8192)
    view(second("render.chunk"))
    assert len(calls) == 1 + 8, "768 rays a hundred at a time"
    assert prepared_for(second("render.background")).facts.background == (1.0, 0.0, 1.0)
    places = ("scene", "command", "schedule", "device", "saving", "render", "chunks", "background")
    assert set(seen) == {path for place in places for path in shown(place)}
