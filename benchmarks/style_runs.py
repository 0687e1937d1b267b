"""The stylizers on trained runs: neighbouring views of a scene in six styles, judged in regions that both sides share.

Of a town the references are other towns, and the regions are the true classes; of other scenes the references are the
photographs that suit them, and the regions are those that a semantic encoder finds in both.
"""

import json
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor
from town_references import SETS, town_reference

from fprf.datamanagers.images import load_image
from fprf.datamanagers.parsers.config import parse_scene
from fprf.errors import DataError
from fprf.evaluation.consistency import consistency
from fprf.evaluation.contest import PLAIN, STYLIZERS, Exhibit, Row, colour_baselines, judge_exhibit
from fprf.evaluation.looks import render_looks
from fprf.evaluation.matched_regions import matched_regions
from fprf.interfaces import Encoder
from fprf.io.images import shrink, to_uint8, write_image
from fprf.style.config import StyleConfig
from fprf.style.files import StyleFile
from fprf.style.look import Restyle
from fprf.town.write import read_truth
from fprf.training.loading import Trained, load_run
from fprf.training.restyle import apply_style

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
            shown = [render_looks(model, facts, cameras, view, render, looks) for view in chosen]
            by_look = {name: [pictures[name] for pictures, _ in shown] for name in looks}
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
                warped = consistency(pictures, [depth for _, depth in shown], near, pairs)
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
    if trained.known.name != "town":
        return None
    scene = parse_scene(trained.config.data, trained.config.downscale, trained.config.datamanager.parser)
    return scene.paths[0].parents[1]


def _middle(count: int, views: int) -> list[int]:
    first = max(0, (count - views) // 2)
    return list(range(first, min(count, first + views)))
