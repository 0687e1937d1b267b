"""A table of the paper, from short trainings of one scene: the method as it is, and with one thing changed.

    python -m benchmarks paper --table ablation|guided-filter|clusters [--data SCENE --references A.jpg ...] [any field]

A town is restyled by other towns and judged by its truth; another scene by photographs, judged by what is
left of its structure and by VGG-19's relu1_1 and relu2_1 statistics, in regions that the run's semantic
encoder finds in both. One reference and three, pictures alone and seconds are rows of `restyle`.
"""

import math
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import torch
from torch import Tensor, nn

from fprf.checks import at_least, between
from fprf.cli.parsing import parse
from fprf.config import TrainConfig
from fprf.datamanagers.images import load_image
from fprf.evaluation.metrics import image_metrics, mean_metrics
from fprf.interfaces import Decoder
from fprf.io.atomic import write_json
from fprf.io.images import shrink, to_uint8, write_image
from fprf.plugins.decoders.config import DecoderConfig, MlpDecoderConfig
from fprf.plugins.encoders.config import Vgg19Config
from fprf.plugins.stylizers.config import LocalAdainConfig, RegionToneConfig, StylizerConfig
from fprf.progress import Display, Report
from fprf.style.config import StyleConfig
from fprf.style.dictionary import Encoders
from fprf.style.files import StyleFile
from fprf.style.look import Restyle
from fprf.style.restyle import apply_style
from fprf.style.scene_style import to_tensors
from fprf.training.driver import learn, schedule_of
from fprf.training.field_learner import FieldLearner
from fprf.training.field_scene import Trained
from fprf.training.field_setup import prepare
from fprf.training.prepare import device_of, read_scene
from fprf.training.run import Run
from fprf.training.style_pass import measure_style
from fprf.training.views import cache_view, render_view

from .common import Progress, console, field_method, origin
from .report import Column, printed
from .restyle import PLAIN, dictionary_of, in_scene
from .style_metrics import matched_regions, structure
from .styles import Exhibit, judge_exhibit
from .town.truth import (
    Row,
    code_classes,
    match_rates,
    mean_rows,
    photograph,
    places,
    score,
    set_stage,
    town_folder,
    town_settings,
    true_views,
    winners,
)
from .town.write import scene_folder


@dataclass(frozen=True, kw_only=True)
class PaperConfig:
    """A table of the paper, from short trainings of one scene: the method as it is, and with one thing
    changed.
    """

    table: Literal["ablation", "guided-filter", "clusters"] = "ablation"
    """Name of the method."""
    data: Path = Path("town")
    """Scene folder; the town is also restyled, and judged by its truth."""
    references: tuple[Path, ...] = ()
    """Photographs that another scene is restyled by; none = not restyled."""
    downscale: int = 1
    """Images at 1/downscale of their size."""
    method: str = "fprf-lite"
    """Method that is changed: its name, or the config.json of a run."""
    steps: int = 400
    """Steps of each training."""
    trainings: tuple[int, ...] = (0,)
    """Seeds: every row is the mean over trainings with these."""
    views: int = 4
    """Held-out views that are judged."""
    palettes: tuple[str, ...] = ("autumn", "night")
    """Lights that a town is restyled in, with three references."""
    clusters: tuple[int, ...] = (1, 2, 5, 10, 20, 50)
    """Style codes per reference, of the table of that name."""
    codes: int = StyleConfig.clusters
    """Style codes per reference, of all others."""
    blend: float = StyleConfig.blend
    """Share of the overall style in each local one, in [0, 1]."""
    output: Path | None = None
    """JSON file for the figures; none = only the table."""
    device: str = "auto"
    """cpu, cuda, mps, or auto."""

    def __post_init__(self) -> None:
        at_least("downscale", self.downscale, 1)
        at_least("steps", self.steps, 1)
        at_least("trainings", len(self.trainings), 1)
        at_least("views", self.views, 1)
        at_least("palettes", len(self.palettes), 1)
        at_least("codes", self.codes, 1)
        between("blend", self.blend, 0.0, 1.0)
        for value in self.clusters:
            at_least("clusters", value, 1)


@dataclass(frozen=True, kw_only=True)
class SceneDecoderConfig(DecoderConfig):
    """A network of the shipped decoder's size, trained with the scene."""

    def build(self, *, encoder: str, channels: int, seed: int = 0) -> Decoder:
        """As large as the shipped decoder of that encoder; starts from the seed."""
        shipped = MlpDecoderConfig().build(encoder=encoder, channels=channels)
        hidden = next(shipped.parameters()).shape[0]
        return SceneDecoder(channels, hidden, torch.Generator().manual_seed(seed))


class SceneDecoder(Decoder):
    """rgb = sigmoid(W2 relu(W1 f + b1) + b2), every weight the scene's own; grey before it is trained.

    Weights are kept times the root of their fan-in, since Adam moves each by the learning rate, whatever its
    size.
    """

    def __init__(self, channels: int, hidden: int, generator: torch.Generator) -> None:
        super().__init__()
        bound = 6**0.5
        self.first = nn.Parameter(torch.empty(hidden, channels).uniform_(-bound, bound, generator=generator))
        self.first_bias = nn.Parameter(torch.zeros(hidden))
        self.second = nn.Parameter(torch.zeros(3, hidden))
        self.second_bias = nn.Parameter(torch.zeros(3))

    def forward(self, content: Annotated[Tensor, "N C"]) -> Annotated[Tensor, "N 3"]:
        """sRGB in [0, 1]."""
        first, second = (weight / weight.shape[1] ** 0.5 for weight in (self.first, self.second))
        hidden = torch.relu(content @ first.T + self.first_bias)
        return torch.sigmoid(hidden @ second.T + self.second_bias)


def _scene_decoder(config: TrainConfig) -> TrainConfig:
    return replace(config, content=replace(config.content, decoder=SceneDecoderConfig()))


def _no_content_loss(config: TrainConfig) -> TrainConfig:
    return replace(config, loss=replace(config.loss, content=0.0))


def _no_guide(config: TrainConfig) -> TrainConfig:
    """Features between cells are interpolated, the picture does not guide them."""
    manager = config.datamanager
    return replace(config, datamanager=replace(manager, guided=replace(manager.guided, radius=0.0)))


TRAINED: Mapping[str, Mapping[str, Callable[[TrainConfig], TrainConfig]]] = {
    "ablation": {
        "as it is": lambda config: config,
        "without content loss": _no_content_loss,
        "without pre-trained decoder": _scene_decoder,
        "without either": lambda config: _scene_decoder(_no_content_loss(config)),
    },
    "guided-filter": {"with guided filter": lambda config: config, "without": _no_guide},
    "clusters": {"": lambda config: config},
}
"""By table: what each of its rows changes in the training."""
SEEDS = (7, 11, 13)
"""Towns of the references."""
_REGIONS = 6
"""Regions that views and photographs are compared in, where nobody knows the true ones."""
_SIDE = 11
"""Smaller pictures have no structure that could be judged."""


class Short(NamedTuple):
    """A training, in memory."""

    trained: Trained
    encoders: Encoders


def short_training(config: TrainConfig, folder: Path, progress: Progress) -> Short:
    """Prepare, train and measure the scene's style, without a run folder that others could read."""
    prepared = prepare(config, read_scene(config))
    run = Run(folder)
    run.root.mkdir(parents=True)
    assert config.data is not None
    run.save_known(prepared.scene, config.data, prepared.facts)
    start = time.perf_counter()

    def report(event: Report) -> None:
        progress(event.step, config.steps, "training")

    learner = FieldLearner(config, prepared, device_of(config.device))
    learn(learner, run, schedule_of(config, len(prepared.scene.train)), report)
    model = learner.model.requires_grad_(False).eval()
    seconds = time.perf_counter() - start
    run.save_tensors(
        "style", to_tensors(measure_style(config, model, prepared.scene.cameras, prepared.scene.train))
    )
    if prepared.basis is not None:
        run.save_tensors("basis", prepared.basis.tensors())
    trained = Trained(run, config, "", run.load_known(), model, config.steps, seconds)
    return Short(trained, trained.encoders())


def held_out(trained: Trained, views: int) -> Row:
    """PSNR, SSIM and LPIPS of held-out views against their photographs."""
    known = trained.known
    config = trained.config
    scene = read_scene(config)
    found = []
    for view in (known.test or known.train)[:views]:
        render = render_view(trained.model, known.facts, known.cameras, view, config.render).rgb
        size = (render.shape[1], render.shape[0])
        truth = torch.from_numpy(load_image(scene.paths[view], size, known.facts.background)).float() / 255
        found.append(image_metrics(render, truth))
    return dict(mean_metrics(found))


def by_truth(short: Short, config: PaperConfig, folder: Path, stylizer: StylizerConfig, clusters: int) -> Row:
    """Figures of a style from three other towns, means over the palettes: nearness to the truth, match rates,
    structure.
    """
    trained, encoders = short
    folder.mkdir(exist_ok=True)
    side = int(trained.known.cameras.size.amax())
    stage = set_stage(
        trained, trained.known, town_settings(trained.config), views=config.views, frames=0, longest=side
    )
    width, height = (int(v) for v in trained.known.cameras.size[0])
    labels = [each.labels for each in stage.truth]
    plain = [view.restyled().rgb for view in stage.shown]
    rows = []
    for light in config.palettes:
        shown = [photograph(place, light) for place in places(SEEDS, (width, height))["three"]]
        paths = [folder / f"{reference.name}.png" for reference in shown]
        for path, reference in zip(paths, shown, strict=True):
            write_image(path, to_uint8(reference.image))
        dictionary, seconds = dictionary_of(paths, encoders, clusters=clusters, blend=config.blend)
        found = in_scene(trained, stage.shown, stylizer, dictionary, encoders, paths)
        near, _ = score(found.pictures, true_views(stage, light), labels)
        row: Row = {f"styled_{name}": value for name, value in near.items()}
        if min(plain[0].shape[:2]) >= _SIDE:
            kept = [structure(a, b) for a, b in zip(plain, found.pictures, strict=True)]
            row["structure"] = math.fsum(kept) / len(kept)
        if found.taken is not None:
            known = dict(zip((path.name for path in paths), shown, strict=True))
            classes = code_classes(dictionary, known, encoders, trained.config.datamanager.guided)
            taken = [
                winners(share, classes).view(like.shape)
                for share, like in zip(found.taken, labels, strict=True)
            ]
            row |= match_rates(taken, labels, shown)._asdict()
        rows.append(
            {"": row | {"style_seconds": seconds + found.style_seconds, "view_seconds": found.view_seconds}}
        )
    return mean_rows(rows)[""]


def by_photographs(
    short: Short, config: PaperConfig, stylizers: Mapping[str, StylizerConfig], clusters: int
) -> Row:
    """Figures of each stylizer, its name before their keys: distance to the photographs' style, and the
    structure kept.
    """
    trained, encoders = short
    looks: dict[str, Restyle | None] = {PLAIN: None}
    for name, stylizer in stylizers.items():
        style = StyleConfig(
            references=config.references, stylizer=stylizer, clusters=clusters, blend=config.blend
        )
        looks[name] = apply_style(trained, StyleFile(style), encoders).restyle
    known = trained.known
    render = trained.config.render
    views = (known.test or known.train)[: config.views]
    cached = (cache_view(trained.model, known.facts, known.cameras, view, render) for view in views)
    shown = [{name: view.restyled(look).rgb for name, look in looks.items()} for view in cached]
    plain = [pictures[PLAIN] for pictures in shown]
    side = max(plain[0].shape[:2])
    images = [
        torch.from_numpy(shrink(load_image(path, upright=True), side)).float() / 255
        for path in config.references
    ]
    observer = encoders.semantic if encoders.semantic is not None else encoders.content
    here, there = matched_regions(observer.cpu(), plain, images, regions=_REGIONS, seed=0)
    styled = {name: [pictures[name] for pictures in shown] for name in stylizers}
    judges = {layer: Vgg19Config(layer=layer).build() for layer in ("relu1_1", "relu2_1")}
    rows = judge_exhibit(Exhibit(plain, styled, here, images, there), judges)
    return {f"{name}{key}": rows[name][key] for name in stylizers for key in ("style_distance", "structure")}


def styled(short: Short, config: PaperConfig, folder: Path, clusters: int) -> Row:
    """The recommended stylizer on a training, and as `paper_*` the paper's own, which has nothing but
    features.
    """
    if town_folder(short.trained.config) is None:
        stylizers: Mapping[str, StylizerConfig] = {"": RegionToneConfig(), "paper_": LocalAdainConfig()}
        return by_photographs(short, config, stylizers, clusters) if config.references else {}
    paper = by_truth(short, config, folder, LocalAdainConfig(), clusters)
    shown = {
        f"paper_{key}": paper[key] for key in ("styled_psnr", "styled_delta_e", "structure") if key in paper
    }
    return by_truth(short, config, folder, RegionToneConfig(), clusters) | shown


def rows_of(
    config: PaperConfig, base: TrainConfig, folder: Path, progress: Progress
) -> Iterator[tuple[str, Row]]:
    """The rows of the table, from trainings with one seed."""
    for k, (name, change) in enumerate(TRAINED[config.table].items()):
        short = short_training(change(base), folder / f"run-{k}", progress)
        row = held_out(short.trained, config.views) | {"train_seconds": short.trained.seconds}
        if config.table == "clusters":
            for count in config.clusters:
                yield f"{count} clusters", row | styled(short, config, folder / f"references-{k}", count)
        else:
            yield name, row | styled(short, config, folder / f"references-{k}", config.codes)


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
    ("train_seconds", "training s", ".1f"),
    ("style_seconds", "style s", ".2f"),
    ("view_seconds", "view s", ".3f"),
)


def main(argv: list[str]) -> int:
    """`python -m benchmarks paper --table NAME [flags]`."""
    config = parse(PaperConfig(), argv, prog="python -m benchmarks paper", description=__doc__ or "")
    method, name = field_method(config.method)
    base = replace(method, data=scene_folder(config.data), downscale=config.downscale, device=config.device)
    base = replace(base, steps=config.steps, minutes=None, output=None)
    tables = []
    with Display() as display, tempfile.TemporaryDirectory(prefix="fprf-paper-") as made:
        for seed in config.trainings:
            tables.append(
                dict(rows_of(config, replace(base, seed=seed), Path(made) / str(seed), display.count))
            )
    document: dict[str, Any] = {
        "benchmark": "paper",
        "table": config.table,
        "settings": {
            "data": config.data.name,
            "method": name,
            "references": [path.stem for path in config.references],
            "steps": config.steps,
            "trainings": list(config.trainings),
            "views": config.views,
            "palettes": list(config.palettes),
            "downscale": config.downscale,
            "codes": config.codes,
            "blend": config.blend,
        },
        "rows": mean_rows(tables),
        **origin(config.device),
    }
    columns = [
        each for each in COLUMNS if any(row.get(each[0]) is not None for row in document["rows"].values())
    ]
    console().print(
        printed(
            f"{config.table}, {name} on {config.data.name}, {config.steps} steps", document["rows"], columns
        )
    )
    if config.output is not None:
        write_json(config.output, document)
    return 0
