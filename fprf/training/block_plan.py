"""Before the first step of a scene of blocks: cut it, extract all features, write down what every block will need.

Images are decoded one at a time and features are mapped from their files, so memory does not grow with the scene. One
semantic basis, one unit of each loss and one cache serve all blocks.
"""

import os
import shutil
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from ..blocks.partition import write_cells
from ..blocks.visibility import Plan, make_plan
from ..config import TrainConfig
from ..datamanagers.basis import Basis
from ..datamanagers.features import extract
from ..datamanagers.images import load_image
from ..datamanagers.scene import Scene
from . import tensorfiles
from .blocks import RAYS, SURROUNDINGS, asked_of, folder_of
from .model import Facts, build_decoder
from .prepare import behind, build_encoders, cache_folder, exposure_of, facts_of, scene_of
from .run import Run, task_of


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
    count = len(plan.cells)
    rays = {block: _rays_of(plan, block) for block in (SURROUNDINGS, *range(count))}
    if trained_tasks(run.root):
        asked = {block: asked_of(config, laid.facts, scene, plan.cells, block, own)["task"] for block, own in rays.items()}
        renumber(run.root, {block: task for block, task in asked.items() if block != SURROUNDINGS})
    for block, own in rays.items():
        folder = folder_of(run.root, block)
        folder.mkdir(parents=True, exist_ok=True)
        tensorfiles.save(folder / RAYS, own)
    write_cells(run.root / "blocks.json", plan.cells)


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
