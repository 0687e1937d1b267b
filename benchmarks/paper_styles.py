"""Styles of one training side by side: references, clusters, whose statistics, and the same places seen from far apart.

All are judged by a town's truth, with references of other towns, as restyling is (see `restyle`).
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import torch
from torch import Tensor

from fprf.checks import at_least, between
from fprf.datamanagers.images import load_image
from fprf.errors import DataError
from fprf.evaluation.consistency import steadiness
from fprf.evaluation.metrics import matched_regions, structure
from fprf.interfaces import SceneView
from fprf.io.images import shrink, to_uint8, write_image
from fprf.plugins.encoders.config import Vgg19Config
from fprf.plugins.stylizers.config import AdainConfig, LocalAdainConfig, RegionOtConfig, RegionToneConfig, StylizerConfig
from fprf.style.config import StyleConfig
from fprf.style.dictionary import BLEND, StyleDictionary, blend_codes
from fprf.style.files import StyleFile
from fprf.style.look import Restyle
from fprf.style.references import Encoders
from fprf.style.restyle import apply_style
from fprf.style.scene import scene_style
from fprf.style.statistics import covariance, group_moments, moments
from fprf.training.loading import Trained
from fprf.training.views import cache_view

from .common import ReportConfig
from .restyle import Shown, dictionary_of, in_scene, nothing, one_by_one
from .single_image import encoded
from .style_runs import PLAIN, Exhibit, judge_exhibit
from .town_truth import (
    Reference,
    Row,
    Stage,
    code_classes,
    match_rates,
    mean_rows,
    photograph,
    places,
    score,
    set_stage,
    town_settings,
    true_views,
    winners,
)


@dataclass(frozen=True, kw_only=True)
class PaperConfig(ReportConfig):
    """A table of the paper, from short trainings of one scene: the method as it is, and with one thing changed."""

    table: Literal[
        "reconstruction", "ablation", "guided-filter", "time", "multi-reference", "clusters", "statistics", "large-scale"
    ] = "reconstruction"
    """Which."""
    run: Path | None = None
    """Run folder of a town, for the tables that train nothing but one scene; none = that one is trained first."""
    data: Path = Path("town")
    """Scene folder; the embedded town is also restyled, and judged by its truth."""
    references: tuple[Path, ...] = ()
    """Photographs that another scene is restyled by, judged by structure and by VGG-19's statistics; none = not restyled."""
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


CELL = 8
"""Pixels across a cell: the stride of the bundled semantic encoder."""


def cells(height: int, width: int) -> Annotated[Tensor, "N"]:
    """Number of the cell that each pixel lies in, row by row, int64; what is left at the border joins the last whole cell."""
    rows, columns = (
        torch.arange(side).div(CELL, rounding_mode="floor").clamp_max(max(side // CELL, 1) - 1) for side in (height, width)
    )
    return (rows[:, None] * max(width // CELL, 1) + columns).flatten()


@torch.no_grad()
def cell_dictionary(
    images: Mapping[str, Annotated[Tensor, "H W 3"]], trained: Trained, encoders: Encoders, blend: float = BLEND
) -> StyleDictionary:
    """Of photographs by name: a code for every cell, with the statistics of its pixels. Raises DataError without semantics."""
    if encoders.semantic is None or encoders.basis is None:
        raise DataError("style cells: the scene has no semantics; train it with a semantic encoder")
    guided = trained.config.datamanager.guided
    parts = []
    for image in (each.to(encoders.device) for each in images.values()):
        label = cells(*image.shape[:2]).to(image.device)
        member = torch.nn.functional.one_hot(label).double()
        content, colour = encoded(image, encoders.content, guided), image.reshape(-1, 3)
        semantic = encoded(image, encoders.semantic, guided, encoders.basis)
        keys, _, share = group_moments(semantic, member)
        found = []
        for values in (content, colour):
            mean, spread, _ = group_moments(values, member)
            whole = moments(values, values.new_ones(len(values)))
            at = mean.new_full((len(mean),), blend)
            found += [x.float() for x in blend_codes(mean, spread, whole.mean, covariance(whole), at)]
        parts.append((keys.float(), share.float(), *found))
    keys, share, mean, spread, tint, tint_spread = (torch.cat(part).cpu() for part in zip(*parts, strict=True))
    count = torch.tensor([len(part[0]) for part in parts])
    return StyleDictionary(
        keys=keys,
        mean=mean,
        covariance=spread,
        share=share,
        reference=torch.arange(len(parts)).repeat_interleave(count),
        weight=torch.ones(len(keys)),
        names=tuple(images),
        blend=blend,
        colour_mean=tint,
        colour_covariance=tint_spread,
    )


SEEDS = (7, 11, 13)
"""Towns of the references."""
_FRAMES = 8
"""Of the path, where consistency is asked for: enough for a pair seven apart."""
_STRIDE = 4.0
"""Longer steps of the path in which places are seen from far apart."""
_REGIONS = 6
"""Regions that views and photographs are compared in, where nobody knows the true ones."""
_SIDE = 11
"""Smaller pictures have no structure that could be judged."""

Settings = Mapping[str, StylizerConfig]
_KINDS: Settings = {"adain": AdainConfig(), "local-adain": LocalAdainConfig(), "region-tone": RegionToneConfig()}


class Bench(NamedTuple):
    """One training, what it is judged by, and the settings of styles."""

    trained: Trained
    encoders: Encoders
    stage: Stage
    config: PaperConfig
    folder: Path
    """Takes the references' files."""


class Case(NamedTuple):
    """References in one palette."""

    light: str
    shown: list[Reference]
    paths: list[Path]
    dictionary: StyleDictionary
    seconds: float


Restyled = Callable[[Case], Shown]


def set_up(trained: Trained, encoders: Encoders, config: PaperConfig, folder: Path, *, path: bool = False) -> Bench:
    """Views at the size of the training, and a path where it is asked for (with long steps, for the table about those)."""
    side = int(trained.known.cameras.size.amax())
    stride = _STRIDE if config.table == "large-scale" else 1.0
    stage = set_stage(
        trained,
        trained.known,
        town_settings(trained.config),
        views=config.views,
        frames=_FRAMES if path else 0,
        longest=side,
        stride=stride,
    )
    return Bench(trained, encoders, stage, config, folder)


def style_rows(bench: Bench) -> dict[str, Row]:
    """The rows of a table of ONE_TRAINING."""
    return ONE_TRAINING[bench.config.table](bench)


def restyled(bench: Bench, stylizer: StylizerConfig, references: str = "three", clusters: int | None = None) -> Row:
    """Figures of a style, means over the palettes; `clusters` None = the usual number."""
    return _row(bench, _cases(bench, references, clusters), _inside(bench, stylizer))


def styled_by_photographs(trained: Trained, encoders: Encoders, config: PaperConfig) -> Row:
    """Figures of `region-tone`, and as `paper_*` of `local-adain`, where no truth is known: how near views come to the
    photographs of `config.references` in VGG-19's relu1_1 and relu2_1, and how much of their structure they keep.
    """
    paths = config.references
    stylizers: Settings = {"": RegionToneConfig(), "paper_": LocalAdainConfig()}
    looks: dict[str, Restyle | None] = {PLAIN: None}
    for name, stylizer in stylizers.items():
        style = StyleConfig(references=paths, stylizer=stylizer, clusters=config.codes, blend=config.blend)
        looks[name] = apply_style(trained, StyleFile(style), encoders).restyle
    known, render = trained.known, trained.config.render
    views = (known.test or known.train)[: config.views]
    cached = (cache_view(trained.model, known.facts, known.cameras, view, render) for view in views)
    shown = [{name: view.restyled(look).rgb for name, look in looks.items()} for view in cached]
    plain = [pictures[PLAIN] for pictures in shown]
    side = max(plain[0].shape[:2])
    images = [torch.from_numpy(shrink(load_image(path, upright=True), side)).float() / 255 for path in paths]
    observer = encoders.semantic if encoders.semantic is not None else encoders.content
    here, there = matched_regions(observer.cpu(), plain, images, regions=_REGIONS, seed=0)
    styled = {name: [pictures[name] for pictures in shown] for name in stylizers}
    judges = {layer: Vgg19Config(layer=layer).build() for layer in ("relu1_1", "relu2_1")}
    rows = judge_exhibit(Exhibit(plain, styled, here, images, there), judges)
    return {f"{name}{key}": rows[name][key] for name in stylizers for key in ("style_distance", "structure")}


def _clusters(bench: Bench) -> dict[str, Row]:
    rows = {f"{n} clusters": restyled(bench, RegionToneConfig(), clusters=n) for n in bench.config.clusters}
    usual, cells = _cases(bench, "three", None), _cases(bench, "three", 0)
    for name, kind in (("local-adain", LocalAdainConfig()), ("region-tone", RegionToneConfig())):
        rows[f"{name}, clusters"] = _row(bench, usual, _inside(bench, kind))
        rows[f"{name}, every cell a code"] = _row(bench, cells, _inside(bench, kind))
    return rows


def _references(bench: Bench) -> dict[str, Row]:
    return {f"{name}, {count}": restyled(bench, kind, count) for count in ("one", "three") for name, kind in _KINDS.items()}


def _time(bench: Bench) -> dict[str, Row]:
    rows: dict[str, Row] = {"training": {"train_seconds": bench.trained.seconds}}
    return rows | {f"{name}, three references": restyled(bench, kind) for name, kind in _KINDS.items()}


def _statistics(bench: Bench) -> dict[str, Row]:
    cases = _cases(bench, "three", None)
    rows = {}
    for name, kind in _KINDS.items():
        rows[f"{name}, of the scene"] = _row(bench, cases, _inside(bench, kind))
        rows[f"{name}, of each view"] = _row(bench, cases, _by_view(bench, kind))
    return rows


def _large_scale(bench: Bench) -> dict[str, Row]:
    cases, plain = _cases(bench, "three", None), nothing(_views(bench))
    rows = {"no change": _row(bench, cases, lambda _: plain)}
    flat = RegionToneConfig()
    rows["2d, every picture alone"] = _row(
        bench, cases, lambda case: one_by_one(bench.trained, plain.pictures, flat, case.dictionary, bench.encoders)
    )
    for name, kind in {**_KINDS, "region-ot": RegionOtConfig()}.items():
        rows[name] = _row(bench, cases, _inside(bench, kind))
    return rows


ONE_TRAINING: Mapping[str, Callable[[Bench], dict[str, Row]]] = {
    "time": _time,
    "multi-reference": _references,
    "clusters": _clusters,
    "statistics": _statistics,
    "large-scale": _large_scale,
}
"""Tables that train nothing but one scene, by name."""


def _cases(bench: Bench, references: str, clusters: int | None) -> list[Case]:
    """In every palette; 0 clusters stands for none: every cell of the references is a code of its own."""
    trained, encoders = bench.trained, bench.encoders
    width, height = (int(v) for v in trained.known.cameras.size[0])
    found = []
    for light in bench.config.palettes:
        shown = [photograph(place, light) for place in places(SEEDS, (width, height))[references]]
        paths = [bench.folder / f"{references}-{reference.name}.png" for reference in shown]
        for path, reference in zip(paths, shown, strict=True):
            write_image(path, to_uint8(reference.image))
        start = time.perf_counter()
        if clusters == 0:
            made = cell_dictionary({path.name: r.image for path, r in zip(paths, shown, strict=True)}, trained, encoders)
        else:
            number = bench.config.codes if clusters is None else clusters
            made = dictionary_of(paths, encoders, clusters=number, blend=bench.config.blend)[0]
        found.append(Case(light, shown, paths, made, time.perf_counter() - start))
    return found


def _row(bench: Bench, cases: Sequence[Case], restyle: Restyled) -> Row:
    return mean_rows([{"": _judged(bench, case, restyle(case))} for case in cases])[""]


def _judged(bench: Bench, case: Case, found: Shown) -> Row:
    """Nearness to the truth, match rates, structure, steadiness where there is a path, seconds."""
    stage, count = bench.stage, len(bench.stage.shown)
    labels = [each.labels for each in stage.truth]
    near, _ = score(found.pictures[:count], true_views(stage, case.light), labels)
    row: Row = {f"styled_{name}": value for name, value in near.items()}
    plain = [view.restyled().rgb for view in _views(bench)]
    if min(plain[0].shape[:2]) >= _SIDE:
        kept = [structure(a, b) for a, b in zip(plain[:count], found.pictures[:count], strict=True)]
        row["structure"] = math.fsum(kept) / len(kept)
    if found.taken is not None:
        known = dict(zip((path.name for path in case.paths), case.shown, strict=True))
        classes = code_classes(case.dictionary, known, bench.encoders, bench.trained.config.datamanager.guided)
        taken = [winners(share, classes).view(like.shape) for share, like in zip(found.taken[:count], labels, strict=True)]
        row |= match_rates(taken, labels, case.shown)._asdict()
    if len(stage.path):
        depths = [each.depth for each in stage.path_truth]
        steady = steadiness(plain[count:], found.pictures[count:], depths, stage.path)
        row |= {"consistency": steady.score, "warp_short": steady.short, "warp_long": steady.long}
    return row | {"style_seconds": case.seconds + found.style_seconds, "view_seconds": found.view_seconds}


def _views(bench: Bench) -> list[SceneView]:
    return [*bench.stage.shown, *bench.stage.passed]


def _inside(bench: Bench, stylizer: StylizerConfig) -> Restyled:
    """By the scene's statistics."""
    return lambda case: in_scene(bench.trained, _views(bench), stylizer, case.dictionary, bench.encoders, case.paths)


def _by_view(bench: Bench, stylizer: StylizerConfig) -> Restyled:
    """Every view by statistics and regions of its own, of the same samples."""
    settings = bench.trained.config
    stage, scenes = bench.stage, []
    for view in [bench.trained.cached(of, i) for of in (stage.views, stage.path) for i in range(len(of))]:
        content, weight = (torch.cat(parts) for parts in zip(*((p.content, p.kept.weight) for p in view.parts), strict=True))
        seen = [part.semantic for part in view.parts if part.semantic is not None]
        semantic = torch.cat(seen) if seen else None
        scenes.append(scene_style(content, semantic, weight, None, settings.statistics.regions, settings.seed))

    def restyle(case: Case) -> Shown:
        found = [
            in_scene(bench.trained, [view], stylizer, case.dictionary, bench.encoders._replace(scene=own), case.paths)
            for view, own in zip(_views(bench), scenes, strict=True)
        ]
        taken: list[Tensor] = [share for each in found for share in each.taken or []]
        style, each_view = (math.fsum(x) / len(found) for x in zip(*(one[2:] for one in found), strict=True))
        return Shown([each.pictures[0] for each in found], taken or None, style, each_view)

    return restyle
