"""`fprf train` on a scene of several blocks: train each one as a task, measure the style of the whole."""

import time
from pathlib import Path
from typing import TYPE_CHECKING

from .progress import Display, EventLog

if TYPE_CHECKING:
    from ..blocks.visibility import Plan
    from ..config import TrainConfig
    from ..datamanagers.scene import Scene
    from ..training.blocks import BlockTask
    from ..training.run import Run
    from ..training.trainer import Report

SHARE = 0.2
"""Share of a time limit that the surroundings take, which all blocks start from; the blocks share the rest."""


def train_blocks(
    config: "TrainConfig",
    method: str,
    folder: "Run",
    scene: "Scene",
    plan: "Plan",
    display: Display,
    start: float,
) -> None:
    """Features of all views, the surroundings, the blocks, largest first, and the style of the whole. Finished ones stay."""
    from ..style.scene import to_tensors
    from ..training.block_plan import lay_out, write_down
    from ..training.blocks import SURROUNDINGS, BlockTask
    from ..training.loading import load_run
    from ..training.prepare import device_of
    from ..training.style_pass import measure_style

    laid = lay_out(config, scene, plan, display.count, folder.saved_facts())
    write_down(folder, config, method, laid)
    count = len(plan.cells)
    display.say(f"{scene.name}: {len(scene.train)} + {len(scene.test)} views, {count} blocks and their surroundings")
    executor = config.executor.on(device_of(config.device).type).build()
    around, each = block_minutes(config, count, time.perf_counter() - start)
    scene_folder = config.data or Path()
    root, data = str(folder.root.resolve()), str(scene_folder.resolve() if scene_folder.exists() else scene_folder)

    def task(block: int, minutes: float | None) -> BlockTask:
        return BlockTask(root=root, data=data, block=block, minutes=minutes, quiet=display.quiet)

    rays = plan.rays
    tasks = [task(block, each) for block in rays.argsort(descending=True).tolist()]
    executor.map(run_block, [task(SURROUNDINGS, around)])
    executor.map(run_block, tasks)
    display.say("measuring the scene's own style")
    trained = load_run(folder.root, config.device)
    folder.save_tensors("style", to_tensors(measure_style(config, trained.model, scene.cameras, scene.train)))


def block_minutes(config: "TrainConfig", blocks: int, spent: float) -> tuple[float | None, float | None]:
    """Minutes for the surroundings, and for each block, one after the other; `spent` seconds of the limit are gone."""
    if config.minutes is None:
        return None, None
    left = max(config.minutes - spent / 60, 0.05 * config.minutes)
    return SHARE * left, (1 - SHARE) * left / blocks


def run_block(task: "BlockTask") -> None:
    """Train one block, here or on a worker, and show how it goes."""
    from ..training.blocks import SURROUNDINGS, folder_of, train_block
    from ..training.run import Run

    name = "surroundings" if task.block == SURROUNDINGS else f"block {task.block:02d}"
    log = EventLog(Run(folder_of(Path(task.root), task.block)))
    with Display(quiet=task.quiet) as display:

        def report(event: "Report") -> None:
            display.training(event, name)
            log(event)

        if not train_block(task, report):
            display.say(f"{name} is finished already")
