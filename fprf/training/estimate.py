"""What a plan will cost: memory, disk and time of every block, before anything runs.

Bytes are counted on the model that the config builds. Time comes from a few steps on made-up targets, on this machine: speed
depends on it more than on anything that could be counted.
"""

import time
from dataclasses import dataclass, replace
from typing import Any

import torch

from ..blocks.plan import Plan
from ..config import TrainConfig
from ..datamanagers.batches import HELD
from ..datamanagers.scene import Scene
from ..interfaces import DataManager
from ..types import Batch
from .blocks import Built, inset, surroundings
from .model import Facts
from .prepare import Prepared, device_of
from .trainer import Loop, optimizer_of

__all__ = ["Estimate", "estimates", "seconds_per_step"]

_MIB = 1 << 20
_STATE = 4
"""Numbers that training keeps of a parameter: value, gradient, two moments."""
_WORKING = 600
"""Bytes of intermediate results per sample of a batch; measured, within a factor of two."""
_STEPS = 3
"""Steps that are timed, after one that is not."""


@dataclass(frozen=True)
class Estimate:
    """One line of the plan."""

    name: str
    views: int
    rays: int
    extent: tuple[float, float, float]
    """Size in world units, margins left out."""
    memory_mib: float
    disk_mib: float
    seconds: float

    def cells(self) -> tuple[str, ...]:
        """For a table."""
        size = " x ".join(f"{side:.3g}" for side in self.extent)
        return (
            self.name,
            f"{self.views:,}",
            f"{self.rays:,}",
            size,
            f"{self.memory_mib:,.0f} MiB",
            f"{self.disk_mib:,.0f} MiB",
            _clock(self.seconds),
        )

    def json(self) -> dict[str, Any]:
        """For plan.json."""
        return {
            "name": self.name,
            "images": self.views,
            "rays": self.rays,
            "extent": list(self.extent),
            "memory_mib": round(self.memory_mib, 1),
            "disk_mib": round(self.disk_mib, 1),
            "seconds": round(self.seconds, 1),
        }


def estimates(config: TrainConfig, scene: Scene, plan: Plan) -> list[Estimate]:
    """A line for the surroundings and each block, and their sum; one block alone has no surroundings."""
    content = config.content.encoder.build()
    semantic = config.semantic.encoder.build() if config.semantic.encoder is not None else None
    dim = min(config.semantic.dim, semantic.channels) if semantic is not None else 0
    facts = Facts(
        space=plan.space,
        channels=content.channels,
        dim=dim,
        content_encoder=content.identity,
        semantic_encoder=semantic.identity if semantic is not None else "",
        content_scale=1.0,
        semantic_scale=1.0,
        background=None,
    )
    around = surroundings(config, facts, plan.boxes)
    block = inset(config, facts, plan.boxes, 0, around) if plan.cut else around
    parameters = sum(p.numel() for p in around.member.parameters())
    batch = config.datamanager.batch_rays()
    area = scene.cameras.size.prod(-1)
    rows = []
    everything = int(area[scene.train].sum())
    numbers = plan.rays.tolist()
    speed = {
        id(built): seconds_per_step(config, facts, scene, built, batch)
        for built in {id(b): b for b in (around, block)}.values()
    }

    def row(name: str, views: torch.Tensor, rays: int, extent: tuple[float, float, float], members: int, built: Built) -> None:
        pixels = 3 * int(area[views].sum())
        images = pixels if pixels <= HELD else 0  # else they lie in a mapped file
        held = members * parameters * 4
        working = _WORKING * batch * 64
        seconds = config.steps * speed[id(built)]
        rows.append(
            Estimate(
                name,
                len(views),
                rays,
                extent,
                (held * _STATE + images + working) / _MIB,
                (parameters * 4 + 2 * 3 * held + pixels - images) / _MIB,
                seconds,
            )
        )

    if plan.cut:
        span = plan.boxes.high.amax(0) - plan.boxes.low.amin(0)
        row("surroundings", plan.views, everything, _metric(span, plan), 1, around)
    for z, rays in enumerate(numbers):
        extent = _metric(plan.boxes.high[z] - plan.boxes.low[z], plan)
        row(
            f"{z:02d}" if plan.cut else "whole",
            plan.views_of(z) if plan.cut else plan.views,
            rays if plan.cut else everything,
            extent,
            1 + plan.cut,
            block,
        )
    if config.minutes is not None:
        limit = 60 * config.minutes / sum(r.seconds for r in rows)
        rows = [replace(r, seconds=r.seconds * min(1.0, limit)) for r in rows]
    if plan.cut:
        features = _feature_mib(scene, facts)
        rows.append(
            Estimate(
                "together",
                len(plan.views),
                sum(r.rays for r in rows),
                rows[0].extent,
                max(r.memory_mib for r in rows),
                sum(r.disk_mib for r in rows) + features,
                sum(r.seconds for r in rows),
            )
        )
    return rows


class _MadeUp(DataManager):
    """Batches of random pixels with grey targets: they cost what real ones do."""

    def __init__(self, scene: Scene, facts: Facts, rays: int) -> None:
        self.content_store = self.semantic_store = None
        self.scene, self.facts, self.rays = scene, facts, rays

    def batch(self, step: int) -> Batch:
        """Any pixels."""
        generator = torch.Generator().manual_seed(step)
        view = self.scene.train[torch.randint(len(self.scene.train), (self.rays,), generator=generator)]
        at = torch.rand(self.rays, 2, dtype=torch.float64, generator=generator) * self.scene.cameras.size[view]
        grey = torch.full((self.rays, 3), 0.5)
        content = torch.zeros(self.rays, self.facts.channels)
        semantic = torch.zeros(self.rays // 4, self.facts.dim) if self.facts.dim else None
        return Batch(view, at.floor() + 0.5, grey, content, semantic)

    def image(self, view: int) -> torch.Tensor:
        """Grey."""
        width, height = self.scene.cameras.size[view].tolist()
        return torch.full((height, width, 3), 0.5)


def seconds_per_step(config: TrainConfig, facts: Facts, scene: Scene, built: Built, rays: int) -> float:
    """Time of a training step of a model here and now."""
    device = device_of(config.device)
    model = built.model.to(device)
    prepared = Prepared(scene, _MadeUp(scene, facts, rays), facts, None)
    loop = Loop(config, prepared, model, optimizer_of(config, model), device)
    loop.step(0, 0.0)(0.0, 0.0)
    start = time.perf_counter()
    for step in range(1, 1 + _STEPS):
        result = loop.step(step, 0.0)
    result(0.0, 0.0)  # waits for the device
    return (time.perf_counter() - start) / _STEPS


def _metric(span: torch.Tensor, plan: Plan) -> tuple[float, float, float]:
    a, b, c = (float(v) / plan.space.scale for v in span)
    return a, b, c


def _feature_mib(scene: Scene, facts: Facts) -> float:
    """Coefficients of all training views: four half-precision numbers a channel for every 8 x 8 pixels."""
    pixels = int(scene.cameras.size[scene.train].prod(-1).sum())
    return pixels / 64 * 4 * 2 * (facts.channels + facts.dim) / _MIB


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
