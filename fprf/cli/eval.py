"""`fprf eval RUN`: measure a run on views it has not seen."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from rich.console import Console
from rich.table import Table

from ..checks import at_least
from ..errors import UsageError
from ..io.overwriting import Origin, OverwriteConfig
from ..progress import Display
from ..training.quality import QualityConfig
from .parsing import parse

if TYPE_CHECKING:
    from ..datamanagers.images import Image
    from ..training.history import History


_MAX_SIDE_PIXELS = 1600
"""Longest side of views as they are judged, where neither the user nor the training says another: that of the
usual reports.
"""
_TENSORBOARD_REMEDY = "name another --tensorboard, or replace it with --overwrite true"
_FITTED = ("psnr", "cc_psnr", "ssim", "lpips")
"""Figures that are said once more, as NAME_fitted_poses, after views' own poses were fitted."""
_EVENTS = "events.out.tfevents.*"
"""Names of TensorBoard's event files."""


@dataclass(frozen=True, kw_only=True)
class EvalConfig(QualityConfig, OverwriteConfig):
    """The run and the measurements."""

    run: Path = Path()
    """Run folder."""
    split: Literal["test", "train", "all"] = "test"
    """Views to judge."""
    size: int | None = None
    """Longest side in pixels at which views are judged; none = the photographs' own, up to 1600 pixels."""
    data: Path | None = None
    """Scene folder, where it has moved since training."""
    fit_poses: bool | None = None
    """Judge views once more after each one's own pose was fitted to its image, the scene as it is.
    metrics.json says the figures of both, and how far views were moved. none = where training refined poses.
    """
    images: bool = True
    """Write the renders to RUN/renders/SPLIT."""
    tensorboard: Path | None = None
    """A folder for how training went, as event files of TensorBoard (extra tensorboard): `tensorboard
    --logdir` shows them.
    """
    device: str = "auto"
    """cpu, cuda, mps, or auto."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.size is not None:
            at_least("size", self.size, 1)


def run(args: list[str]) -> int:
    """Render the split, write metrics.json, print a table."""
    description = "Measure a run: PSNR, SSIM, speed, memory, consistency over views."
    config = parse(EvalConfig(), args, prog="fprf eval", description=description, positional=("run",))
    # First, since views take long to judge: where this is refused nothing is lost.
    if config.tensorboard is not None:
        from ..training.history import read_history

        origin = Origin(
            by="eval", reads=(config.run,), overwrite=config.overwrite, remedy=_TENSORBOARD_REMEDY
        )
        write_scalars(config.tensorboard, read_history(config.run), origin)
    _print(evaluate(config))
    return 0


def evaluate(config: EvalConfig) -> dict[str, Any]:
    """Judge a run of any kind; write metrics.json and, if they are wanted, the renders, and return what is
    written.

    Raises UsageError where the images at hand are not those of the run, or the split has no views.
    """
    import torch

    from ..datamanagers.scene import at_origin
    from ..evaluation.metrics import judge
    from ..io.atomic import write_json
    from ..io.images import write_image
    from ..training.camera_optimizers import moved_cameras
    from ..training.loading import open_run
    from ..training.prepare import read_scene
    from ..training.run import view_names

    opened = open_run(config.run, config.device, config)
    scene = opened.scene
    known = opened.known
    # The photographs are read as training read them, at their own size and about the origin of the run.
    trained = opened.run.load_config()[0]
    trained = replace(trained, data=config.data or trained.data)
    captured = at_origin(read_scene(replace(trained, downscale=1)), known.facts.origin)
    if tuple(view_names(captured.paths)) != known.names:
        raise UsageError(f"{trained.data}: its images are not those of the run; name the folder with --data")
    # What a person looks at are the photographs, whatever size they were trained at.
    longest = captured.cameras.size.amax(1, keepdim=True)
    before = known.cameras.size
    wanted = config.size or max(_MAX_SIDE_PIXELS, int(before.max()))
    captured = replace(captured, cameras=captured.cameras.scaled((longest.double() / wanted).clamp_min(1)))
    known = replace(known, cameras=known.cameras.resized(captured.cameras.size))
    views = known.views(config.split)
    fitted: dict[str, Any] = {}
    renders = {view: config.run / "renders" / config.split / f"{known.names[view]}.png" for view in views}
    table = config.run / "metrics.json"
    origin = Origin(
        by="eval",
        reads=(config.run,),
        beside=(*captured.paths, *(mask for mask in captured.masks if mask is not None)),
        overwrite=config.overwrite,
        remedy="move it away, or replace it with --overwrite true",
    )

    def save(view: int, image: "Image") -> None:
        if config.images:
            write_image(renders[view], image)

    outputs = [table, *(renders.values() if config.images else ())]
    origin.check(outputs)
    if config.fit_poses is None:
        given = opened.run.load_known().cameras
        fit = not torch.equal(given.pose, opened.known.cameras.pose)
    else:
        fit = config.fit_poses
    with origin.writing(outputs), Display() as display:
        masks = trained.reading.masks
        found = judge(scene, known, captured, views, display.count, save, masks=masks)
        # Photographs of held-out views had no part in training, so each may be a little beside its pose there:
        # six numbers a view are fitted to the whole photograph, no colour is. Said beside, never instead.
        if fit:
            moves = scene.fit_poses(captured, views, display.count)
            moved = replace(known, cameras=moved_cameras(known.cameras, moves))
            after = judge(scene, moved, captured, views, display.count, lambda *of: None, masks=masks)
            poses = {}
            for view in views:
                turn = float(moves[view, :3].norm())
                shift = float(moves[view, 3:].norm())
                poses[known.names[view]] = {"turn_degrees": math.degrees(turn), "shift": shift}
            for name in _FITTED:
                fitted[f"{name}_fitted_poses"] = after[name]
            fitted["fitted_poses"] = poses
        metrics = {
            "method": opened.method,
            "scene": known.name,
            "split": config.split,
            "quality": config.quality,
            "size": "{}x{}".format(*captured.cameras.size[views[0]].tolist()),
            "trained_size": "{}x{}".format(*before[views[0]].tolist()),
            **found,
            "train_seconds": opened.seconds,
            "train_steps": opened.step,
            **scene.counts,
            **fitted,
        }
        write_json(table, metrics)
    return metrics


def write_scalars(folder: Path, histories: "Sequence[History]", origin: Origin) -> int:
    """One run of TensorBoard for the training and each of its parts; how many values were written. Event
    files that lie there are replaced where they have the same origin, nothing else.

    Times are those of training, so that a resumed run has no gap. Raises UsageError without the package
    `tensorboard`, and where event files of another origin lie there.
    """
    try:
        from torch.utils.tensorboard.writer import SummaryWriter
    except ImportError as fault:
        raise UsageError(
            "--tensorboard: the package tensorboard is not installed; pip install 'fprf[tensorboard]'"
        ) from fault
    written = 0
    places = []
    for history in histories:
        places.append(folder / (history.name or "training"))
    for place in places:
        origin.check(place.glob(_EVENTS))
    for place, history in zip(places, histories, strict=True):
        for old in place.glob(_EVENTS):
            old.unlink()
        writer = SummaryWriter(str(place))
        # A figure that a step did not measure leaves a gap in its curve.
        try:
            for name, values in history.values.items():
                for step, seconds, value in zip(history.step, history.seconds, values, strict=True):
                    if value is not None:
                        writer.add_scalar(name, value, step, walltime=seconds)
                        written += 1
        finally:
            writer.close()
        origin.record(place.glob(_EVENTS))
    return written


def _print(metrics: dict[str, object]) -> None:
    table = Table(box=None, show_header=False, pad_edge=False, padding=(0, 3, 0, 0))
    units = {
        "psnr": "dB",
        "psnr_fitted_poses": "dB, each view's own pose fitted to its photograph",
        "cc_psnr": "dB",
        "ssim": "",
        "lpips": "",
        "seconds_per_view": "s",
        "rays_per_second": "rays/s",
    }
    for key, unit in (
        units | {"kept_samples_share": "", "peak_rss_mib": "MiB", "train_seconds": "s"}
    ).items():
        value = metrics.get(key)
        if value is None:
            continue
        assert isinstance(value, float)
        table.add_row(key, f"{value:,.3f}" if value < 1000 else f"{value:,.0f}", unit)
    used = metrics["used_share"]
    assert isinstance(used, float)
    if used < 1:
        table.add_row("used_share", f"{used:.3f}", "of the pixels are judged: masks leave out the rest")
    warped = metrics["consistency"]
    assert isinstance(warped, dict)
    if warped["rmse"] is not None:
        table.add_row(
            "consistency rmse", f"{warped['rmse']:.4f}", f"over {warped['valid_share']:.0%} of the pixels"
        )
    judged = str(metrics["size"])
    trained = str(metrics["trained_size"])
    table.add_row("size", judged, "" if judged == trained else f"trained at {trained}")
    Console(highlight=False).print(table)
