"""Runs of 3D Gaussians on the command line."""

import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import UsageError
from .progress import Display
from .verbs import Verbs

if TYPE_CHECKING:
    from ..datamanagers.scene import Scene
    from ..export.config import ExportConfig
    from ..plugins.config import Need
    from ..splats.cell_training import CellTask
    from ..splats.config import GaussiansConfig
    from ..style.files import StyleFile
    from ..training.run import Run
    from ..training.trainer import Report
    from ..viewer.live import LiveViewer
    from .eval import EvalConfig

__all__ = ["SplatVerbs"]

_KINDS = ("ply", "splat")
"""Kinds of `fprf export`."""


class SplatVerbs(Verbs):
    """Training from photographs, measuring, and files of Gaussians."""

    def __init__(self, config: "GaussiansConfig") -> None:
        self.config = config

    def plan(self, method: str) -> None:
        """Refuse: Gaussians are not trained in blocks."""
        raise UsageError(f"--plan: {method} trains a scene in one piece; leave --plan out")

    def train(self, method: str, *, quiet: bool = False, view: "LiveViewer | None" = None, others: bool = False) -> Path:
        """Train Gaussians."""
        if view is not None:
            raise UsageError(f"--view: {method} is not shown while it trains; leave --view out")
        return _train(self.config, method, quiet, others)

    def needs(self) -> "list[Need]":
        """Nothing: what it takes is installed with fprf."""
        return []

    def evaluate(self, config: "EvalConfig") -> dict[str, object]:
        """Judge renders, lenses included, as those of fields are judged."""
        from ..evaluation.evaluate import judge_views
        from ..splats.training import open_gaussians, scene_of
        from ..training.run import view_names
        from .eval import store

        if config.fit_poses:
            raise UsageError("--fit-poses: is for runs of fields; leave it out")
        opened = open_gaussians(config.run, self.config, config)
        data, known = config.data or self.config.data, opened.known
        scene = scene_of(replace(self.config, data=data))
        if tuple(view_names(scene.paths)) != known.names:
            raise UsageError(f"{data}: its images are not those of the run; name the folder with --data")
        views = known.split(config.split)
        if not views:
            raise UsageError(f"--split {config.split}: the run holds no such views; choose another split")
        shown = opened.scene
        with Display() as display:
            found, renders = judge_views(
                known, scene, views, lambda view: shown.render(known.cameras, view), display.count, masks=self.config.masks
            )
        found |= {"train_seconds": opened.seconds, "train_steps": opened.step, "gaussians": len(shown.gaussians)}
        return store(config, known, opened.method, views, found, renders)

    def export(self, config: "ExportConfig", file: "StyleFile") -> None:
        """Write files of Gaussians, as they are and in every style."""
        from ..export.config import look_file, make_looks, styles_of
        from ..splats.files import ENDINGS, write_gaussians
        from ..splats.training import open_gaussians
        from ..training.quality import QualityConfig
        from .style_flags import say

        for kind in config.kinds:
            if kind not in _KINDS:
                raise UsageError(f"fprf export: of Gaussians there are {' and '.join(_KINDS)}, not {kind}")
        output = config.output or config.run / "exports"
        single = output.name.lower().endswith(ENDINGS) and not output.is_dir()
        styles = styles_of(config, file, say)
        if single and len(styles) > 1:
            raise UsageError(f"--output {output}: one file holds one style, {len(styles)} are asked for; name a folder")
        scene = open_gaussians(config.run, self.config, QualityConfig()).scene
        paths = []
        for look in make_looks(scene, styles)[-1 if single else 0 :]:
            shown = scene.restyled(look.restyle).shown
            for kind in dict.fromkeys(config.kinds or _KINDS):
                paths.append(output if single else output / look_file("splats", look.name, f".{kind}"))
                write_gaussians(paths[-1], shown, antialiased=True)
        print(f"{len(scene.gaussians)} Gaussians in {', '.join(str(path) for path in dict.fromkeys(paths))}")


def _train(config: "GaussiansConfig", method: str, quiet: bool, others: bool) -> Path:
    """Train to the end, or go on; see `train.train_scene` for fields."""
    from ..ops.rasterise_training import compile_beside

    compiling = compile_beside((config.degree + 1) ** 2)  # while torch is imported and images are read
    from ..io.atomic import remove_unfinished
    from ..splats.training import facts_of, prepare, scene_of, train, with_downscale
    from ..training.run import Run, check_images, held, image_hashes, save_image_hashes
    from .progress import EventLog
    from .train import check_same, default_output

    start = time.perf_counter()
    output = config.output or default_output(config, method)
    config = replace(config, output=output)
    folder = Run(output)
    with held(output), Display(quiet=quiet) as display:
        display.say(f"{method} on {config.data}, run folder {output}")
        if config.downscale is None and folder.exists:
            config = replace(config, downscale=folder.load_config()[0].downscale)
        config = with_downscale(config)
        check_same(folder, config)
        remove_unfinished(output)
        scene = scene_of(config)
        marks = image_hashes(scene)
        if folder.exists and not others:
            check_images(output, scene, marks)
        prepared = prepare(config, scene) if config.cells == 1 else None
        folder.root.mkdir(parents=True, exist_ok=True)
        folder.save_config(replace(config, output=None), method)  # the folder may be moved
        save_image_hashes(output, marks)
        folder.save_known(scene, config.data, facts_of(config, scene))
        if prepared is None:
            for process in compiling:
                process.wait()
            _train_cells(config, folder, scene, display, start)
            return output
        display.say(f"{_described(scene)}, {prepared.learner.count} Gaussians at {prepared.origin}")
        log = EventLog(folder)
        spent = time.perf_counter() - start
        folder.log({"part": "preparing", "seconds": round(spent, 3)})

        def report(event: "Report") -> None:
            display.training(event)
            log(event)

        if compiling:
            display.say("compiling kernels, once after installation")
            for process in compiling:
                process.wait()
            spent = time.perf_counter() - start
        train(config, prepared, folder, report, spent=spent)
        display.say(f"done after {time.perf_counter() - start:.0f} s: fprf eval {output}")
    return output


def _described(scene: "Scene") -> str:
    width, height = (int(v) for v in scene.cameras.size[0])
    return f"{scene.name}: {len(scene.train)} + {len(scene.test)} views of {width}x{height}"


def _train_cells(config: "GaussiansConfig", folder: "Run", scene: "Scene", display: Display, start: float) -> None:
    """Train the whole scene coarsely, then all cells, those with the largest windows first, and write their union."""
    from ..splats.cell_training import CellTask, train_overview, unite, write_cells
    from .progress import EventLog

    assert config.data is not None
    cells = write_cells(folder.root, scene, config.cells)
    pixels = [sum(width * height for _, _, width, height in cell.windows.values()) for cell in cells]
    whole = int(scene.cameras.size[scene.train].prod(1).sum())
    display.say(f"{_described(scene)}, {len(cells)} cells, whose windows are {sum(pixels) / whole:.2f} times the photographs")
    log = EventLog(folder)

    def report(event: "Report") -> None:
        display.training(event, "whole scene")
        log(event)

    if not train_overview(folder.root, config, scene, report, spent=time.perf_counter() - start):
        display.say("the whole scene is trained already")
    root, data = str(folder.root.resolve()), str(config.data.resolve() if config.data.exists() else config.data)
    order = sorted(range(len(cells)), key=lambda cell: -pixels[cell])
    count, executor = 0, config.executor.on("cpu").build()
    for number in range(config.rounds):
        minutes = None
        if config.minutes is not None:
            left = max(config.minutes - (time.perf_counter() - start) / 60, 0.05 * config.minutes)
            minutes = left / (config.rounds - number) / len(cells)
        executor.map(
            run_cell,
            [CellTask(root=root, data=data, round=number, cell=cell, minutes=minutes, quiet=display.quiet) for cell in order],
        )
        count = unite(folder.root, number, cells, folder.checkpoints if number == config.rounds - 1 else None)
    display.say(f"done after {time.perf_counter() - start:.0f} s, {count} Gaussians: fprf eval {folder.root}")


def run_cell(task: "CellTask") -> None:
    """Train one cell, here or on a worker, and show how it goes."""
    from ..splats.cell_training import folder_of, train_cell
    from ..training.run import Run
    from .progress import EventLog

    log = EventLog(Run(folder_of(Path(task.root), task.round, task.cell)))
    with Display(quiet=task.quiet) as display:

        def report(event: "Report") -> None:
            display.training(event, f"round {task.round}, cell {task.cell:02d}")
            log(event)

        if not train_cell(task, report):
            display.say(f"round {task.round}, cell {task.cell:02d} is finished already")
