"""Scenes in cells: cells can be lost and trained again, and their union is the scene."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.town.write import write_town
from fprf.blocks.partition import bisect_sightings
from fprf.cli.main import main
from fprf.datamanagers.parsers.config import parse_scene
from fprf.datamanagers.scene import Scene
from fprf.io.images import write_image
from fprf.plugins.codec import load_config, save_config
from fprf.splats import cell_training
from fprf.splats.cell_training import CellTask, read_cells, train_cell
from fprf.splats.config import GaussiansConfig
from fprf.splats.files import read_capture
from fprf.splats.learner import MOVES
from fprf.training.camera_optimizers import Tones
from fprf.training.checkpoint import load_latest
from fprf.training.loading import open_run
from fprf.training.run import Run
from fprf.types import Cell

COUNT = 3


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cells") / "town"
    write_town(folder, seed=0, palette="day", views=10, width=96, height=72)
    return folder


def command(town: Path, run: Path, *flags: str) -> list[str]:
    """Words that train the town in cells."""
    small = ["--downscale", "1", "--steps", "40", "--cells", "2", "--initial", "300", "--cap", "600"]
    return ["train", "fprf-splats", "--data", str(town), *small, *flags, "--output", str(run)]


@pytest.fixture(scope="module")
def scene(town: Path) -> Scene:
    return parse_scene(town, 1, None)


@pytest.fixture(scope="module")
def cells(scene: Scene) -> list[Cell]:
    return bisect_sightings(scene, COUNT)


def test_a_run_of_before_with_its_rounds_is_read(tmp_path: Path) -> None:
    file = tmp_path / "config.json"
    save_config(file, GaussiansConfig(cells=3), "fprf-splats")
    document = json.loads(file.read_text())
    document["config"]["rounds"] = 2
    file.write_text(json.dumps(document))
    assert load_config(file) == (GaussiansConfig(cells=3), "fprf-splats")


def test_a_lost_cell_is_trained_again_and_changes_nothing(town: Path, scene: Scene, cells: list[Cell], tmp_path: Path) -> None:
    run = tmp_path / "run"
    words = command(town, run, "--cells", str(COUNT))
    assert main(words) == 0

    def exported(name: str) -> bytes:
        assert main(["export", str(run), "ply", "--output", str(tmp_path / name)]) == 0
        return (tmp_path / name).read_bytes()

    first = exported("a.ply")
    stamps = {path: path.stat().st_mtime_ns for path in run.glob("**/done.json")}
    assert len(stamps) == 1 + COUNT
    shutil.rmtree(run / "cells" / "01")
    assert main(words) == 0
    assert exported("b.ply") == first
    changed = [path.parent.relative_to(run) for path, stamp in stamps.items() if path.stat().st_mtime_ns != stamp]
    assert changed == [Path("cells/01")]
    assert [*map(repr, read_cells(run))] == [*map(repr, cells)]
    gaussians = read_capture(tmp_path / "a.ply").gaussians
    assert len(gaussians) > 0 and torch.stack([cell.holds(gaussians.means) for cell in cells]).sum(0).eq(1).all()
    # A worker reads its own views alone, not the scene folder's list of all.
    shutil.rmtree(run / "cells" / "02")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("fprf.splats.training.parse_scene", None)
        task = CellTask(root=str(run), data=str(town), cell=2, minutes=None, quiet=True)
        assert train_cell(task, lambda event: None)
    assert main(words) == 0 and exported("c.ply") == first
    assert main(["eval", str(run), "--split", "test"]) == 0


def test_cells_go_on_from_the_exposures_of_the_whole_scene(town: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Which knows those of the photographs that it had memory for. Each cell moves its own, and not their mean."""
    monkeypatch.setattr(cell_training, "_PIXELS", 1500)
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
    for number, cell in enumerate(read_cells(run)):
        saved, _ = load_latest(run / "cells" / f"{number:02d}" / "checkpoints")
        assert saved is not None
        outside = torch.ones(len(gain), dtype=torch.bool)
        outside[list(cell.windows)] = False
        moved = saved.optimizer["tones.gain.value"]
        assert torch.equal(moved[outside], torch.zeros(int(outside.sum()), 3)) and (moved[~outside] != 0).any()
        tones = start.going_on(tuple(outside.nonzero()[:, 0].tolist()))
        tones.load_state_dict({name: saved.optimizer[f"tones.{name}.value"] for name in ("gain", "exponent")})
        torch.testing.assert_close(tones.gains()[~outside].mean(0), start.gains()[~outside].mean(0), atol=1e-5, rtol=0)
        means.append(torch.where(outside[:, None], torch.nan, tones.gains().detach()))
    union, _ = load_latest(run / "checkpoints")
    assert union is not None
    mean = torch.stack(means).nanmean(0)
    torch.testing.assert_close(
        union.optimizer["tones.gain.value"], torch.where(mean.isnan(), start.gains().detach(), mean), atol=1e-6, rtol=1e-5
    )


def test_cells_see_from_where_the_whole_scene_found_its_views(town: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    assert main(command(town, run, "--steps", "60", "--poses", "0.002")) == 0
    overview, union = (load_latest(folder / "checkpoints")[0] for folder in (run / "overview", run))
    assert overview is not None and union is not None
    moves, given = overview.optimizer[MOVES], Run(run).load_known()
    assert torch.equal(union.optimizer[MOVES], moves)
    assert (moves[list(given.train)] != 0).any(1).all() and not moves[list(given.test)].any()
    start, cell = cell_training._load_overview(run), read_cells(run)[0]
    config = Run(run).load_config()[0]
    assert isinstance(config, GaussiansConfig)
    seen = cell_training._prepared(config, parse_scene(town, 1, None), given.facts, cell, start).scene.cameras
    shown = open_run(run, "cpu").known.cameras
    assert torch.equal(seen.pose, shown.pose) and not torch.equal(shown.pose, given.cameras.pose)


def test_cells_know_where_the_sky_is(town: Path, scene: Scene, tmp_path: Path) -> None:
    data, run = tmp_path / "town", tmp_path / "run"
    shutil.copytree(town, data)
    above = np.zeros((72, 96, 3), np.uint8)
    above[:30] = 255
    for path in scene.paths:
        write_image(data / "sky_masks" / f"{path.name}.png", above)
    assert main(command(data, run)) == 0
    config = Run(run).load_config()[0]
    assert isinstance(config, GaussiansConfig)
    views, start, cell = cell_training._read_views(run, config, data), cell_training._load_overview(run), read_cells(run)[0]
    facts = Run(run).load_known().facts
    seen = cell_training._prepared(config, views, facts, cell, start).learner.levels[0]
    for view, (_, top, width, height) in cell.windows.items():
        sky = seen[view].sky
        assert sky is not None and float(sky.sum()) == width * min(max(30 - top, 0), height)
    bare = replace(config, surroundings=0)
    assert all(each.sky is None for each in cell_training._prepared(bare, views, facts, cell, start).learner.levels[0].values())
