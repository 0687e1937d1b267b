"""Runs of 3D Gaussians on the command line."""

import hashlib
import shutil
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
    from ..splats.config import GaussiansConfig
    from ..style.files import StyleFile
    from ..training.trainer import Report
    from ..viewer.aside import Aside
    from .eval import EvalConfig
    from .render import RenderVerbConfig

__all__ = ["SplatVerbs"]

_KINDS = {"ply": "splats.ply", "splat": "splats.splat"}
"""Kinds of `fprf export`, by the file that each makes."""


class SplatVerbs(Verbs):
    """Training from photographs, measuring, films and files of the plain scene; styles are for `fprf restyle`."""

    def __init__(self, config: "GaussiansConfig") -> None:
        self.config = config

    def plan(self, method: str) -> None:
        """Refuse: Gaussians are not trained in blocks."""
        raise UsageError(f"--plan: {method} trains a scene in one piece; leave --plan out")

    def train(self, method: str, *, quiet: bool = False, view: "Aside | None" = None, others: bool = False) -> Path:
        """Train Gaussians."""
        if view is not None:
            raise UsageError(f"--view: {method} is not shown while it trains; leave --view out")
        return _train(self.config, method, quiet, others)

    def needs(self) -> "list[Need]":
        """Nothing: what it takes is installed with fprf."""
        return []

    def evaluate(self, config: "EvalConfig") -> dict[str, object]:
        """Judge renders, lenses included, as those of fields are judged."""
        from ..evaluation.judge import judge_views
        from ..splats.training import draw_view, load_trained, scene_of
        from ..training.run import view_names
        from .eval import store

        if config.fit_poses:
            raise UsageError("--fit-poses: is for runs of fields; leave it out")
        trained = load_trained(config.run, self.config)
        data = config.data or trained.config.data
        scene = scene_of(replace(trained.config, data=data))
        if tuple(view_names(scene.paths)) != trained.known.names:
            raise UsageError(f"{data}: its images are not those of the run; name the folder with --data")
        views = trained.known.split(config.split)
        if not views:
            raise UsageError(f"--split {config.split}: the run holds no such views; choose another split")
        cameras, masks = trained.known.cameras, trained.config.masks
        with Display() as display:
            found, renders = judge_views(
                trained.known, scene, views, lambda view: draw_view(trained, cameras, view), display.count, masks=masks
            )
        found |= {"train_seconds": trained.seconds, "train_steps": trained.step, "gaussians": len(trained.gaussians)}
        return store(config, trained.known, trained.method, views, found, renders)

    def render(self, config: "RenderVerbConfig", file: "StyleFile") -> None:
        """Film the plain scene."""
        from ..datamanagers.images import load_image
        from ..io.images import to_uint8, write_image
        from ..io.maps import depth_image
        from ..io.sheet import beside
        from ..io.video import missing, write_video
        from ..splats.training import draw_view, load_trained
        from .render import camera_path

        _refuse_styles(config.run, config.references, config.style, config.styles, config.keyframes)
        if config.lens != "own" or {"normals", "match"} & {*config.show} or config.format == "exr":
            raise UsageError("fprf render: Gaussians are shown in colour and depth, through the path's own lens, as png or jpg")
        trained = load_trained(config.run, self.config)
        cameras, names = camera_path(trained.known, config)
        film = config.output.suffix.lower() == ".mp4"
        folder = config.output.with_suffix(".frames") if film else config.output
        paths = [folder / f"{name}.{'png' if film else config.format}" for name in names]
        digest = hashlib.sha256(f"{trained.run.root.resolve()} {trained.step} {trained.seconds} {config.show}".encode())
        for tensor in (cameras.pose, cameras.focal, cameras.centre, cameras.size, cameras.distortion, cameras.lens):
            digest.update(tensor.numpy().tobytes())
        todo = {*missing(folder, digest.hexdigest(), paths)}
        start = time.perf_counter()
        with Display() as display:
            for frame, path in enumerate(paths):
                display.count(frame, len(paths), "rendering")
                if path not in todo:
                    continue
                view = draw_view(trained, cameras, frame)
                shown = {"colour": lambda v=view: to_uint8(v.rgb), "depth": lambda v=view: depth_image(v.depth, v.opacity)}
                write_image(path, beside([shown[channel]() for channel in config.show]))
            display.count(len(paths), len(paths), "rendering")
            made = str(config.output)
            if film:
                made += f" ({write_video(config.output, (load_image(path) for path in paths), config.fps)})"
                shutil.rmtree(folder)
        print(f"{len(paths)} frames in {made}, {(time.perf_counter() - start) / max(1, len(todo)):.2f} s each")

    def export(self, config: "ExportConfig", file: "StyleFile") -> None:
        """Write files of Gaussians."""
        from ..splats.files import ENDINGS, write_gaussians
        from ..splats.training import load_trained

        _refuse_styles(config.run, config.references, config.style, config.styles)
        for kind in config.kinds:
            if kind not in _KINDS:
                raise UsageError(f"fprf export: of Gaussians there are {' and '.join(_KINDS)}, not {kind}")
        output = config.output or config.run / "exports"
        single = output.name.lower().endswith(ENDINGS) and not output.is_dir()
        trained = load_trained(config.run, self.config)
        paths = [output] if single else [output / _KINDS[kind] for kind in dict.fromkeys(config.kinds or _KINDS)]
        for path in paths:
            write_gaussians(path, trained.gaussians, antialiased=True)
        print(f"{len(trained.gaussians)} Gaussians in {', '.join(str(path) for path in paths)}")


def _refuse_styles(run: Path, *styles: object) -> None:
    """Raise UsageError where a style is asked for."""
    if any(styles):
        raise UsageError(
            f"{run}: a run of Gaussians is restyled as a file: `fprf export {run} ply`, then `fprf restyle` "
            f"{run / 'exports' / _KINDS['ply']}"
        )


def _train(config: "GaussiansConfig", method: str, quiet: bool, others: bool) -> Path:
    """Train to the end, or go on; see `train.train_scene` for fields."""
    from ..io.atomic import remove_unfinished
    from ..splats.training import facts_of, prepare, scene_of, train, with_downscale
    from ..training import originals
    from ..training.lock import held
    from ..training.run import Run
    from .event_log import EventLog
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
        marks = originals.fingerprints(scene)
        if folder.exists and not others:
            originals.refuse_others(output, scene, marks)
        prepared = prepare(config, scene)
        folder.root.mkdir(parents=True, exist_ok=True)
        folder.save_config(replace(config, output=None), method)  # the folder may be moved
        originals.keep(output, marks)
        folder.save_known(scene, config.data, facts_of(config, scene))
        display.say(f"{_described(scene)}, {prepared.learner.count} Gaussians at {prepared.origin}")
        log = EventLog(folder)
        spent = time.perf_counter() - start
        folder.log({"part": "preparing", "seconds": round(spent, 3)})

        def report(event: "Report") -> None:
            display.training(event)
            log(event)

        train(config, prepared, folder, report, spent=spent)
        display.say(f"done after {time.perf_counter() - start:.0f} s: fprf eval {output}")
    return output


def _described(scene: "Scene") -> str:
    width, height = (int(v) for v in scene.cameras.size[0])
    return f"{scene.name}: {len(scene.train)} + {len(scene.test)} views of {width}x{height}"
