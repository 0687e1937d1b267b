"""Scenes in parts: a town in three blocks, trained for six steps, and in two cells; their parts as tasks."""

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from tiny_world import tiny

from benchmarks.town.write import write_town
from fprf.blocks.config import BisectConfig, GridConfig, LayoutConfig
from fprf.config import StatisticsConfig, TrainConfig
from fprf.io import tensorfiles
from fprf.run_config import RunConfig
from fprf.splats import cells
from fprf.splats.config import GaussiansConfig
from fprf.training import blocks, checkpoint
from fprf.training.blocks import folder_of
from fprf.training.driver import train
from fprf.training.tasks import Part, Task, train_part

STEPS = 6
BLOCKS = GridConfig(cells=(3, 1))


@dataclass(frozen=True)
class BlockWorld:
    """Read it, never write to it."""

    folder: Path
    config: TrainConfig

    @property
    def root(self) -> Path:
        return self.folder / "run"


def small(town: Path, output: Path, blocks: LayoutConfig = BLOCKS, steps: int = STEPS) -> TrainConfig:
    config = tiny(town, output)
    return replace(
        config,
        blocks=blocks,
        steps=steps,
        datamanager=replace(config.datamanager, rays=128),
        sampler=replace(config.sampler, samples=(12,), anneal_steps=4),
        content=replace(config.content, field=replace(config.content.field, resolutions=(8,), hidden=16)),
        optimizer=replace(config.optimizer, warm_up=2),
        statistics=StatisticsConfig(rays=512, regions=3),
    )


def made(folder: Path) -> TrainConfig:
    """Train it in `folder / "run"`."""
    town = folder / "town"
    write_town(town, seed=0, palette="day", views=12, width=32, height=24)
    config = small(town, folder / "run")
    train(config, "fprf-lite", quiet=True)
    return config


def tensors_of(root: Path, name: str) -> dict[str, torch.Tensor]:
    """The finished tensors of a block."""
    return {k: t.clone() for k, t in tensorfiles.read(root / "blocks" / name / "block.safetensors").items()}


def done_of(root: Path, name: str) -> dict[str, Any]:
    document: dict[str, Any] = json.loads((root / "blocks" / name / "done.json").read_text())
    return document


def unfinish(root: Path, block: int) -> Path:
    """The folder of a block, as it was before its first step."""
    folder = folder_of(root, block)
    shutil.rmtree(folder / "checkpoints")
    (folder / "done.json").unlink()
    return folder


REPORT = Callable[[Any], None]


@dataclass(frozen=True)
class TaskWorld:
    """Read it, never write to it."""

    config: RunConfig
    method: str
    root: Path
    parts: int
    """How many there are beside the whole scene."""
    folder_of: Callable[[Path, int], Path]
    open: Callable[[Task], Part]

    @property
    def data(self) -> Path:
        assert self.config.data is not None
        return self.config.data

    def copy(self, folder: Path) -> Path:
        shutil.copytree(self.root, folder / "run")
        return folder / "run"

    def unfinish(self, root: Path, part: int) -> Path:
        """The folder of a part as it was before its first step."""
        folder = self.folder_of(root, part)
        shutil.rmtree(folder / "checkpoints")
        (folder / "done.json").unlink()
        return folder

    def train(
        self,
        root: Path,
        part: int,
        report: REPORT = lambda event: None,
        data: Path | None = None,
        **change: Any,
    ) -> bool:
        """Train a part as a worker does; False where it is finished already."""
        words = {
            "root": str(root),
            "data": str(data or self.data),
            "part": part,
            "minutes": None,
            "quiet": True,
        }
        return train_part(self.open(Task(**words | change)), report)

    def tensors(self, root: Path, part: int) -> dict[str, torch.Tensor]:
        """All that the newest checkpoint of a part holds."""
        saved, _ = checkpoint.load_latest(self.folder_of(root, part) / "checkpoints")
        assert saved is not None
        return {
            k: t.clone()
            for k, t in (*saved.model.items(), *((f"optimizer.{k}", t) for k, t in saved.optimizer.items()))
        }

    def done(self, root: Path, part: int) -> dict[str, Any]:
        document: dict[str, Any] = json.loads((self.folder_of(root, part) / "done.json").read_text())
        return document


def world_of_blocks(config: RunConfig, root: Path) -> TaskWorld:
    return TaskWorld(config, "fprf-lite", root, 3, blocks.folder_of, blocks.open_block)


def small_cells(data: Path, output: Path, **change: Any) -> GaussiansConfig:
    """Two cells of a few hundred Gaussians."""
    words = {
        "downscale": 1,
        "steps": 150,
        "cells": BisectConfig(),
        "initial": 300,
        "cap": 600,
        "output": output,
    }
    return GaussiansConfig(data=data, **words | change)


def world_of_cells(config: RunConfig, root: Path) -> TaskWorld:
    return TaskWorld(config, "fprf-splats", root, 2, cells.folder_of, cells.open_cell)
