"""Before the first step of a scene of blocks: cut it, extract all features, write down what every block will need.

Images are decoded one at a time and features are mapped from their files, so memory does not grow with the scene. One
semantic basis, one unit of each loss and one cache serve all blocks.
"""

import hashlib
import json
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..blocks.plan import Plan, boxes_from, boxes_to, make_plan
from ..blocks.routing import chart_of, surroundings_of
from ..config import RESUMABLE, TrainConfig
from ..datamanagers.basis import Basis
from ..datamanagers.features import extract
from ..datamanagers.images import load_image
from ..datamanagers.scene import Scene
from ..errors import CheckpointError
from ..io.atomic import write_json
from ..plugins.codec import to_json
from ..types import Boxes
from . import tensorfiles
from .blocks import SURROUNDINGS, folder_of
from .decoder import build_decoder
from .model import Facts
from .prepare import behind, build_encoders, cache_folder, exposure_of, facts_of, scene_of
from .renumber import renumber, trained_tasks
from .run import Run

__all__ = ["FREE", "RAYS", "Laid", "asked_of", "lay_out", "load_boxes", "plan_scene", "write_down"]

FREE = (*RESUMABLE, "blocks", "executor", "statistics", "render")
"""Fields of a config that do not decide what a block of given bounds and rays learns."""


RAYS = "rays.safetensors"
"""In a block's folder: the views and tiles that it learns from."""


class Laid(NamedTuple):
    """A scene that is ready to be trained block by block."""

    scene: Scene
    plan: Plan
    facts: Facts
    basis: Basis | None


def plan_scene(config: TrainConfig) -> tuple[Scene, Plan]:
    """The scene and how it is cut."""
    scene = scene_of(config)
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
    exposure = exposure_of(config, scene, lambda view: image(view).float() / 255, saved)
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
    """What a block learns from: `views` [M] and their tiles `seen` [M TILES TILES]; the surroundings from everything."""
    views = plan.views if block == SURROUNDINGS else plan.views_of(block)
    at = torch.isin(plan.views, views)
    seen = torch.ones_like(plan.seen[:, 0]) if block == SURROUNDINGS else plan.seen[:, block]
    return {"views": views, "seen": seen[at].to(torch.uint8)}


def load_boxes(root: Path) -> Boxes:
    """How a run is cut. Raises CheckpointError."""
    path = root / "blocks.json"
    try:
        document: dict[str, Any] = json.loads(path.read_text())
        if document["format"] != 1:
            raise ValueError(f"format {document['format']!r}, this fprf reads 1")
        return boxes_from(document["boxes"])
    except (OSError, ValueError, KeyError, TypeError) as e:
        raise CheckpointError(f"{path}: cannot be read ({e}); train the scene again") from e


def asked_of(
    config: TrainConfig, facts: Facts, scene: Scene, boxes: Boxes, block: int, rays: dict[str, Tensor]
) -> dict[str, Any]:
    """What a block is trained as; while it stays the same, what was trained stays good. `rays` is its rays.safetensors.

    A block is decided by its bounds and rays, its images, and the config but for what may change, not by its surroundings:
    they are only its frame.
    """
    tree = to_json(config)
    assert isinstance(tree, dict)
    knobs = {name: value for name, value in tree.items() if name not in FREE}
    views = rays["views"].tolist()
    # What the surroundings span follows from all blocks together, not from how they are cut.
    chart = surroundings_of(boxes) if block == SURROUNDINGS else chart_of(boxes, block)
    parts = {
        "config": knobs,
        "bounds": [t.tolist() for t in (chart.low, chart.high, chart.turn)],
        "space": [facts.space.centre, facts.space.rotation, facts.space.scale, facts.space.near, facts.space.far],
        "views": views,
        "cameras": [scene.cameras.pose[views].tolist(), scene.cameras.focal[views].tolist()],
        "facts": [facts.channels, facts.dim, facts.content_encoder, facts.semantic_encoder, facts.background, facts.exposure],
    }
    digest = hashlib.sha256(json.dumps(parts, sort_keys=True, default=str).encode() + rays["seen"].numpy().tobytes())
    for view in views:
        digest.update(zlib.crc32(scene.paths[view].read_bytes()).to_bytes(4, "little"))
    return {"task": digest.hexdigest()[:32], "steps": config.steps, "minutes": config.minutes}
