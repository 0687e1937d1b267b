"""Runs of 3D Gaussians on the command line."""

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import UsageError
from .progress import Display, EventLog
from .verbs import Verbs

if TYPE_CHECKING:
    from ..datamanagers.scene import Scene
    from ..plugins.config import Need
    from ..splats.cell_training import CellTask
    from ..splats.config import GaussiansConfig
    from ..training.run import Run
    from ..training.trainer import Report
    from ..types import View
    from ..viewer.live import LiveViewer
    from .eval import EvalConfig


class SplatVerbs(Verbs):
    """Training from photographs, and measuring."""

    def __init__(self, config: "GaussiansConfig") -> None:
        self.config = config

    def plan(self, method: str) -> None:
        raise UsageError(f"--plan: {method} trains a scene in one piece; leave --plan out")

    def train(self, method: str, *, quiet: bool = False, view: "LiveViewer | None" = None, others: bool = False) -> Path:
        if view is not None and self.config.cells > 1:
            raise UsageError("--view: cells are not shown while they train; leave --view or --cells out")
        for need in self.needs():
            if not need.downloaded:
                raise UsageError(f"fprf train {method}: {need.what}: {need.remedy}")
        return _train(self.config, method, quiet, view, others)

    def needs(self) -> "list[Need]":
        from ..training.prepare import plugin_needs

        return plugin_needs(self.config)

    def evaluate(self, config: "EvalConfig") -> dict[str, object]:
        import torch

        from ..evaluation.evaluate import described, judge_views
        from ..splats.training import fit_poses, load_tones, open_gaussians
        from ..training.camera_optimizers import moved_cameras
        from .eval import store, views_to_judge

        opened = open_gaussians(config.run, self.config, config)
        known, shown, tones = opened.known, opened.scene, load_tones(opened.run)
        scene, views = views_to_judge(config, self.config, known)

        def draw(view: int) -> "View":
            if tones is None:
                return shown.render(known.cameras, view)
            # Of a view that was held out, what its exposure says.
            red, green, blue = tones(torch.tensor([view]))[0].tolist()
            return replace(shown, tone=(red, green, blue)).render(known.cameras, view)

        with Display() as display:
            if config.fit_poses:
                display.say(f"fitting the poses of {len(views)} views")
                moves = fit_poses(self.config, scene, opened, views)
                known = replace(known, cameras=moved_cameras(known.cameras, moves))
            scores, images = judge_views(known, scene, views, draw, display.count, masks=self.config.masks)
        if config.fit_poses:
            scores["fitted_poses"] = {known.names[view]: described(moves[view]) for view in views}
        scores |= {"train_seconds": opened.seconds, "train_steps": opened.step, "gaussians": len(shown.gaussians)}
        return store(config, known, opened.method, views, scores, images)


def _train(config: "GaussiansConfig", method: str, quiet: bool, view: "LiveViewer | None", others: bool) -> Path:
    """Train to the end, or go on; see `train.train_scene` for fields."""
    from ..ops.rasterise_training import compile_beside

    compiling = compile_beside((config.degree + 1) ** 2)  # while torch is imported and images are read
    from ..datamanagers.images import load_images, useless_masks
    from ..io.atomic import remove_unfinished
    from ..splats.cell_training import OVERVIEW
    from ..splats.training import facts_of, lit, prepare, scene_of, state_of, train, with_downscale
    from ..training.run import Run, check_images, held, image_hashes, save_image_hashes
    from .train import check_same, default_output, finish_view

    start = time.perf_counter()
    output = config.output or default_output(config, method)
    config = replace(config, output=output)
    folder = Run(output)
    with held(output), Display(quiet=quiet) as display:
        display.say(f"{method} on {config.data}, run folder {output}")
        if view is not None:
            display.say(f"live at {view.address}")
        if config.downscale is None and folder.exists:
            config = replace(config, downscale=folder.load_config()[0].downscale)
        config = with_downscale(config)
        check_same(folder, config)
        remove_unfinished(output)
        saved = folder.load_known().facts if folder.checkpoints.is_dir() or (output / OVERVIEW).is_dir() else None
        scene = scene_of(config, saved)
        for note in scene.notes:
            display.say(f"note: {note}")
        said = useless_masks(scene) if config.masks else ""
        if said:
            display.say(said)
        marks = image_hashes(scene)
        if folder.exists and not others:
            check_images(output, scene, marks)
        prepared = prepare(config, scene, saved=saved) if config.cells == 1 else None
        folder.root.mkdir(parents=True, exist_ok=True)
        folder.save_config(replace(config, output=None), method)  # the folder may be moved
        save_image_hashes(output, marks)
        facts = saved if prepared is None else prepared.facts
        if facts is None:
            facts = lit(facts_of(config, scene), config, scene, lambda view: load_images(scene, config.background, [view])[0])
        folder.save_known(scene, config.data, facts)
        if prepared is None:
            for process in compiling:
                process.wait()
            _train_cells(config, folder, scene, display, start)
            return output
        light = ", tones" if prepared.learner.tones is not None else ""
        display.say(f"{_described(scene)}, {prepared.learner.count} Gaussians at {prepared.origin}{light}")
        report = _reporter(display, folder, view=view)
        spent = time.perf_counter() - start
        folder.log({"part": "preparing", "seconds": round(spent, 3)})
        if view is not None:
            learner, near = prepared.learner, prepared.near
            view.begin(output, lambda: state_of(learner.gaussians(), near), "cpu")
        if compiling:
            display.say("compiling kernels, once after installation")
            for process in compiling:
                process.wait()
            spent = time.perf_counter() - start
        most = config.passes * len(scene.train)
        if most < config.steps:
            display.say(f"at most {most} steps: {config.passes} passes over {len(scene.train)} photographs (--passes)")
        train(replace(config, steps=min(config.steps, most)), prepared, folder, report, spent=spent)
        display.say(f"done after {time.perf_counter() - start:.0f} s: fprf eval {output}")
    finish_view(view, display)
    return output


def _described(scene: "Scene") -> str:
    width, height = (int(v) for v in scene.cameras.size[0])
    return f"{scene.name}: {len(scene.train)} + {len(scene.test)} views of {width}x{height}"


def _train_cells(config: "GaussiansConfig", folder: "Run", scene: "Scene", display: Display, start: float) -> None:
    """Train the whole scene coarsely, then all cells, those with the largest windows first, and write their union."""
    from ..splats.cell_training import CellTask, train_overview, unite, write_cells

    assert config.data is not None
    cells = write_cells(folder.root, scene, config.data, config.cells)
    pixels = [sum(width * height for _, _, width, height in cell.windows.values()) for cell in cells]
    whole = int(scene.cameras.size[scene.train].prod(1).sum())
    display.say(f"{_described(scene)}, {len(cells)} cells, whose windows are {sum(pixels) / whole:.2f} times the photographs")
    report = _reporter(display, folder, "whole scene")
    if not train_overview(folder.root, config, scene, report, spent=time.perf_counter() - start):
        display.say("the whole scene is trained already")
    root, data = str(folder.root.resolve()), str(config.data.resolve() if config.data.exists() else config.data)
    order = sorted(range(len(cells)), key=lambda cell: -pixels[cell])
    minutes = None
    if config.minutes is not None:
        minutes = max(config.minutes - (time.perf_counter() - start) / 60, 0.05 * config.minutes) / len(cells)
    tasks = [CellTask(root=root, data=data, cell=cell, minutes=minutes, quiet=display.quiet) for cell in order]
    config.executor.on("cpu").build().map(run_cell, tasks)
    count = unite(folder.root, cells)
    display.say(f"done after {time.perf_counter() - start:.0f} s, {count} Gaussians: fprf eval {folder.root}")


def run_cell(task: "CellTask") -> None:
    """Train one cell, here or on a worker, and show how it goes."""
    from ..splats.cell_training import folder_of, train_cell
    from ..training.run import Run

    name = f"cell {task.cell:02d}"
    with Display(quiet=task.quiet) as display:
        if not train_cell(task, _reporter(display, Run(folder_of(Path(task.root), task.cell)), name)):
            display.say(f"{name} is finished already")


def _reporter(
    display: Display, folder: "Run", name: str = "training", view: "LiveViewer | None" = None
) -> "Callable[[Report], None]":
    """Progress of what is trained for the display, the run folder and the viewer."""
    log = EventLog(folder)

    def report(event: "Report") -> None:
        display.training(event, name)
        log(event)
        if view is not None:
            view(event)

    return report
