"""A town of twelve small pictures in three blocks of a few thousand numbers each, trained for six steps."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from fprf.cli.train import train_scene
from fprf.config import StatisticsConfig, TrainConfig
from fprf.datamanagers.config import RayBatchesConfig
from fprf.fields.config import PlanesConfig, SemanticPlanesConfig
from fprf.fields.layouts import LayoutConfig, StreetConfig
from fprf.methods import fprf_lite
from fprf.plugins.samplers.config import ProposalConfig
from fprf.town.write import write_town
from fprf.training import tensorfiles

VIEWS, STEPS = 12, 6
BLOCKS = StreetConfig(segments=3)


@dataclass(frozen=True)
class BlockWorld:
    """Read it, never write to it."""

    folder: Path
    config: TrainConfig

    @property
    def root(self) -> Path:
        return self.folder / "run"


def town_in(folder: Path) -> Path:
    town = folder / "town"
    write_town(town, seed=0, palette="day", views=VIEWS, width=32, height=24)
    return town


def small(town: Path, output: Path, blocks: LayoutConfig = BLOCKS, steps: int = STEPS) -> TrainConfig:
    lite = fprf_lite()
    return replace(
        lite,
        data=town,
        output=output,
        downscale=1,
        steps=steps,
        device="cpu",
        blocks=blocks,
        datamanager=RayBatchesConfig(rays=128, semantic_share=0.5),
        sampler=ProposalConfig(samples=(12,), final=8, resolutions=(8,), anneal_steps=4),
        content=replace(lite.content, field=PlanesConfig(resolutions=(8,), channels=8, hidden=16, layers=1)),
        semantic=replace(lite.semantic, field=SemanticPlanesConfig(resolutions=(8,), channels=8, hidden=16, layers=1), dim=8),
        loss=replace(lite.loss, penalty_every=2),
        optimizer=replace(lite.optimizer, warm_up=2),
        statistics=StatisticsConfig(rays=512, regions=3),
    )


def made(folder: Path) -> TrainConfig:
    """Train it in `folder / "run"`."""
    config = small(town_in(folder), folder / "run")
    train_scene(config, "fprf-lite", quiet=True)
    return config


def tensors_of(root: Path, name: str) -> dict[str, torch.Tensor]:
    """The finished tensors of a block."""
    return {k: t.clone() for k, t in tensorfiles.read(root / "blocks" / name / "block.safetensors").items()}


def digests(root: Path, names: Sequence[str]) -> list[str]:
    """What each block was trained as."""
    return [done_of(root, name)["asked"]["task"] for name in names]


def done_of(root: Path, name: str) -> dict[str, Any]:
    document: dict[str, Any] = json.loads((root / "blocks" / name / "done.json").read_text())
    return document


def steps_of(root: Path, name: str) -> list[int]:
    """Steps that events.jsonl of a block speaks of."""
    return [json.loads(line)["step"] for line in (root / "blocks" / name / "events.jsonl").read_text().splitlines()]
