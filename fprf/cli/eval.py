"""`fprf eval RUN`: measure a run on views it has not seen."""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from rich.console import Console
from rich.table import Table

from ..errors import UsageError
from ..training.quality import QualityConfig, at_quality
from .parsing import parse
from .progress import Display
from .verbs import verbs_of, views_of

if TYPE_CHECKING:
    from ..config import RunConfig
    from ..datamanagers.images import Image
    from ..datamanagers.scene import Scene
    from ..training.run import History, Known


@dataclass(frozen=True, kw_only=True)
class EvalConfig(QualityConfig):
    """The run and the measurements."""

    run: Path = Path()
    """Run folder."""
    split: Literal["test", "train", "all"] = "test"
    """Views to judge."""
    data: Path | None = None
    """Scene folder, where it has moved since training."""
    fit_poses: bool = False
    """Fit each view's own pose to its image first, the scene as it is: for captures whose poses are rough, or were refined.
    metrics.json then says how far they were moved."""
    images: bool = True
    """Write the renders to RUN/renders/SPLIT."""
    tensorboard: Path | None = None
    """A folder for how training went, as event files of TensorBoard (extra tensorboard): `tensorboard --logdir` shows them."""
    device: str = "auto"
    """cpu, cuda, mps, or auto."""


def run(args: list[str]) -> int:
    """Render the split, write metrics.json, print a table."""
    description = "Measure a run: PSNR, SSIM, speed, memory, consistency over views."
    config = parse(EvalConfig(), args, prog="fprf eval", description=description, positional=("run",))
    metrics = verbs_of(config.run).evaluate(config)
    if config.tensorboard is not None:
        from ..training.run import read_history

        write_scalars(config.tensorboard, read_history(config.run))
    _print(metrics)
    return 0


def evaluate_fields(config: EvalConfig) -> dict[str, object]:
    """Judge a run of fields."""
    from ..evaluation.evaluate import align, described, judge
    from ..training.loading import load_run

    trained = at_quality(load_run(config.run, config.device, config.max_memory), config)
    scene, views = views_to_judge(config, trained.config, trained.known)
    fitted: dict[str, object] = {}
    with Display() as display:
        if config.fit_poses:
            trained, moves = align(trained, scene, views, display.count)
            fitted = {"fitted_poses": {trained.known.names[view]: described(move) for view, move in moves.items()}}
        metrics, images = judge(trained, scene, views, display.count)
    return store(config, trained.known, trained.method, views, metrics | fitted, images)


def views_to_judge(config: EvalConfig, trained: "RunConfig", known: "Known") -> "tuple[Scene, list[int]]":
    """The scene that a run was trained on, from where it lies now, and the views of the split.

    Raises UsageError where its images are not those of the run, or the split has no views.
    """
    from ..datamanagers.scene import at_origin
    from ..training.run import view_names

    trained = replace(trained, data=config.data or trained.data)
    scene = at_origin(trained.read_scene(), known.facts.origin)
    if tuple(view_names(scene.paths)) != known.names:
        raise UsageError(f"{trained.data}: its images are not those of the run; name the folder with --data")
    return scene, views_of(known, config.split)


def store(
    config: EvalConfig, known: "Known", method: str, views: Sequence[int], found: dict[str, Any], images: "list[Image]"
) -> dict[str, object]:
    """Write metrics.json and, if they are wanted, the renders; returns what is written."""
    from ..io.atomic import write_json
    from ..io.video import write_frames

    metrics = {"method": method, "scene": known.name, "split": config.split, "quality": config.quality, **found}
    write_json(config.run / "metrics.json", metrics)
    if config.images:
        names = [known.names[v] for v in views]
        write_frames(config.run / "renders" / config.split, names, images)
    return metrics


def write_scalars(folder: Path, histories: "Sequence[History]") -> int:
    """One run of TensorBoard for the training and each block, replaced if it is there; how many values were written.

    Times are those of training, so that a resumed run has no gap. Raises UsageError without the package `tensorboard`.
    """
    try:
        from torch.utils.tensorboard.writer import SummaryWriter
    except ImportError as fault:
        raise UsageError("--tensorboard: the package tensorboard is not installed; pip install 'fprf[tensorboard]'") from fault
    written = 0
    for history in histories:
        place = folder / (history.name or "training")
        shutil.rmtree(place, ignore_errors=True)
        writer = SummaryWriter(str(place))
        try:
            for name, values in history.values.items():
                for step, seconds, value in zip(history.step, history.seconds, values, strict=True):
                    if value is not None:
                        writer.add_scalar(name, value, step, walltime=seconds)
                        written += 1
        finally:
            writer.close()
    return written


def _print(metrics: dict[str, object]) -> None:
    table = Table(box=None, show_header=False, pad_edge=False, padding=(0, 3, 0, 0))
    units = {"psnr": "dB", "rays_per_second": "rays/s", "peak_rss_mib": "MiB", "seconds_per_view": "s", "train_seconds": "s"}
    for key in ("psnr", "ssim", "seconds_per_view", "rays_per_second", "kept_samples_share", "peak_rss_mib", "train_seconds"):
        value = metrics[key]
        assert isinstance(value, float)
        table.add_row(key, f"{value:,.3f}" if value < 1000 else f"{value:,.0f}", units.get(key, ""))
    warped = metrics["consistency"]
    assert isinstance(warped, dict)
    if warped["rmse"] is not None:
        table.add_row("consistency rmse", f"{warped['rmse']:.4f}", f"over {warped['valid_share']:.0%} of the pixels")
    Console(highlight=False).print(table)
