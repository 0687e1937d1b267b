"""A town of twelve small pictures in three blocks of a few thousand numbers each, trained for six steps."""

import json
import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from tiny_world import tiny

from benchmarks.town.write import write_town
from fprf.blocks.config import GridConfig, LayoutConfig
from fprf.config import StatisticsConfig, TrainConfig
from fprf.io import tensorfiles
from fprf.training.blocks import folder_of
from fprf.training.driver import train

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
