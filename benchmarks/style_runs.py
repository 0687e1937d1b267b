"""The stylizers on trained runs: neighbouring views of a scene in six styles, judged in regions that both sides share.

Of a town the references are other towns, and the regions are the true classes; of other scenes the references are the
photographs that suit them, and the regions are those that a semantic encoder finds in both.
"""

import json
import math
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from fprf.datamanagers.images import load_image
from fprf.errors import DataError
from fprf.evaluation.consistency import consistency
from fprf.evaluation.metrics import contrast_kept, matched_regions, region_contrasts, ssim, structure, style_distances
from fprf.interfaces import Encoder
from fprf.io.images import shrink, to_uint8, write_image
from fprf.style.config import StyleConfig
from fprf.style.controls import luma
from fprf.style.files import StyleFile
from fprf.style.look import Restyle
from fprf.style.restyle import apply_style
from fprf.training.loading import Trained, load_run
from fprf.training.views import cache_view

from .pictures import SETS, town_reference
from .restyle import STYLIZERS
from .single_image import histogram_matching, reinhard
from .town.write import is_town, read_truth

PLAIN = "unstylised"
RECOMMENDED = "region-tone"

GOALS: Mapping[str, float] = {"adain": 0.30, "local-adain": 0.15}
"""By what share the recommended stylizer shall come nearer to the style than these."""
_SLACK = 0.02
"""How much structure it may lose against them."""

Row = dict[str, float | None]


class Exhibit(NamedTuple):
    """What methods are judged by: one scene in one style. Lists of views run in parallel."""

    plain: Sequence[Annotated[Tensor, "H W 3"]]
    styled: Mapping[str, Sequence[Annotated[Tensor, "H W 3"]]]
    regions: Sequence[Annotated[Tensor, "h w"]]
    """Region ids of the views, at any resolution."""
    references: Sequence[Annotated[Tensor, "G F 3"]]
    reference_regions: Sequence[Annotated[Tensor, "g f"]]


def colour_baselines(
    plain: Sequence[Annotated[Tensor, "H W 3"]], references: Sequence[Annotated[Tensor, "G F 3"]]
) -> dict[str, list[Annotated[Tensor, "H W 3"]]]:
    """Colour transfers of every view on its own, towards all pixels of all references."""
    style = torch.cat([image.reshape(-1, 3) for image in references])
    methods = {"reinhard": reinhard, "histogram": histogram_matching}
    return {
        name: [transfer(view.reshape(-1, 3), style).reshape(view.shape) for view in plain] for name, transfer in methods.items()
    }


def judge_exhibit(exhibit: Exhibit, judges: Mapping[str, Encoder], *, full: bool = False) -> dict[str, Row]:
    """By method: `structure` and `ssim` (means over the views), `contrast_kept`, and `style_distance`, also by judge and, with
    `full`, of whole covariances.

    Raises DataError where the lists of views differ in length.
    """
    lengths = {len(exhibit.plain), len(exhibit.regions), *(len(views) for views in exhibit.styled.values())}
    if len(lengths) != 1 or len(exhibit.references) != len(exhibit.reference_regions):
        raise DataError("contest: every method needs a picture of each view, and every picture its regions")
    plain = list(zip(exhibit.plain, exhibit.regions, strict=True))
    styled = {name: list(zip(views, exhibit.regions, strict=True)) for name, views in exhibit.styled.items()}
    style = list(zip(exhibit.references, exhibit.reference_regions, strict=True))
    kinds = {"style_distance": False, "full_distance": True} if full else {"style_distance": False}
    distances = {name: style_distances(judges, plain, styled, style, full=exact) for name, exact in kinds.items()}
    rows: dict[str, Row] = {}
    contrasts = region_contrasts(plain), region_contrasts(style)
    for name, views in exhibit.styled.items():
        pairs = list(zip(exhibit.plain, views, strict=True))
        row: Row = {
            "structure": math.fsum(structure(a, b) for a, b in pairs) / len(pairs),
            "ssim": math.fsum(_luminance_ssim(a, b) for a, b in pairs) / len(pairs),
            **contrast_kept(contrasts[0], region_contrasts(styled[name]), contrasts[1]),
        }
        for kind, found in distances.items():
            row[kind] = found[name].pop("mean")
            row |= {f"{kind}_{judge}": value for judge, value in found[name].items()}
        rows[name] = row
    return rows


def mean_rows(contests: Iterable[Mapping[str, Row]]) -> dict[str, Row]:
    """Mean of every figure over contests with the same methods; what is None in one of them is left out there."""
    gathered: dict[str, dict[str, list[float]]] = {}
    for contest in contests:
        for method, row in contest.items():
            for key, value in row.items():
                kept = gathered.setdefault(method, {}).setdefault(key, [])
                kept += [] if value is None else [value]
    return {
        method: {key: math.fsum(values) / len(values) if values else None for key, values in row.items()}
        for method, row in gathered.items()
    }


def verdict(rows: Mapping[str, Row], recommended: str = RECOMMENDED) -> dict[str, dict[str, float | bool | None]]:
    """Against each method of GOALS: by what share the recommended one is nearer to the style, the structure that it loses, and
    whether both goals are met (None where a distance is not known).
    """
    found: dict[str, dict[str, float | bool | None]] = {}
    for method, goal in GOALS.items():
        ours, theirs = (rows[name]["style_distance"] for name in (recommended, method))
        kept, theirs_kept = (rows[name]["structure"] for name in (recommended, method))
        if ours is None or theirs is None or theirs <= 0 or kept is None or theirs_kept is None:
            found[method] = {"nearer_share": None, "goal_share": goal, "structure_lost": None, "met": None}
            continue
        nearer, lost = 1 - ours / theirs, theirs_kept - kept
        found[method] = {
            "nearer_share": nearer,
            "goal_share": goal,
            "structure_lost": lost,
            "met": nearer >= goal and lost <= _SLACK,
        }
    return found


SINGLE, SEVERAL = 4, 2
"""References of a scene: so many alone, so many sets of several."""
REGIONS = 6
"""Regions that views and references are compared in, where nobody knows the true ones."""


class References(NamedTuple):
    name: str
    paths: tuple[Path, ...]
    images: list[Tensor]
    classes: list[Tensor] | None
    """The true ones, if known."""


class Case(NamedTuple):
    """One run in one style."""

    scene: str
    style: References
    rows: dict[str, Row]
    styled: dict[str, list[Tensor]]
    """The views by every method."""

    @property
    def row(self) -> dict[str, Tensor]:
        """For a sheet: the references by name, and the first view by every method."""
        names = self.style.name.split("+")
        references = {f"reference: {name}": image for name, image in zip(names, self.style.images, strict=True)}
        return references | {name: views[0] for name, views in self.styled.items()}


def contests(
    root: Path,
    references: Callable[[Trained, Path], Iterator[References]],
    judges: dict[str, Encoder],
    observer: Encoder,
    *,
    views: Sequence[int] | int,
    longest: int,
    full: bool,
    say: Callable[[str], None],
) -> Iterator[Case]:
    """One case after the other. `references` may write into the folder that it is given; `observer` finds the regions where no
    truth is known; `views` are those in the middle of the capture, or these ones.
    """
    trained = load_run(root, "cpu")
    scene, encoders, truth = trained.known.name, trained.encoders(), town_folder(trained)
    cameras = trained.known.cameras
    cameras = cameras.scaled(max(1.0, float(cameras.size.amax()) / longest))
    chosen = _middle(len(cameras), views) if isinstance(views, int) else list(views)
    model, facts, render = trained.model, trained.known.facts, trained.config.render
    with tempfile.TemporaryDirectory(prefix="fprf-styles-") as made:
        for style in references(trained, Path(made)):
            say(f"{scene} x {style.name}")
            looks: dict[str, Restyle | None] = {PLAIN: None}
            for name, stylizer in STYLIZERS.items():
                wanted = StyleFile(StyleConfig(references=style.paths, stylizer=stylizer))
                looks[name] = apply_style(trained, wanted, encoders).restyle
            cached = [cache_view(model, facts, cameras, view, render) for view in chosen]
            by_look = {name: [view.restyled(look).rgb for view in cached] for name, look in looks.items()}
            plain = by_look.pop(PLAIN)
            styled = {PLAIN: plain, **colour_baselines(plain, style.images), **by_look}
            if style.classes is None or truth is None:
                regions, there = matched_regions(observer, plain, style.images, regions=REGIONS, seed=0)
            else:
                regions = [torch.from_numpy(read_truth(truth, v)[1].astype("int64")) for v in chosen]
                there = style.classes
            rows = judge_exhibit(Exhibit(plain, styled, regions, style.images, there), judges, full=full)
            near = cameras.select(torch.tensor(chosen))
            pairs = [(i, i + 1) for i in range(len(chosen) - 1)]
            for name, pictures in styled.items():
                warped = consistency(pictures, [view.depth for view in cached], near, pairs)
                rows[name] |= {"consistency_rmse": warped["rmse"], "consistency_relative": warped["relative"]}
            yield Case(scene, style, rows, styled)


def town_references(sets: Sequence[Sequence[str]], folder: Path) -> Iterator[References]:
    """Towns in these palettes, one or several at once."""
    for names in sets:
        found = [town_reference(name) for name in names]
        paths = tuple(folder / f"{name}.png" for name in names)
        for path, reference in zip(paths, found, strict=True):
            write_image(path, to_uint8(reference.image))
        yield References("+".join(names), paths, [r.image for r in found], [r.classes for r in found])


def photographs(sets: Sequence[Sequence[str]], styles: Path, longest: int) -> Iterator[References]:
    """Photographs of a folder, one or several at once."""
    for names in sets:
        paths = tuple(styles / f"{name}.jpg" for name in names)
        images = [torch.from_numpy(shrink(load_image(path), longest)).float() / 255 for path in paths]
        yield References("+".join(names), paths, images, None)


def suited(pairings: Path, styles: Path, longest: int) -> Callable[[Trained, Path], Iterator[References]]:
    """Six references for every scene: towns for a town, for others the photographs that the pairings name."""

    def find(trained: Trained, folder: Path) -> Iterator[References]:
        if town_folder(trained) is not None:
            return town_references(SETS, folder)
        known = json.loads(pairings.read_text(encoding="utf-8")) if pairings.is_file() else {}
        scene = trained.known.name
        if scene not in known:
            listed = ", ".join(name for name in known if name != "note") or "none"
            raise DataError(f"{pairings}: no references for the scene {scene!r} (it has {listed}); name a file that has")
        sets = [*([name] for name in known[scene]["S"][:SINGLE]), *known[scene]["M"][:SEVERAL]]
        return photographs(sets, styles, longest)

    return find


def town_folder(trained: Trained) -> Path | None:
    """Where the truth of a run's town lies; None where it is another scene."""
    folder = trained.config.data
    return folder if folder is not None and is_town(folder) else None


def _middle(count: int, views: int) -> list[int]:
    first = max(0, (count - views) // 2)
    return list(range(first, min(count, first + views)))


def _luminance_ssim(a: Annotated[Tensor, "H W 3"], b: Annotated[Tensor, "H W 3"]) -> float:
    """SSIM of the luminances, in [-1, 1]."""
    grey = [luma(image.reshape(-1, 3)).reshape(*image.shape[:2], 1).expand(-1, -1, 3) for image in (a, b)]
    return ssim(*grey)
