"""Runs of 3D Gaussians on the command line."""

import hashlib
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
    from ..export.config import ExportConfig
    from ..plugins.config import Need
    from ..splats.cell_training import CellTask
    from ..splats.config import GaussiansConfig
    from ..style.files import StyleFile
    from ..training.run import Run
    from ..training.trainer import Report
    from ..types import View
    from .eval import EvalConfig

_KINDS = ("ply", "splat", "cameras")
"""Kinds of `fprf export`; the last one not unless it is asked for."""


class SplatVerbs(Verbs):
    """Training from photographs, measuring, and files of Gaussians."""

    def __init__(self, config: "GaussiansConfig") -> None:
        self.config = config

    def train(self, method: str, *, quiet: bool = False, others: bool = False) -> Path:
        for need in self.needs():
            if not need.downloaded:
                raise UsageError(f"fprf train {method}: {need.what}: {need.remedy}")
        return _train(self.config, method, quiet, others)

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

    def export(self, config: "ExportConfig", file: "StyleFile") -> None:
        from ..export.config import Plan, look_file, make_looks, styles_of
        from ..plugins.captures import format_name
        from ..splats.files import write_gaussians, write_ply_parts
        from ..splats.training import open_gaussians
        from ..training.checkpoint import digest
        from ..training.quality import QualityConfig
        from .export import export_cameras
        from .style_flags import say

        for kind in config.kinds:
            if kind not in _KINDS:
                raise UsageError(
                    f"fprf export: of Gaussians there are {', '.join(_KINDS)}, not {kind}; a run of fields has all kinds, or "
                    "`export RUN cameras --images` makes a scene folder that other programs reconstruct"
                )
        if config.fit:
            raise UsageError("--fit: the run is of Gaussians already; leave it out")
        output = config.output or config.run / "exports"
        kinds, gaussians = tuple(dict.fromkeys(config.kinds or _KINDS[:2])), format_name(output) is not None
        table = output.suffix.lower() == ".json" and not gaussians
        single = (gaussians or table) and not output.is_dir()
        if single and config.kinds and table != ("cameras" in kinds):
            raise UsageError(f"--output {output}: cameras are written to a .json file, Gaussians to others; name a folder")
        styles = styles_of(config, file, say)
        if single and len(styles) > 1:
            raise UsageError(f"--output {output}: one file holds one style, {len(styles)} are asked for; name a folder")
        opened = open_gaussians(config.run, self.config, QualityConfig())
        scene, paths, losses = opened.scene, [], dict[str, None]()
        looks = make_looks(scene, styles)[-1 if single else 0 :]
        if table or "cameras" in kinds:
            what = Plan(("cameras",), output.parent if single else output, output if single else None)
            with Display() as display:
                export_cameras(scene, opened.known, config, what, looks, display)
            print(f"cameras in {what.single or what.folder / 'transforms.json'}")
        kinds = () if table else tuple(kind for kind in kinds if kind != "cameras")
        for look in looks if kinds else ():
            shown = scene.restyled(look.restyle)
            for kind in kinds:
                paths.append(path := output if single else output / look_file("splats", look.name, f".{kind}"))
                if path.suffix.lower() == ".ply" and not path.name.lower().endswith(".compressed.ply") and not config.plain:
                    style = "" if look.restyle is None else look.restyle.digest
                    key = f"{digest(opened.run.checkpoints)} {style}{' local' * config.local}"
                    key = hashlib.sha256(key.encode()).hexdigest()
                    write_ply_parts(
                        path,
                        shown.part,
                        len(scene.gaussians),
                        key,
                        antialiased=True,
                        origin=scene.origin,
                        local=config.local,
                    )
                else:
                    written = write_gaussians(
                        path,
                        shown.shown,
                        antialiased=True,
                        views=scene.views,
                        plain=config.plain,
                        origin=scene.origin,
                        local=config.local,
                    )
                    losses |= {f", {path.name}: {loss}": None for loss in written.losses()}
        if paths:
            print(
                f"{len(scene.gaussians)} Gaussians in {', '.join(str(path) for path in dict.fromkeys(paths))}{''.join(losses)}"
            )


def _train(config: "GaussiansConfig", method: str, quiet: bool, others: bool) -> Path:
    """Train to the end, or go on; see `train.train_scene` for fields."""
    from ..ops.rasterise_training import compile_beside

    compiling = compile_beside((config.degree + 1) ** 2)  # while torch is imported and images are read
    from ..datamanagers.images import load_images, useless_masks
    from ..io.atomic import remove_unfinished
    from ..splats.cell_training import OVERVIEW
    from ..splats.training import facts_of, lit, prepare, scene_of, train, with_downscale
    from ..training.run import Run, check_images, held, image_hashes, save_image_hashes
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
        report = _reporter(display, folder)
        spent = time.perf_counter() - start
        folder.log({"part": "preparing", "seconds": round(spent, 3)})
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


def _reporter(display: Display, folder: "Run", name: str = "training") -> "Callable[[Report], None]":
    """Progress of what is trained for the display and the run folder."""
    log = EventLog(folder)

    def report(event: "Report") -> None:
        display.training(event, name)
        log(event)

    return report
