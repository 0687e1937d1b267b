"""The page of one of the paper's tables, from its document alone."""

import inspect
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import torch
from torch import Tensor, nn

from fprf.cli.parsing import load_field_method, parse
from fprf.config import TrainConfig
from fprf.datamanagers.images import load_image
from fprf.errors import UsageError
from fprf.evaluation.metrics import image_metrics, mean_metrics
from fprf.interfaces import Decoder
from fprf.ops import dense
from fprf.plugins.decoders.config import DecoderConfig, MlpDecoderConfig
from fprf.plugins.stylizers.config import LocalAdainConfig, RegionToneConfig
from fprf.progress import Display
from fprf.style.references import Encoders
from fprf.training.driver import Report, learn, schedule_of
from fprf.training.learner import FieldLearner
from fprf.training.loading import Trained, encoders_of, load_run
from fprf.training.prepare import device_of, prepare, read_scene
from fprf.training.run import Run
from fprf.training.style_pass import measure_style
from fprf.training.views import render_view

from .common import origin, write_report
from .paper_styles import Bench, PaperConfig, restyled, set_up, style_rows, styled_by_photographs
from .report import Column, markdown, provenance, words
from .town.write import scene_folder
from .town_truth import Row, mean_rows, town_folder


@dataclass(frozen=True, kw_only=True)
class SceneDecoderConfig(DecoderConfig):
    """A network of the shipped decoder's size, trained with the scene."""

    def build(self, *, encoder: str, channels: int, seed: int = 0) -> Decoder:
        """As large as the shipped decoder of that encoder; starts from the seed."""
        from fprf.plugins.decoders.decoders import load_decoder

        hidden = load_decoder(MlpDecoderConfig().weights, encoder=encoder, channels=channels).first.out_features
        return SceneDecoder(channels, hidden, torch.Generator().manual_seed(seed))


class SceneDecoder(Decoder):
    """rgb = sigmoid(W2 relu(W1 f + b1) + b2), every weight the scene's own.

    Weights are kept times the root of their fan-in: Adam moves each by the learning rate, whatever its size.
    """

    def __init__(self, channels: int, hidden: int, generator: torch.Generator) -> None:
        super().__init__()
        bound = 6**0.5
        self.first = nn.Parameter(torch.empty(hidden, channels).uniform_(-bound, bound, generator=generator))
        self.first_bias = nn.Parameter(torch.zeros(hidden))
        self.second = nn.Parameter(torch.zeros(3, hidden))
        self.second_bias = nn.Parameter(torch.zeros(3))

    def forward(self, content: Annotated[Tensor, "N C"]) -> Annotated[Tensor, "N 3"]:
        """sRGB in [0, 1]; grey before it is trained."""
        maps = [weight / weight.shape[1] ** 0.5 for weight in (self.first, self.second)]
        return torch.sigmoid(dense.network(content, maps, [self.first_bias, self.second_bias]))


Progress = Callable[[int, int, str], None]
Change = Callable[[TrainConfig], TrainConfig]


def _same(config: TrainConfig) -> TrainConfig:
    return config


def _scene_decoder(config: TrainConfig) -> TrainConfig:
    return replace(config, content=replace(config.content, decoder=SceneDecoderConfig()))


def _no_content_loss(config: TrainConfig) -> TrainConfig:
    return replace(config, loss=replace(config.loss, content=0.0))


def _no_guide(config: TrainConfig) -> TrainConfig:
    """Features between cells are interpolated, the picture does not guide them."""
    manager = config.datamanager
    return replace(config, datamanager=replace(manager, guided=replace(manager.guided, radius=0.0)))


TRAINED: Mapping[str, Mapping[str, Change]] = {
    "reconstruction": {
        "frozen decoder": _same,
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
    base = replace(method, data=scene_folder(config.data), downscale=config.downscale, device=config.device)
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
    prepared = prepare(config, read_scene(config))
    run = Run(folder)
    run.root.mkdir(parents=True)
    run.save_known(prepared.scene, scene_folder(config.data), prepared.facts)
    last: list[Report] = []

    def report(event: Report) -> None:
        last[:] = [event]
        progress(event.step, config.steps, "training")

    start = time.perf_counter()
    learner = FieldLearner(config, prepared, device_of(config.device))
    learn(learner, run, schedule_of(config, len(prepared.scene.train)), report)
    model = learner.model.requires_grad_(False).eval()
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
            if town_folder(short.trained.config) is not None:
                rows[name] |= _styled(set_up(short.trained, short.encoders, config, folder / f"references-{k}"))
            elif config.references:
                rows[name] |= styled_by_photographs(short.trained, short.encoders, config)
        return rows
    short = short_training(base, folder / "run", progress) if config.run is None else _finished(config.run, config.device)
    if town_folder(short.trained.config) is None:
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
    scene = read_scene(config)
    chosen = (known.test or known.train)[:views]
    found = []
    for view in chosen:
        render = render_view(trained.model, known.facts, known.cameras, view, config.render).rgb
        size = (render.shape[1], render.shape[0])
        truth = torch.from_numpy(load_image(scene.paths[view], size, known.facts.background)).float() / 255
        found.append(image_metrics(render, truth))
    return dict(mean_metrics(found))


COLUMNS: tuple[Column, ...] = (
    ("psnr", "PSNR dB", ".2f"),
    ("ssim", "SSIM", ".3f"),
    ("styled_psnr", "styled PSNR dB", ".2f"),
    ("styled_ssim", "styled SSIM", ".3f"),
    ("styled_delta_e", "styled ΔE2000", ".1f"),
    ("style_distance", "style distance", ".3f"),
    ("structure", "structure", ".3f"),
    ("match_inside", "match inside", ".1%"),
    ("match_border", "match at borders", ".1%"),
    ("paper_styled_psnr", "local-adain PSNR dB", ".2f"),
    ("paper_styled_delta_e", "local-adain ΔE2000", ".1f"),
    ("paper_style_distance", "local-adain style distance", ".3f"),
    ("paper_structure", "local-adain structure", ".3f"),
    ("consistency", "consistency", ".3f"),
    ("warp_short", "error to the next frame", ".3f"),
    ("warp_long", "error seven frames on", ".3f"),
    ("train_seconds", "training s", ".1f"),
    ("style_seconds", "style s", ".2f"),
    ("view_seconds", "view s", ".3f"),
)
_ABOUT = {
    "reconstruction": "The frozen, scene-agnostic decoder against one that the scene trains for itself, from nothing.",
    "ablation": "What the content loss and the pre-trained decoder are good for: the scene as it is, and restyled.",
    "guided-filter": "Feature targets with the guided filter, and merely interpolated between cells.",
    "clusters": "Local styles per reference, one training; and no clusters, every cell of 8x8 pixels a style of its own.",
    "multi-reference": "One reference, and three that share the work (see [restyle.md](restyle.md)), one training.",
    "time": "Seconds to train, to make a style of three references, and to colour a view whose geometry is there.",
    "statistics": "What styles start from: statistics and regions of the whole scene, or of each view by itself.",
    "large-scale": "The same places seen from far apart (frames half a metre and 3 degrees from each other): every picture "
    "restyled alone, and the scene restyled once.",
}
_KEPT = " *Structure*: of the unstylised render, 1 = all of it."
_DISTANCE = (
    " *Style distance*: of VGG-19's relu1_1 and relu2_1 statistics in regions that the run's semantic encoder finds in both, "
    "0 = the references' own, 1 = no change."
)
_STEADY = " *Consistency*: what a style adds to the error between frames, and loses in sharpness; 0 is best."


def paper_page(document: Mapping[str, Any]) -> str:
    """Markdown. Columns that no row has are left out."""
    settings, rows = document["settings"], document["rows"]
    columns = [each for each in COLUMNS if any(row.get(each[0]) is not None for row in rows.values())]
    seeds = ", ".join(map(str, settings["trainings"]))
    styled = any("styled_psnr" in row for row in rows.values())
    how = f" *Styled*: against the truth of the palettes {', '.join(settings['palettes'])}.{_KEPT}" if styled else ""
    if settings.get("references"):
        how += f" Restyled by {', '.join(settings['references'])}.{_DISTANCE}{_KEPT}"
    how += _STEADY if any("consistency" in row for row in rows.values()) else ""
    return (
        f"# {document['table'].capitalize()}\n\n{_ABOUT[document['table']]}{how}\n\n"
        f"{settings['data']} at 1/{settings['downscale']}, {settings['method']}, {settings['steps']} steps, seeds {seeds}, "
        f"{settings['views']} held-out views. {words(document['provenance'])}.\n\n{markdown(rows, columns)}\n"
    )


def main(argv: list[str]) -> int:
    """`python -m benchmarks paper --table NAME [flags]`: the table's page is printed, and written where asked for."""
    config = parse(PaperConfig(), argv, prog="python -m benchmarks paper", description=inspect.getdoc(PaperConfig) or "")
    with Display() as display:
        document = paper(config, *load_field_method(config.method), display.count)
    document |= {"provenance": provenance(config.device), "command": origin(config.device)["command"]}
    page = paper_page(document)
    print(page)
    write_report(config, document, lambda: page)
    return 0
