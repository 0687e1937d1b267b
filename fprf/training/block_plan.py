"""Before the first step of a scene of blocks: cut it, extract all features, write down what every block will need.

Images are decoded one at a time and features are mapped from their files, so memory does not grow with the scene. One
semantic basis, one unit of each loss and one cache serve all blocks.
"""

import os
import shutil
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import torch
from torch import Tensor

from ..blocks.plan import Plan, boxes_to, make_plan
from ..config import TrainConfig
from ..datamanagers.basis import Basis
from ..datamanagers.batches import HELD
from ..datamanagers.features import extract
from ..datamanagers.images import load_image
from ..datamanagers.scene import Scene
from ..interfaces import DataManager
from ..io.atomic import write_json
from ..types import Batch
from . import tensorfiles
from .blocks import RAYS, SURROUNDINGS, Built, asked_of, folder_of, inset, surroundings
from .model import Facts, build_decoder
from .prepare import Prepared, behind, build_encoders, cache_folder, device_of, exposure_of, facts_of, scene_of
from .run import Run, task_of
from .trainer import Loop, optimizer_of


class Laid(NamedTuple):
    """A scene that is ready to be trained block by block."""

    scene: Scene
    plan: Plan
    facts: Facts
    basis: Basis | None


def plan_scene(config: TrainConfig, saved: Facts | None = None) -> tuple[Scene, Plan]:
    """The scene, about the origin of a run that goes on (`saved`), and how it is cut."""
    scene = scene_of(config, saved)
    return scene, make_plan(scene, config.blocks)


def lay_out(
    config: TrainConfig,
    scene: Scene,
    plan: Plan,
    progress: Callable[[int, int, str], None] | None = None,
    saved: Facts | None = None,
) -> Laid:
    """Extract the features of all training views. `progress(done, total, what)` is told of them.

    `saved` are the facts of a run that goes on: its exposures are not measured again.
    """
    content, semantic = build_encoders(config)
    build_decoder(config, encoder=content.identity, channels=content.channels)  # refused now, not after all the features
    background, cache, views = behind(config, scene), cache_folder() / "features", scene.train.tolist()

    def image(view: int) -> Tensor:
        width, height = scene.cameras.size[view].tolist()
        return torch.from_numpy(load_image(scene.paths[view], (width, height), background))

    guided = config.datamanager.guided
    content_store = extract(cache / "content", views, image, content, guided, progress=progress)
    semantic_store = None
    if semantic is not None:
        dim = config.semantic.dim
        semantic_store = extract(cache / "semantic", views, image, semantic, guided, dim=dim, progress=progress)
    exposure = exposure_of(config.tones, scene, lambda view: image(view).float() / 255, saved)
    facts = facts_of(config, scene, plan.space, exposure, content, semantic, content_store, semantic_store)
    return Laid(scene, plan, facts, semantic_store.basis if semantic_store is not None else None)


def write_down(run: Run, config: TrainConfig, method: str, laid: Laid) -> None:
    """Everything that the tasks read, and the cut, into the run folder."""
    plan, scene = laid.plan, laid.scene
    run.root.mkdir(parents=True, exist_ok=True)
    run.save_config(replace(config, output=None), method)
    run.save_known(scene, config.data, laid.facts)
    if laid.basis is not None:
        run.save_tensors("basis", laid.basis.tensors())
    count = len(plan.boxes.low)
    rays = {block: _rays_of(plan, block) for block in (SURROUNDINGS, *range(count))}
    if trained_tasks(run.root):
        asked = {block: asked_of(config, laid.facts, scene, plan.boxes, block, own)["task"] for block, own in rays.items()}
        renumber(run.root, {block: task for block, task in asked.items() if block != SURROUNDINGS})
    for block, own in rays.items():
        folder = folder_of(run.root, block)
        folder.mkdir(parents=True, exist_ok=True)
        tensorfiles.save(folder / RAYS, own)
    write_json(
        run.root / "blocks.json",
        {
            "format": 1,
            "boxes": boxes_to(plan.boxes),
            "rays": plan.rays.tolist(),
            "views": [len(plan.views_of(b)) for b in range(count)],
        },
    )


def _rays_of(plan: Plan, block: int) -> dict[str, Tensor]:
    """Training data of a block: `views` [M] and their tiles `seen` [M TILES TILES]; the surroundings from everything."""
    views = plan.views if block == SURROUNDINGS else plan.views_of(block)
    at = torch.isin(plan.views, views)
    seen = torch.ones_like(plan.seen[:, 0]) if block == SURROUNDINGS else plan.seen[:, block]
    return {"views": views, "seen": seen[at].to(torch.uint8)}


_MOVING = "moving-"


def trained_tasks(root: Path) -> dict[Path, str]:
    """Folders of blocks in a run, whatever their numbers, and what each was begun as."""
    tasks = {}
    for mark in sorted((root / "blocks").glob("*/task.json")):
        match task_of(mark.parent):
            case {"task": str(task)}:
                tasks[mark.parent] = task
    return tasks


def renumber(root: Path, asked: Mapping[int, str]) -> None:
    """Move each folder that was begun as what some block is asked for now to that block's number.

    A folder in the way that nobody asks for is removed. Where it is cut off, the next call finishes it.
    """
    known = trained_tasks(root)
    moves: dict[int, Path] = {}
    for block, task in asked.items():
        if known.get(folder_of(root, block)) == task:
            known.pop(folder_of(root, block))
    for block, task in asked.items():
        holder = next((folder for folder, was in known.items() if was == task), None)
        if holder is not None:
            known.pop(holder)
            moves[block] = holder
    # Twice, so that no folder stands in another's way.
    for block, holder in moves.items():
        os.rename(holder, _aside(root, asked[block]))
    for block in moves:
        target = folder_of(root, block)
        shutil.rmtree(target, ignore_errors=True)
        os.rename(_aside(root, asked[block]), target)
    for left in (root / "blocks").glob(f"{_MOVING}*"):
        shutil.rmtree(left)


def _aside(root: Path, task: str) -> Path:
    return root / "blocks" / f"{_MOVING}{task}"


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
    everything = int(area[scene.train].sum())
    span = plan.boxes.high.amax(0) - plan.boxes.low.amin(0)

    def row(name: str, views: Tensor, rays: int, span: Annotated[Tensor, "3"], members: int, step_seconds: float) -> Estimate:
        pixels = 3 * int(area[views].sum())
        images = pixels if pixels <= HELD else 0  # else they lie in a mapped file
        held = members * parameters * 4
        working = _WORKING * batch * 64
        along, across, up = (span / plan.space.scale).tolist()
        return Estimate(
            name,
            len(views),
            rays,
            (along, across, up),
            (held * _STATE + images + working) / _MIB,
            (parameters * 4 + 2 * 3 * held + pixels - images) / _MIB,
            config.steps * step_seconds,
        )

    step_seconds = seconds_per_step(config, facts, scene, around, batch)
    rows = [row("surroundings" if plan.cut else "whole", plan.views, everything, span, 1, step_seconds)]
    if plan.cut:
        step_seconds = seconds_per_step(config, facts, scene, block, batch)
        spans = plan.boxes.high - plan.boxes.low
        for z, rays in enumerate(plan.rays.tolist()):
            rows.append(row(f"{z:02d}", plan.views_of(z), rays, spans[z], 2, step_seconds))
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
        generator = torch.Generator().manual_seed(step)
        view = self.scene.train[torch.randint(len(self.scene.train), (self.rays,), generator=generator)]
        at = torch.rand(self.rays, 2, dtype=torch.float64, generator=generator) * self.scene.cameras.size[view]
        grey = torch.full((self.rays, 3), 0.5)
        content = torch.zeros(self.rays, self.facts.channels)
        semantic = torch.zeros(self.rays // 4, self.facts.dim) if self.facts.dim else None
        return Batch(view, at.floor() + 0.5, grey, content, semantic)

    def image(self, view: int) -> torch.Tensor:
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


def _feature_mib(scene: Scene, facts: Facts) -> float:
    """Coefficients of all training views: four half-precision numbers a channel for every 8 x 8 pixels."""
    pixels = int(scene.cameras.size[scene.train].prod(-1).sum())
    return pixels / 64 * 4 * 2 * (facts.channels + facts.dim) / _MIB


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
