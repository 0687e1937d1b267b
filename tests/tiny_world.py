"""A town of ten pictures of 32 x 24 pixels and a model of a few thousand numbers, trained for 15 steps: made
once a session.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from benchmarks.town.write import write_town
from fprf.config import StatisticsConfig, TrainConfig
from fprf.datamanagers.config import RayBatchesConfig
from fprf.fields.config import PlanesConfig, SemanticPlanesConfig
from fprf.interfaces import DataManager
from fprf.io.images import write_image
from fprf.methods import fprf_lite
from fprf.plugins.encoders.config import BundledSemanticConfig
from fprf.plugins.samplers.config import ProposalConfig
from fprf.progress import Report
from fprf.rendering.cameras import PixelRays
from fprf.training import checkpoint
from fprf.training.driver import learn, schedule_of
from fprf.training.driver import train as train_scene
from fprf.training.field_learner import FieldLearner
from fprf.training.field_scene import Trained, load_run
from fprf.training.field_setup import Prepared, prepare
from fprf.training.model import Model, build_model
from fprf.training.prepare import device_of, read_scene
from fprf.training.run import Run
from fprf.types import Batch, Rays

Change = Callable[[int, Batch], Batch]
"""Step and batch to the batch that is trained on."""


@dataclass(frozen=True)
class World:
    """What tests may read, and never write to."""

    folder: Path
    town: Path
    run: Path
    references: tuple[Path, Path]
    config: TrainConfig
    prepared: Prepared

    def load(self) -> Trained:
        return load_run(self.run, "cpu")


class Altered(DataManager):
    """A data manager with changed batches."""

    def __init__(self, inner: DataManager, change: Change) -> None:
        self.inner = inner
        self.change = change
        self.content_store = inner.content_store
        self.semantic_store = inner.semantic_store

    def batch(self, step: int) -> Batch:
        return self.change(step, self.inner.batch(step))

    def to(self, device: torch.device, *, room: int) -> DataManager:
        return Altered(self.inner.to(device, room=room), self.change)

    def image(self, view: int) -> torch.Tensor:
        return self.inner.image(view)


def spoilt(value: float, *steps: int) -> Change:
    """Colours of some steps are all this value."""
    return lambda step, batch: (
        batch._replace(rgb=torch.full_like(batch.rgb, value)) if step in steps else batch
    )


def stopping(at: int) -> Change:
    """An interrupt in a step."""

    def change(step: int, batch: Batch) -> Batch:
        if step == at:
            raise KeyboardInterrupt
        return batch

    return change


def tiny(data: Path, output: Path) -> TrainConfig:
    lite = fprf_lite()
    return replace(
        lite,
        data=data,
        output=output,
        downscale=1,
        steps=15,
        device="cpu",
        datamanager=RayBatchesConfig(rays=256, semantic_share=0.5),
        sampler=ProposalConfig(samples=(16,), final=8, resolutions=(8,), anneal_steps=10),
        content=replace(
            lite.content, field=PlanesConfig(resolutions=(8, 16), channels=8, hidden=32, layers=1)
        ),
        semantic=replace(
            lite.semantic,
            encoder=BundledSemanticConfig(),  # the quickest one that ships
            field=SemanticPlanesConfig(resolutions=(8,), channels=8, hidden=16, layers=1),
            dim=8,
        ),
        loss=replace(lite.loss, penalty_every=2),
        optimizer=replace(lite.optimizer, warm_up=5),
        statistics=StatisticsConfig(rays=2048, regions=4),
    )


def flags(world: World, output: Path) -> list[str]:
    """The same config on the command line, from the method `fprf-lite`."""
    words = """--steps 15 --device cpu --datamanager.rays 256
        --datamanager.semantic-share 0.5 --sampler.samples 16 --sampler.final 8 --sampler.resolutions 8
        --sampler.anneal-steps 10 --content.field.resolutions 8 16 --content.field.channels 8 --content.field.hidden 32
        --content.field.layers 1 --semantic.field.resolutions 8 --semantic.field.channels 8 --semantic.field.hidden 16
        --semantic.field.layers 1 --semantic.dim 8 --loss.penalty-every 2 --optimizer.warm-up 5 --statistics.rays 2048
        --statistics.regions 4 --semantic.encoder bundled-semantic"""
    return ["--data", str(world.town), "--output", str(output), *words.split()]


def make_world(folder: Path) -> World:
    town = folder / "town"
    write_town(town, seed=0, palette="day", views=10, width=32, height=24)
    drawn = np.random.default_rng(0)
    references = (folder / "dusk.png", folder / "snow.png")
    for path, base in zip(references, ((200, 90, 20), (170, 190, 230)), strict=True):
        noise = drawn.normal(0, 25, (40, 56, 1)) + np.linspace(-60, 40, 40)[:, None, None]
        write_image(path, (np.asarray(base) + noise).clip(0, 255).astype(np.uint8))
    config = tiny(town, folder / "run")
    train_scene(config, "fprf-lite", quiet=True)
    return World(folder, town, folder / "run", references, config, prepared_for(config))


def trained_for(
    world: World,
    folder: Path,
    config: TrainConfig,
    *,
    change: Change | None = None,
    report: Callable[[Report], None] = lambda event: None,
) -> Run:
    """Train in a folder without preparing anything anew."""
    prepared = world.prepared
    if change is not None:
        prepared = prepared._replace(manager=Altered(prepared.manager, change))
    folder.mkdir(exist_ok=True)
    run = Run(folder)
    taught(config, prepared, run, report)
    return run


def prepared_for(config: TrainConfig) -> Prepared:
    """Images and features of a config's scene."""
    return prepare(config, read_scene(config))


def taught(
    config: TrainConfig,
    prepared: Prepared,
    run: Run,
    report: Callable[[Report], None] = lambda event: None,
    model: Model | None = None,
) -> Model:
    """The model that a run ends with."""
    learner = FieldLearner(config, prepared, device_of(config.device), model)
    learn(learner, run, schedule_of(config, len(prepared.scene.train)), report)
    return learner.model


def save_checkpoint(
    root: Path, model: nn.Module, optimizer: torch.optim.Optimizer, *, step: int, seconds: float
) -> Path:
    return checkpoint.write(
        root, model.state_dict(), checkpoint.moments_of(optimizer), step=step, seconds=seconds
    )


def parameters(run: Run, step: int) -> dict[str, torch.Tensor]:
    """Everything a checkpoint holds, by name."""
    from fprf.training.checkpoint import load

    saved = load(run.checkpoints, step)
    named = {
        **{f"model.{k}": v for k, v in saved.model.items()},
        **{f"adam.{k}": v for k, v in saved.optimizer.items()},
    }
    return {
        name: tensor.clone() for name, tensor in named.items()
    }  # else they are maps of files that tests spoil


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def after_one_step(world: World) -> tuple[Model, torch.optim.Optimizer]:
    """A new model after a step of Adam on made-up gradients."""
    model = build_model(world.config, world.prepared.facts)
    optimizer = torch.optim.Adam(model.learned(), lr=1e-3, fused=True)
    for parameter in model.learned():
        parameter.grad = torch.randn_like(parameter)
    optimizer.step()
    return model, optimizer


def events(run: Run, key: str) -> list[dict[str, Any]]:
    """The logged events that have a key."""
    lines = (run.root / "events.jsonl").read_text().splitlines()
    return [event for event in map(json.loads, lines) if key in event]


def rays_of(world: World, trained: Trained, batch: Batch) -> Rays:
    return trained.model.space.rays(*PixelRays(world.prepared.scene.cameras)(batch.view, batch.pixel))
