"""Restyling side by side: every stylizer, and transfers of colour alone, on painted photographs and on
trained runs.

    python -m benchmarks styles [RUN ...] [--shared DIR] [--sheets DIR] [--output JSON] [any field]

structure, ssim: kept of the unstylised picture, 1 = all of it. gradient_kept, range_kept: contrast inside of
regions (mean gradient; from the 1 % to the 99 % quantile of luma), where the references have as much.
style_distance: to the references, region by region, 1 = no change, in the eyes of VGG-19, which no shipped
part of the product uses. consistency: warp error between neighbouring views. false_edges: share of the pairs
of pixels on one even surface that the style moves apart.

Without the triplets of --shared and without runs, a short training of the town is restyled. Of a town the
references are other towns, and the regions are the true classes; of other scenes the references are the
photographs that suit them, and the regions are those that a semantic encoder finds in both. Sheets show other
people's photographs: they are written only where asked for.
"""

import json
import math
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from fprf.checks import at_least
from fprf.cli.parsing import parse
from fprf.datamanagers.basis import fit_basis
from fprf.datamanagers.images import load_image
from fprf.errors import DataError
from fprf.evaluation.metrics import WarpError, ssim
from fprf.interfaces import Decoder, Encoder
from fprf.io.images import shrink, to_uint8, write_image
from fprf.ops.config import GuidedConfig
from fprf.plugins.decoders.config import MlpDecoderConfig
from fprf.plugins.encoders.config import (
    SEMANTICS,
    BundledContentConfig,
    EncoderConfig,
    RandomConfig,
    Vgg19Config,
)
from fprf.style.config import StyleConfig
from fprf.style.dictionary import Reference as Samples
from fprf.style.dictionary import build_dictionary
from fprf.style.files import StyleFile
from fprf.style.light import luma
from fprf.style.look import Restyle
from fprf.style.restyle import apply_style
from fprf.training.field_scene import Trained, load_run
from fprf.training.views import cache_view

from .common import SHARED, console, report, train_run
from .report import Column, contact_sheet, printed
from .restyle import PLAIN, STYLIZERS, transfers
from .semantic_matching import COLOURS, Triplet, read_triplets, triplet_names
from .single_image import encoded, flat_look, flat_scene, render_flat
from .style_metrics import contrast_kept, matched_regions, region_contrasts, structure, style_distances
from .town.render import walk
from .town.truth import Place, Row, mean_rows, photograph
from .town.write import is_town, read_truth


@dataclass(frozen=True, kw_only=True)
class StylesConfig:
    """Comparison: scenes, styles, methods and judges."""

    runs: tuple[Path, ...] = ()
    """Trained runs."""
    shared: Path = SHARED
    """Folder with data/pst, data/styles, data/pairings.json and weights; what is absent is skipped."""
    content: EncoderConfig = BundledContentConfig()
    """Content encoder of the photographs (runs bring their own); its decoder must ship."""
    semantic: EncoderConfig = SEMANTICS
    """Semantic encoder of the photographs, and who finds the regions of runs."""
    triplets: int = 40
    """Triplets, at most, evenly spread; 0 = runs alone."""
    views: int = 4
    """Neighbouring views of each run."""
    longest: int = 256
    """Longer side of photographs and views."""
    full: bool = False
    """Also compare whole covariances; several times as slow."""
    steps: int = 300
    """Steps of the town that is trained where there are neither triplets nor runs."""
    sheets: Path | None = None
    """Folder for contact sheets; none = none."""
    output: Path | None = None
    """JSON file for the figures; none = only the tables."""

    def __post_init__(self) -> None:
        at_least("triplets", self.triplets, 0)
        at_least("views", self.views, 1)
        at_least("longest", self.longest, 64)


class Exhibit(NamedTuple):
    """Case that methods are judged by: one scene in one style. Lists of views run in parallel."""

    plain: Sequence[Annotated[Tensor, "H W 3"]]
    styled: Mapping[str, Sequence[Annotated[Tensor, "H W 3"]]]
    regions: Sequence[Annotated[Tensor, "h w"]]
    """Region ids of the views, at any resolution."""
    references: Sequence[Annotated[Tensor, "G F 3"]]
    reference_regions: Sequence[Annotated[Tensor, "g f"]]


def judge_exhibit(exhibit: Exhibit, judges: Mapping[str, Encoder], *, full: bool = False) -> dict[str, Row]:
    """By method: `structure`, `ssim` and `false_edges` (means over the views), `contrast_kept`, and
    `style_distance`, also by judge and, with `full`, of whole covariances.

    Raises DataError where the lists of views differ in length.
    """
    lengths = {len(exhibit.plain), len(exhibit.regions), *(len(views) for views in exhibit.styled.values())}
    if len(lengths) != 1 or len(exhibit.references) != len(exhibit.reference_regions):
        raise DataError("contest: every method needs a picture of each view, and every picture its regions")
    plain = list(zip(exhibit.plain, exhibit.regions, strict=True))
    styled = {name: list(zip(views, exhibit.regions, strict=True)) for name, views in exhibit.styled.items()}
    style = list(zip(exhibit.references, exhibit.reference_regions, strict=True))
    kinds = {"style_distance": False, "full_distance": True} if full else {"style_distance": False}
    distances = {
        name: style_distances(judges, plain, styled, style, full=exact) for name, exact in kinds.items()
    }
    rows: dict[str, Row] = {}
    contrasts = region_contrasts(plain), region_contrasts(style)
    for name, views in exhibit.styled.items():
        pairs = list(zip(exhibit.plain, views, strict=True))
        row: Row = {
            "structure": math.fsum(structure(a, b) for a, b in pairs) / len(pairs),
            "ssim": math.fsum(_luminance_ssim(a, b) for a, b in pairs) / len(pairs),
            "false_edges": math.fsum(false_edges(a, b) or 0.0 for a, b in pairs) / len(pairs),
            **contrast_kept(contrasts[0], region_contrasts(styled[name]), contrasts[1]),
        }
        for kind, found in distances.items():
            row[kind] = found[name].pop("mean")
            row |= {f"{kind}_{judge}": value for judge, value in found[name].items()}
        rows[name] = row
    return rows


def _luminance_ssim(a: Annotated[Tensor, "H W 3"], b: Annotated[Tensor, "H W 3"]) -> float:
    """SSIM of the luminances, in [-1, 1]."""
    grey = [luma(image.reshape(-1, 3)).reshape(*image.shape[:2], 1).expand(-1, -1, 3) for image in (a, b)]
    return ssim(*grey)


_SIGMA = 1.0
"""Pixels that both pictures are blurred by: noise is no edge."""
_REACH = 12
"""Ends of a pair lie so many-th of the shorter side apart: further than a soft border between regions is
wide.
"""
_EVEN = 0.05
_CUT = 0.1
"""Largest differences of a channel in [0, 1]: thirteen and twenty-six 8-bit steps."""


def false_edges(plain: Annotated[Tensor, "H W 3"], styled: Annotated[Tensor, "H W 3"]) -> float | None:
    """Share of the pairs on one surface, along rows and columns, that the style cuts, in [0, 1]; None where
    there are none.

    Raises DataError for pictures of different sizes, or smaller than 12 pixels.
    """
    if plain.shape != styled.shape or plain.ndim != 3 or min(plain.shape[:2]) < _REACH:
        raise DataError(
            f"false edges: pictures of shape {tuple(plain.shape)} and {tuple(styled.shape)}; both must be [H W 3] of one size, "
            f"with sides of at least {_REACH} pixels"
        )
    reach = max(2, round(min(plain.shape[:2]) / _REACH))
    at = torch.arange(-3, 4, dtype=torch.float32)
    kernel = torch.exp(-at.square() / (2 * _SIGMA**2))
    kernel = kernel / kernel.sum()
    blurred = []
    for picture in (plain, styled):
        padded = F.pad(
            picture.detach().cpu().float().permute(2, 0, 1)[:, None], (3, 3, 3, 3), mode="replicate"
        )
        blurred.append(F.conv2d(F.conv2d(padded, kernel.view(1, 1, 1, -1)), kernel.view(1, 1, -1, 1))[:, 0])
    pairs = cuts = 0
    for axis in (1, 2):
        a, b = (each.movedim(axis, 0) for each in blurred)
        starts = len(a) - reach
        way = torch.stack([(a[i : i + starts] - a[:starts]).abs().amax(1) for i in range(1, reach + 1)])
        surface = way.amax(0) < _EVEN
        pairs += int(surface.sum())
        cuts += int((surface & ((b[reach:] - b[:starts]).abs().amax(1) > _CUT)).sum())
    return cuts / pairs if pairs else None


def judges_of(shared: Path) -> dict[str, Encoder]:
    """VGG-19 where its weights are; untrained convolutions, which see colours and grain, elsewhere."""
    weights = shared / "weights/vgg19_imagenet.safetensors"
    if weights.is_file():
        return {
            layer: Vgg19Config(layer=layer, weights=weights).build()
            for layer in ("relu1_1", "relu2_1", "relu3_1")
        }
    return {f"random stride {n}": RandomConfig(channels=64, stride=n).build() for n in (1, 2, 4)}


DIM = 32
REGIONS = 16
CLUSTERS = 20
"""Of `fprf-lite`: semantic components, regions of a scene, codes of a reference."""
SOURCES = ("painted", "encoder")


def painted(regions: Annotated[Tensor, "H W"], kinds: int, size: tuple[int, int]) -> Annotated[Tensor, "N D"]:
    """One channel a region, 1 where a pixel of a picture of `size` (height, width) lies in it: the nearest
    painted one.
    """
    near = F.interpolate(regions[None, None].double(), size, mode="nearest-exact")[0, 0].long()
    return F.one_hot(near.flatten(), kinds).float()


def flat_reference(
    name: str,
    content: Annotated[Tensor, "N C"],
    semantic: Annotated[Tensor, "N D"] | None,
    colour: Annotated[Tensor, "N 3"] | None = None,
    *,
    samples: int = 20_000,
) -> Samples:
    """A photograph's features, and its colours, as a reference; about `samples` pixels of it, in even
    steps.
    """
    some = slice(0, None, max(1, len(content) // samples))
    parts = content.new_zeros(len(content[some]), 0) if semantic is None else semantic[some]
    return Samples(name, content[some], parts, colour=None if colour is None else colour[some])


def restyled(
    triplet: Triplet, content: Encoder, semantic: Encoder, decoder: Decoder, source: str
) -> dict[str, Tensor]:
    """The content photograph by every stylizer, its parts told apart by the painted regions or by the
    encoder.
    """
    guided = GuidedConfig()
    size = (triplet.content.shape[0], triplet.content.shape[1])
    pair = (triplet.content, triplet.style)
    here, there = (encoded(image, content, guided) for image in pair)
    if source == "painted":
        kinds = len(COLOURS)
        where = painted(triplet.content_regions, kinds, size)
        where_there = painted(triplet.style_regions, kinds, (triplet.style.shape[0], triplet.style.shape[1]))
    else:  # the principal components that a scene would fit on its training views
        with torch.no_grad():
            maps: Tensor = semantic(triplet.content.permute(2, 0, 1)[None])[0].float()
        basis = fit_basis(maps.flatten(1).T, DIM)
        where, where_there = (encoded(image, semantic, guided, basis) for image in pair)
    flat = flat_scene(here, where, size, regions=len(COLOURS) if source == "painted" else REGIONS)
    samples = flat_reference("style", there, where_there, triplet.style.reshape(-1, 3))
    dictionary = build_dictionary([samples], clusters=len(COLOURS) if source == "painted" else CLUSTERS)
    return {
        name: render_flat(flat, flat_look(flat, dictionary, config, decoder), decoder)
        for name, config in STYLIZERS.items()
    }


def triplets(config: StylesConfig, judges: Mapping[str, Encoder]) -> dict[str, object]:
    """Figures of every stylizer on painted photographs, by the source of the regions; empty where there are
    none.
    """
    folder = config.shared / "data/pst"
    if not config.triplets or not folder.is_dir():
        return {}
    content = config.content.build()
    semantic = config.semantic.build()
    decoder = MlpDecoderConfig().build(encoder=content.identity, channels=content.channels)
    names = triplet_names(folder)
    kept = min(config.triplets, len(names))
    found: dict[str, dict[str, dict[str, Row]]] = {source: {} for source in SOURCES}
    shown: dict[str, dict[str, Tensor]] = {}
    for name in (names[i * len(names) // kept] for i in range(kept)):
        (triplet,) = read_triplets(folder, names=[name], size=None)
        photos = [
            torch.from_numpy(shrink(load_image(folder / side / f"{name}.jpg"), config.longest)).float() / 255
            for side in ("content", "style")
        ]
        triplet = triplet._replace(content=photos[0], style=photos[1])
        common = {PLAIN: triplet.content}
        common |= {k: v.pictures[0] for k, v in transfers([triplet.content], [triplet.style]).items()}
        theirs = folder / "dpst_result" / f"{name}.jpg"
        if theirs.is_file():  # what the paper of the triplets made of it
            image = (
                torch.from_numpy(
                    load_image(theirs, (triplet.content.shape[1], triplet.content.shape[0]))
                ).float()
                / 255
            )
            common["luan et al."] = image
        made = {source: restyled(triplet, content, semantic, decoder, source) for source in SOURCES}
        every = {
            **common,
            **{f"{source}/{k}": image for source in SOURCES for k, image in made[source].items()},
        }
        exhibit = Exhibit(
            plain=[triplet.content],
            styled={k: [image] for k, image in every.items()},
            regions=[triplet.content_regions],
            references=[triplet.style],
            reference_regions=[triplet.style_regions],
        )
        rows = judge_exhibit(exhibit, judges, full=config.full)
        for source in SOURCES:
            found[source][name] = {k: rows[k] for k in common} | {
                k: rows[f"{source}/{k}"] for k in made[source]
            }
        shown[name] = {"style": triplet.style, **every}
    if config.sheets is not None:
        write_sheet(config.sheets / "triplets.jpg", shown)
    result: dict[str, object] = {"content": content.identity, "semantic": semantic.identity}
    for source, cases in found.items():
        means = show(f"triplets, {source}", list(cases.values()))
        result[source] = {"means": means, "triplets": cases}
    return result


LIGHTS: Sequence[tuple[str, ...]] = (
    ("autumn",), ("winter",), ("sunset",), ("night",), ("autumn", "night"), ("winter", "sunset"),
)  # fmt: skip
"""Six references: four lights, and two at once."""
SEED = 7
WALK = 10
VIEW = 4
SIZE = (384, 288)
"""The town of the references, the length of the walk, the view of it, and its width and height."""
SINGLE = 4
SEVERAL = 2
"""References of a scene: so many alone, so many sets of several."""
SHARED_REGIONS = 6
"""Regions that views and references are compared in, where nobody knows the true ones."""


class References(NamedTuple):
    """Pictures of one style."""

    name: str
    paths: tuple[Path, ...]
    images: list[Tensor]
    classes: list[Tensor] | None
    """The true ones, if known."""


def references_of(trained: Trained, config: StylesConfig, folder: Path) -> Iterator[References]:
    """Towns for a town, written into the folder; for another scene the photographs that the pairings name."""
    if town_of(trained) is not None:
        place = Place("town", SEED, walk(seed=SEED, views=WALK, width=SIZE[0], height=SIZE[1])[VIEW])
        for names in LIGHTS:
            found = [photograph(place, name) for name in names]
            paths = tuple(folder / f"{name}.png" for name in names)
            for path, reference in zip(paths, found, strict=True):
                write_image(path, to_uint8(reference.image))
            yield References("+".join(names), paths, [r.image for r in found], [r.classes for r in found])
        return
    pairings = config.shared / "data/pairings.json"
    styles = config.shared / "data/styles"
    scene = trained.known.name
    known = json.loads(pairings.read_text(encoding="utf-8")) if pairings.is_file() else {}
    if scene not in known:
        listed = ", ".join(name for name in known if name != "note") or "none"
        raise DataError(
            f"{pairings}: no references for the scene {scene!r} (it has {listed}); name a file that has"
        )
    for names in [*([name] for name in known[scene]["S"][:SINGLE]), *known[scene]["M"][:SEVERAL]]:
        paths = tuple(styles / f"{name}.jpg" for name in names)
        images = [torch.from_numpy(shrink(load_image(path), config.longest)).float() / 255 for path in paths]
        yield References("+".join(names), paths, images, None)


def town_of(trained: Trained) -> Path | None:
    """Folder of the truth of a run's town; None where it is another scene."""
    folder = trained.config.data
    return folder if folder is not None and is_town(folder) else None


def run_figures(root: Path, config: StylesConfig, judges: Mapping[str, Encoder]) -> dict[str, object]:
    """Figures of every stylizer on neighbouring views, in the middle of the capture, in each style."""
    trained = load_run(root, "cpu")
    known = trained.known
    encoders = trained.encoders()
    truth = town_of(trained)
    cameras = known.cameras.scaled(max(1.0, float(known.cameras.size.amax()) / config.longest))
    first = max(0, (len(cameras) - config.views) // 2)
    chosen = list(range(first, min(len(cameras), first + config.views)))
    near = cameras.select(torch.tensor(chosen))
    pairs = [(i, i + 1) for i in range(len(chosen) - 1)]
    cached = [cache_view(trained.model, known.facts, cameras, view, trained.config.render) for view in chosen]
    plain = [view.restyled().rgb for view in cached]
    cases: dict[str, dict[str, Row]] = {}
    shown: dict[str, dict[str, Tensor]] = {}
    with tempfile.TemporaryDirectory(prefix="fprf-styles-") as made:
        for style in references_of(trained, config, Path(made)):
            styled = {PLAIN: plain, **{k: v.pictures for k, v in transfers(plain, style.images).items()}}
            for name, stylizer in STYLIZERS.items():
                wanted = StyleFile(StyleConfig(references=style.paths, stylizer=stylizer))
                look: Restyle = apply_style(trained, wanted, encoders).restyle
                styled[name] = [view.restyled(look).rgb for view in cached]
            if style.classes is None or truth is None:
                observer = config.semantic.build()
                regions, there = matched_regions(
                    observer, plain, style.images, regions=SHARED_REGIONS, seed=0
                )
            else:
                regions = [torch.from_numpy(read_truth(truth, v)[1].astype("int64")) for v in chosen]
                there = style.classes
            rows = judge_exhibit(
                Exhibit(plain, styled, regions, style.images, there), judges, full=config.full
            )
            for name, pictures in styled.items():
                error = WarpError(near)
                depths = [view.restyled().depth for view in cached]
                for a, b in pairs:
                    error.add(a, b, pictures[a], pictures[b], depths[a], depths[b])
                warped = error.summary()
                rows[name] |= {"consistency_rmse": warped["rmse"], "consistency_relative": warped["relative"]}
            cases[style.name] = rows
            shown[style.name] = {
                "reference": style.images[0],
                **{name: views[0] for name, views in styled.items()},
            }
    if config.sheets is not None:
        write_sheet(config.sheets / f"run-{root.name}.jpg", shown)
    means = show(root.name, list(cases.values()))
    return {"scene": known.name, "means": means, "styles": cases}


COLUMNS: tuple[Column, ...] = tuple(
    (key, key.replace("_", " "), ".3f")
    for key in (
        "structure", "ssim", "gradient_kept", "range_kept", "style_distance", "full_distance", "consistency_rmse",
        "consistency_relative", "false_edges",
    )
)  # fmt: skip


def show(title: str, tables: Sequence[Mapping[str, Row]]) -> dict[str, Row]:
    """Print the means over tables with the same methods, and return them."""
    means = mean_rows(tables)
    console().print(printed(title, means, [c for c in COLUMNS if any(c[0] in row for row in means.values())]))
    return means


def write_sheet(path: Path, rows: Mapping[str, Mapping[str, Tensor]]) -> None:
    """One row a style or triplet, one column a method."""
    columns = list(next(iter(rows.values())))
    write_image(
        path, contact_sheet({name: list(row.values()) for name, row in rows.items()}, columns, height=144)
    )


def main(argv: list[str]) -> int:
    """`python -m benchmarks styles [RUN ...] [flags]`."""
    torch.set_num_threads(1)
    start = time.perf_counter()
    count = next((i for i, word in enumerate(argv) if word.startswith("-")), len(argv))
    config = parse(
        StylesConfig(), argv[count:], prog="python -m benchmarks styles [RUN ...]", description=__doc__ or ""
    )
    config = replace(config, runs=(*map(Path, argv[:count]), *config.runs))
    judges = judges_of(config.shared)
    with tempfile.TemporaryDirectory(prefix="fprf-styles-") as made:
        painted_figures = triplets(config, judges)
        if not painted_figures and not config.runs:
            config = replace(
                config, runs=(train_run(Path(made) / "town", "fprf-lite", Path("town"), steps=config.steps),)
            )
        document = {
            "benchmark": "styles",
            "judges": list(judges),
            "longest": config.longest,
            "triplets": painted_figures,
            "runs": {root.name: run_figures(root, config, judges) for root in config.runs},
            "seconds": time.perf_counter() - start,
        }
    report(config.output, document)
    return 0
