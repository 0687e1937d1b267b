"""The paper's tables on any scene: a method as it is, and with one thing changed, trained equally long and judged alike.

Of every training: PSNR and SSIM of held-out views. The town is restyled as well, with three references in each palette, and
judged by its truth. Styles that need no training of their own (numbers of clusters, of references) are compared on one.
"""

import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import torch

from ..config import TrainConfig
from ..datamanagers.images import load_image
from ..errors import UsageError
from ..evaluation.metrics import image_metrics, mean_metrics
from ..plugins.decoders.config import ResidualDecoderConfig
from ..plugins.stylizers.config import LocalAdainConfig, RegionToneConfig
from ..style.references import Encoders
from ..training.loading import Trained, encoders_of, load_run
from ..training.prepare import prepare, scene_of
from ..training.run import Run
from ..training.style_pass import measure_style
from ..training.trainer import Report, train
from ..training.views import render_view
from .config import PaperConfig
from .paper_styles import Bench, restyled, set_up, style_rows, styled_by_photographs
from .scene_decoder import SceneDecoderConfig
from .scores import Row, mean_rows
from .stage import town_folder

__all__ = ["TRAINED", "Short", "paper", "short_training"]

Progress = Callable[[int, int, str], None]
Change = Callable[[TrainConfig], TrainConfig]


def _same(config: TrainConfig) -> TrainConfig:
    return config


def _scene_decoder(config: TrainConfig) -> TrainConfig:
    return replace(config, content=replace(config.content, decoder=SceneDecoderConfig()))


def _residual(config: TrainConfig) -> TrainConfig:
    return replace(config, content=replace(config.content, decoder=ResidualDecoderConfig()))


def _no_content_loss(config: TrainConfig) -> TrainConfig:
    return replace(config, loss=replace(config.loss, content=0.0))


def _no_guide(config: TrainConfig) -> TrainConfig:
    """Features between cells are interpolated, the picture does not guide them."""
    manager = config.datamanager
    return replace(config, datamanager=replace(manager, guided=replace(manager.guided, radius=0.0)))


TRAINED: Mapping[str, Mapping[str, Change]] = {
    "reconstruction": {
        "frozen decoder": _same,
        "frozen and residual": _residual,
        "decoder trained with the scene": _scene_decoder,
    },
    "ablation": {
        "as it is": _same,
        "without content loss": _no_content_loss,
        "without pre-trained decoder": _scene_decoder,
        "without either": lambda config: _scene_decoder(_no_content_loss(config)),
    },
    "guided-filter": {"with guided filter": _same, "without": _no_guide},
}
"""By table: what each of its rows changes."""


class Short(NamedTuple):
    """A training, in memory."""

    trained: Trained
    encoders: Encoders
    seconds: float


def paper(config: PaperConfig, method: TrainConfig, name: str, progress: Progress) -> dict[str, Any]:
    """The document of one table; `method` is the config that `config.method` stands for, `name` that of its method."""
    base = replace(method, data=config.data, downscale=config.downscale, device=config.device)
    base = replace(base, steps=config.steps, minutes=None, output=None)
    steps = config.steps
    if config.run is not None and config.table not in TRAINED:
        steps = load_run(config.run, "cpu").step
    tables = []
    with tempfile.TemporaryDirectory(prefix="fprf-paper-") as made:
        for k, seed in enumerate(config.trainings):
            folder = Path(made) / str(k)
            tables.append(_table(config, replace(base, seed=seed), folder, progress))
    return {
        "benchmark": "paper",
        "table": config.table,
        "settings": {
            "data": config.data.name,
            "method": name,
            "references": [path.stem for path in config.references],
            "steps": steps,
            "trainings": list(config.trainings),
            "views": config.views,
            "palettes": list(config.palettes),
            "downscale": config.downscale,
            "codes": config.codes,
            "blend": config.blend,
        },
        "rows": mean_rows(tables),
    }


def short_training(config: TrainConfig, folder: Path, progress: Progress) -> Short:
    """Prepare, train and measure the scene's style, without a run folder that others could read."""
    prepared = prepare(config)
    run = Run(folder)
    run.root.mkdir(parents=True)
    run.save_known(prepared.scene, config.data, prepared.facts)
    last: list[Report] = []

    def report(event: Report) -> None:
        last[:] = [event]
        progress(event.step, config.steps, "training")

    start = time.perf_counter()
    model = train(config, prepared, run, report).requires_grad_(False).eval()
    spent = time.perf_counter() - start
    scene = measure_style(config, model, prepared.scene.cameras, prepared.scene.train)
    trained = Trained(run, config, "", run.load_known(), model, config.steps, spent)
    return Short(trained, encoders_of(trained, scene, prepared.basis), spent)


def _table(config: PaperConfig, base: TrainConfig, folder: Path, progress: Progress) -> dict[str, Row]:
    if config.table in TRAINED:
        rows = {}
        for k, (name, change) in enumerate(TRAINED[config.table].items()):
            short = short_training(change(base), folder / str(k), progress)
            rows[name] = _held_out(short.trained, config.views) | {"train_seconds": short.seconds}
            if town_folder(short.trained) is not None:
                rows[name] |= _styled(set_up(short.trained, short.encoders, config, folder / f"references-{k}"))
            elif config.references:
                rows[name] |= styled_by_photographs(short.trained, short.encoders, config)
        return rows
    short = short_training(base, folder / "run", progress) if config.run is None else _finished(config.run, config.device)
    if town_folder(short.trained) is None:
        raise UsageError(f"--table {config.table}: judged by a town's truth; --run or --data is another scene, leave it out")
    steady = config.table in ("statistics", "large-scale")
    return style_rows(set_up(short.trained, short.encoders, config, folder / "references", path=steady))


def _styled(bench: Bench) -> Row:
    """The recommended stylizer on a training, and the paper's own, which has nothing but features."""
    paper = restyled(bench, LocalAdainConfig())
    shown = {f"paper_{key}": paper[key] for key in ("styled_psnr", "styled_delta_e", "structure") if key in paper}
    return restyled(bench, RegionToneConfig()) | shown


def _finished(root: Path, device: str) -> Short:
    """A run that is trained already."""
    trained = load_run(root, device)
    return Short(trained, trained.encoders(), trained.seconds)


def _held_out(trained: Trained, views: int) -> Row:
    known, config = trained.known, trained.config
    scene = scene_of(config)
    chosen = (known.test or known.train)[:views]
    found = []
    for view in chosen:
        render = render_view(trained.model, known.facts, known.cameras, view, config.render).rgb
        size = (render.shape[1], render.shape[0])
        truth = torch.from_numpy(load_image(scene.paths[view], size, known.facts.background)).float() / 255
        found.append(image_metrics(render, truth))
    return dict(mean_metrics(found))
