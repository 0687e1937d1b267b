"""Codes that pixels at the borders of things take: a town of Gaussians in the light of other towns.

    python -m benchmarks edges [--run RUN] [--runs 3] [--steps 6000] [--output JSON]

RUN are Gaussians of a town; without one `--runs` are trained first, with seeds 0, 1, ..., on 40 views of 160 x 120,
and figures are means over them. A pixel is right if the style code that it takes most of has its own true class, and
lies at a border if another class is less than three pixels away (`benchmarks/town/truth.py`).

Rows: the scene as it is; Gaussians that all have the mean features of their true class, by which of the classes they
weigh most in; and what no matching can mend at borders: pixels that less than three quarters of their own class fill
(`mixed`), and pixels of classes that are no code's (`no_code`).
"""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import torch
from torch import Tensor

from fprf.checks import at_least
from fprf.cli.parsing import load_method, parse
from fprf.errors import UsageError
from fprf.io.images import to_uint8, write_image
from fprf.ops.rasterise.rendering import lift
from fprf.plugins.stylizers.config import RegionToneConfig
from fprf.rendering.cameras import Cameras
from fprf.splats.pinholes import camera_of
from fprf.splats.scene import SplatScene
from fprf.splats.semantics import Semantics
from fprf.style.config import StyleConfig
from fprf.style.dictionary import StyleDictionary
from fprf.style.files import StyleFile
from fprf.style.restyle import apply_dictionary
from fprf.training.driver import train
from fprf.training.loading import open_run

from .common import report
from .restyle import dictionary_of
from .style_metrics import mean_scores
from .town.render import View, geometry
from .town.surface import CLASSES
from .town.truth import (
    Reference,
    Row,
    Stage,
    code_classes,
    interior,
    match_rates,
    mean_rows,
    photograph,
    places,
    set_stage,
    town_settings,
    town_view,
    true_views,
    winners,
)
from .town.write import cached_town

_SAMPLES = 4
"""Rays across and down a pixel that tell how much of it its own class fills."""
_MIN_FILLED_SHARE = 0.75
"""Pixels that their own class fills less are mixtures; by eye."""
_MIN_PURE_SHARE = 0.95
"""Weight of a Gaussian in its true class, from which on its features count in the mean of the class."""
_MIN_PURE_PIXELS = 1.0
"""Pixels that such a Gaussian fills, at least."""
FOUND = "found"
TRUE_CLASSES = "features of true classes"


@dataclass(frozen=True, kw_only=True)
class EdgesConfig:
    """A town restyled by other towns, judged by the codes that its pixels take."""

    run: Path | None = None
    """Run of Gaussians of a town; none = those that are trained, and thrown away."""
    runs: int = 3
    """Trainings, with seeds 0, 1, ..."""
    steps: int = 6000
    """Steps of each."""
    palettes: tuple[str, ...] = ("autumn", "winter", "sunset", "night")
    """Lights that are asked for."""
    seeds: tuple[int, ...] = (7, 11, 13)
    """Three other towns, which the references show."""
    views: int = 4
    """Held-out views that are judged."""
    longest: int = 120
    """Longer side of these in pixels."""
    output: Path | None = None
    """JSON file for the figures; none = only the table."""

    def __post_init__(self) -> None:
        at_least("runs", self.runs, 1)
        at_least("steps", self.steps, 1)
        at_least("palettes", len(self.palettes), 1)
        at_least("seeds", len(self.seeds), 3)
        at_least("views", self.views, 1)
        at_least("longest", self.longest, 16)


class Case(NamedTuple):
    """One palette with one set of references."""

    references: Sequence[Reference]
    paths: Sequence[Path]
    truth: Sequence[Annotated[Tensor, "H W 3"]]


class Codes(NamedTuple):
    """Style codes of a case, and the class of each."""

    dictionary: StyleDictionary
    classes: Annotated[Tensor, "T"]


def main(argv: list[str]) -> int:
    """`python -m benchmarks edges`."""
    config = parse(EdgesConfig(), argv, prog="python -m benchmarks edges", description=__doc__ or "")
    rows = []
    with tempfile.TemporaryDirectory(prefix="fprf-edges-") as made:
        folder = Path(made)
        if config.run is not None:
            rows.append(run_rows(config, config.run, folder))
        else:
            for seed in range(config.runs):
                rows.append(run_rows(config, _trained(config, folder, seed), folder))
    sets = {name: mean_rows([each[name] for each in rows]) for name in rows[0]}
    report(config.output, {"benchmark": "edges", **sets, "runs": rows})
    return 0


def _trained(config: EdgesConfig, folder: Path, seed: int) -> Path:
    """Gaussians of the town."""
    method, name = load_method("fprf-splats")
    output = folder / f"run-{seed}"
    return train(replace(method, data=cached_town(), output=output, steps=config.steps, seed=seed), name)


def run_rows(config: EdgesConfig, run: Path, folder: Path) -> dict[str, dict[str, Row]]:
    """Rows of a run by set of references."""
    loaded = open_run(run, device="cpu")
    scene = loaded.scene
    if not isinstance(scene, SplatScene):
        raise UsageError("--run: no run of Gaussians of a town; see python -m benchmarks edges --help")
    settings = town_settings(loaded.run.load_config()[0])
    stage = set_stage(scene, loaded.known, settings, views=config.views, frames=0, longest=config.longest)
    semantics = scene.found()
    true = class_semantics(scene, semantics, class_weights(scene, stage))
    mixed = [filled_share(stage, view) < _MIN_FILLED_SHARE for view in range(len(stage.views))]
    found: dict[str, dict[str, Row]] = {}
    for name, all_cases in cases(config, stage, folder).items():
        rows = []
        for case in all_cases:
            codes = codes_of(scene, case)
            row = case_row(stage, semantics, case, codes)
            oracle = case_row(stage, true, case, codes)
            rows.append({FOUND: row, TRUE_CLASSES: oracle, "limits": limits(stage, codes, mixed)})
        found[name] = mean_rows(rows)
        for method, row in found[name].items():
            words = (f"{key} {value:.3f}" for key, value in row.items() if value is not None)
            print(f"{name:6} {method:26}", "  ".join(words), flush=True)
    return found


def cases(config: EdgesConfig, stage: Stage, folder: Path) -> dict[str, list[Case]]:
    """References of `one` and `three` towns in every palette, as files, and the true views."""
    width, height = (int(side) for side in stage.scene.cameras.size[0])
    made: dict[str, list[Case]] = {}
    for light in config.palettes:
        truth = true_views(stage, light)
        for name, where in places(config.seeds, (width, height)).items():
            references = [photograph(place, light) for place in where]
            paths = [folder / f"{name}-{reference.name}.png" for reference in references]
            for path, reference in zip(paths, references, strict=True):
                write_image(path, to_uint8(reference.image))
            made.setdefault(name, []).append(Case(references, paths, truth))
    return made


def codes_of(scene: SplatScene, case: Case) -> Codes:
    """Codes of a case on a scene."""
    encoders = scene.encoders()
    dictionary, _ = dictionary_of(
        case.paths, encoders, clusters=StyleConfig.clusters, blend=StyleConfig.blend
    )
    known = {path.name: each for path, each in zip(case.paths, case.references, strict=True)}
    return Codes(dictionary, code_classes(dictionary, known, encoders, encoders.guided))


def case_row(stage: Stage, semantics: Semantics, case: Case, codes: Codes) -> Row:
    """Match rates and PSNR in dB of a scene with these semantics."""
    assert isinstance(stage.scene, SplatScene)  # by `run_rows`
    scene = replace(stage.scene, found=lambda: semantics, copied=None)
    style = StyleConfig(references=tuple(case.paths), stylizer=RegionToneConfig())
    look = apply_dictionary(scene, StyleFile(style), scene.encoders(), codes.dictionary).restyle
    views = [scene.cached(stage.views, view) for view in range(len(stage.views))]
    labels = [each.labels for each in stage.truth]
    taken = []
    for view, like in zip(views, labels, strict=True):
        taken.append(winners(view.paint(look.match), codes.classes).view(like.shape))
    pictures = [view.restyled(look).rgb for view in views]
    rates = match_rates(taken, labels, case.references)._asdict()
    return {**rates, "psnr": mean_scores(pictures, case.truth)[0]["psnr"]}


def class_weights(scene: SplatScene, stage: Stage) -> Annotated[Tensor, "N classes"]:
    """Pixels of each true class that each Gaussian fills in the scene's views."""
    weights = torch.zeros(len(scene.gaussians), len(CLASSES))
    for view in range(len(scene.views)):
        labels = geometry(stage.town, town_view(scene.views, view))[1]
        shown = torch.nn.functional.one_hot(torch.from_numpy(labels.astype(np.int64)), len(CLASSES)).float()
        weights += _lifted(scene, scene.views, view, shown)
    return weights


def _lifted(
    scene: SplatScene, cameras: Cameras, view: int, values: Annotated[Tensor, "H W C"]
) -> Annotated[Tensor, "N C"]:
    gaussians = scene.gaussians
    shape = (gaussians.means, gaussians.quaternions, gaussians.log_scales, gaussians.logits)
    return lift(*shape, camera_of(cameras, view, scene.near), values, antialiased=scene.antialiased)


def class_semantics(
    scene: SplatScene, semantics: Semantics, weights: Annotated[Tensor, "N classes"]
) -> Semantics:
    """Semantics in which all Gaussians of a class have the mean of those that are of it alone."""
    own = weights.argmax(1)
    pure = (weights.amax(1) > _MIN_PURE_SHARE * weights.sum(1)) & (weights.sum(1) > _MIN_PURE_PIXELS)
    features = semantics.features.float()
    mean = features.mean(0).repeat(len(CLASSES), 1)
    for kind in set(own[pure].tolist()):
        mean[kind] = features[pure & (own == kind)].mean(0)
    return semantics._replace(features=mean[own].half())


def filled_share(stage: Stage, view: int) -> Annotated[Tensor, "H W"]:
    """Share of each pixel of a judged view that its own class fills."""
    own = stage.truth[view].labels
    seen = town_view(stage.views, view)
    fine = View(seen.pose, seen.focal * _SAMPLES, seen.width * _SAMPLES, seen.height * _SAMPLES)
    labels = torch.from_numpy(geometry(stage.town, fine)[1].astype(np.int64))
    cells = labels.view(seen.height, _SAMPLES, seen.width, _SAMPLES).permute(0, 2, 1, 3).flatten(2)
    return (cells == own[..., None]).double().mean(2)


def limits(stage: Stage, codes: Codes, mixed: Sequence[Annotated[Tensor, "H W"]]) -> Row:
    """Shares of the pixels at borders that are mixtures, and that are of classes without a code."""
    labels = [each.labels for each in stage.truth]
    border = torch.cat([~interior(each).flatten() for each in labels])
    coded = torch.cat([torch.isin(each, codes.classes).flatten() for each in labels])
    blended = torch.cat([each.flatten() for each in mixed])
    return {
        "border": float(border.double().mean()),
        "mixed": float(blended[border].double().mean()),
        "no_code": float((~coded)[border].double().mean()),
    }
