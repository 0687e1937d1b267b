"""Scenes in cells: what each goes on from, what it sees, and their union."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from gsplat_stand_in import stand_in
from pretend_cuda import pretend_cuda

from benchmarks.town.write import write_town
from fprf.blocks.config import BisectConfig
from fprf.blocks.windows import cut_into_windows
from fprf.cli.main import main
from fprf.datamanagers.parsers.config import parse_scene
from fprf.io.images import write_image
from fprf.splats import cells
from fprf.splats.cells import CellPart, load_cells, open_cell
from fprf.splats.files import read_capture
from fprf.splats.view_corrections import MOVES
from fprf.training.camera_optimizers import Tones
from fprf.training.checkpoint import load_latest
from fprf.training.loading import open_run
from fprf.training.run import Run
from fprf.training.tasks import Task


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cells") / "town"
    write_town(folder, seed=0, palette="day", views=10, width=96, height=72)
    return folder


def command(town: Path, run: Path, *flags: str) -> list[str]:
    """Words that train the town in cells."""
    small = ["--downscale", "1", "--steps", "40", "--cells", "2", "--initial", "300", "--cap", "600"]
    return ["train", "fprf-splats", "--data", str(town), *small, *flags, "--output", str(run)]


def part_of(run: Path, data: Path, cell: int) -> CellPart:
    """A cell of a run, ready to be trained."""
    part = open_cell(Task(root=str(run), data=str(data), part=cell, minutes=None))
    assert isinstance(part, CellPart)
    return part


def test_the_union_holds_each_cell_s_own(town: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    words = command(town, run, "--cells", "3")
    assert main(words) == 0
    assert main(["export", str(run), "ply", "--output", str(tmp_path / "a.ply")]) == 0
    gaussians = read_capture(tmp_path / "a.ply").gaussians
    cut = load_cells(run)
    assert [*map(repr, cut)] == [
        *map(repr, cut_into_windows(parse_scene(town, 1, None), BisectConfig(count=3)))
    ]
    assert (
        len(gaussians) > 0 and torch.stack([cell.holds(gaussians.means) for cell in cut]).sum(0).eq(1).all()
    )
    assert main(["eval", str(run), "--split", "test"]) == 0


def test_cells_go_on_from_the_exposures_of_the_whole_scene(
    town: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Which knows those of the photographs that it had memory for. Each cell moves its own, and not their
    mean.
    """
    monkeypatch.setattr(cells, "_MAX_OVERVIEW_PIXELS", 1500)
    run = tmp_path / "run"
    assert main(command(town, run, "--steps", "60", "--tones", "true")) == 0
    overview, _ = load_latest(run / "overview" / "checkpoints")
    facts = Run(run).load_known().facts
    assert overview is not None and facts.exposure
    gain = overview.optimizer["tones.gain.value"]
    learned = (gain != 0).all(1)
    assert 0 < int(learned.sum()) < len(Run(run).load_known().train), "some photographs were left out"
    start = Tones(torch.tensor(facts.exposure), tuple((~learned).nonzero()[:, 0].tolist()))
    start.load_state_dict({name: overview.optimizer[f"tones.{name}.value"] for name in ("gain", "exponent")})
    means = []
    for number, cell in enumerate(load_cells(run)):
        saved, _ = load_latest(run / "cells" / f"{number:02d}" / "checkpoints")
        assert saved is not None
        outside = torch.ones(len(gain), dtype=torch.bool)
        outside[list(cell.windows)] = False
        moved = saved.optimizer["tones.gain.value"]
        assert (
            torch.equal(moved[outside], torch.zeros(int(outside.sum()), 3)) and (moved[~outside] != 0).any()
        )
        tones = start.going_on(tuple(outside.nonzero()[:, 0].tolist()))
        tones.load_state_dict({name: saved.optimizer[f"tones.{name}.value"] for name in ("gain", "exponent")})
        torch.testing.assert_close(
            tones.gains()[~outside].mean(0), start.gains()[~outside].mean(0), atol=1e-5, rtol=0
        )
        means.append(torch.where(outside[:, None], torch.nan, tones.gains().detach()))
    union, _ = load_latest(run / "checkpoints")
    assert union is not None
    mean = torch.stack(means).nanmean(0)
    torch.testing.assert_close(
        union.optimizer["tones.gain.value"],
        torch.where(mean.isnan(), start.gains().detach(), mean),
        atol=1e-6,
        rtol=1e-5,
    )


def test_cells_see_from_where_the_whole_scene_found_its_views(town: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    assert main(command(town, run, "--steps", "60", "--poses", "0.002")) == 0
    overview, union = (load_latest(folder / "checkpoints")[0] for folder in (run / "overview", run))
    assert overview is not None and union is not None
    moves = overview.optimizer[MOVES]
    given = Run(run).load_known()
    assert torch.equal(union.optimizer[MOVES], moves)
    assert (moves[list(given.train)] != 0).any(1).all() and not moves[list(given.test)].any()
    source = part_of(run, town, 0).build().source
    shown = open_run(run, "cpu").known.cameras
    assert source is not None and torch.equal(source.known.cameras.pose, shown.pose)
    assert not torch.equal(shown.pose, given.cameras.pose)


def test_cells_know_where_the_sky_is(town: Path, tmp_path: Path) -> None:
    data = tmp_path / "town"
    run = tmp_path / "run"
    shutil.copytree(town, data)
    above = np.zeros((72, 96, 3), np.uint8)
    above[:30] = 255
    for path in parse_scene(town, 1, None).paths:
        write_image(data / "sky_masks" / f"{path.name}.png", above)
    assert main(command(data, run)) == 0
    part = part_of(run, data, 0)
    seen = part.build().levels[0]
    for view, (_, top, width, height) in part.cell.windows.items():
        sky = seen[view].sky
        assert sky is not None and float(sky.sum()) == width * min(max(30 - top, 0), height)
    bare = replace(part, config=replace(part.config, surroundings=0)).build()
    assert all(each.sky is None for each in bare.levels[0].values())
    with pretend_cuda(), stand_in():
        there = replace(part, config=replace(part.config, device="cuda:0")).build().levels[0]
        assert all(each.there is not None and each.there.sky is not None for each in there.values())
