"""Every field that shapes what is learnt: a second value survives JSON and the command line, and changes
something.

What it changes is named beside it; a field without an entry fails the test, so that no dead knob can be
added.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tiny_world import World, prepared_for, trained_for

from fprf.config import TrainConfig
from fprf.datamanagers.batches import RayBatches
from fprf.datamanagers.config import FeatureTargets, TrainingPixels
from fprf.io.images import write_image
from fprf.methods import fprf_lite
from fprf.plugins.codec import leaves
from fprf.plugins.encoders.config import BundledSemanticConfig
from fprf.plugins.slots import replace as replaced
from fprf.plugins.slots import slots
from fprf.training import checkpoint
from fprf.training.model import build_model
from fprf.training.style_pass import measure_style

SECOND: dict[str, tuple[Any, str]] = {
    "steps": (7, "training"),
    "seed": (1, "model"),
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
    "content.decoder.objective": ("paper", "model"),
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
    "render.train_budget": (0.4, "training"),
    "statistics.rays": (64, "style"),
    "statistics.regions": (1, "style"),
}
"""A second value of every field of `fprf-lite` that shapes what is learnt, valid for the tiny config too;
where it shows.
"""


def differ(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return a.keys() != b.keys() or any(
        a[name].shape != b[name].shape or not torch.equal(a[name], b[name]) for name in a
    )


def spelled(value: Any) -> list[str]:
    return [word for each in value for word in spelled(each)] if isinstance(value, tuple) else [str(value)]


def shown(where: str) -> list[str]:
    return [path for path, (_, place) in SECOND.items() if place == where]


LITE = replaced(fprf_lite(), "semantic.encoder", BundledSemanticConfig())


def test_every_leaf_has_a_second_value() -> None:
    parts = ("datamanager.", "sampler.", "content.", "semantic.", "loss.", "optimizer.", "statistics.")
    fields = {path for path in leaves(LITE) if path.startswith(parts) and not path.endswith(".weights")}
    assert fields - {slot.path for slot in slots(LITE)} <= SECOND.keys()


@pytest.mark.parametrize("path", shown("model"))
def test_it_changes_the_model(path: str, world: World) -> None:
    def start(config: TrainConfig) -> dict[str, torch.Tensor]:
        return build_model(config, world.prepared.facts).state_dict()

    assert differ(start(world.config), start(replaced(world.config, path, SECOND[path][0])))


@pytest.fixture(scope="module")
def _trained() -> dict[int, dict[str, torch.Tensor]]:
    return {}


@pytest.mark.parametrize("path", shown("training"))
def test_it_changes_the_training(
    path: str, world: World, tmp_path: Path, _trained: dict[int, dict[str, torch.Tensor]]
) -> None:
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
        assert isinstance(made, type(world.config.datamanager)) and isinstance(
            world.prepared.manager, RayBatches
        )
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
    trained = world.load()
    scene = world.prepared.scene
    first, second = (
        measure_style(config, trained.model, scene.cameras, scene.train)._asdict()
        for config in (world.config, replaced(world.config, path, SECOND[path][0]))
    )
    assert differ(first, second)


@pytest.mark.parametrize("where", ["points", "masks"])
def test_it_counts_where_the_capture_has_them(where: str, world: World, tmp_path: Path) -> None:
    """Rays through points and the loss on those; masks of what is used and of the sky."""
    scene = replace(world.prepared.scene, seen=None)
    base = replace(world.config, steps=5)
    found = []
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
            TrainingPixels(scene=scene), FeatureTargets(), cache=tmp_path / "cache", seed=config.seed
        )
        there = replace(world, prepared=world.prepared._replace(scene=scene, manager=manager))
        found.append(
            checkpoint.load(trained_for(there, tmp_path / f"run{name}", config).checkpoints, 5).model
        )
    assert len(found) == 3 and all(differ(found[0], other) for other in found[1:])
