"""A layout of another package cuts both fields and Gaussians; numbers stand for the built-in one."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from block_scenes import drone
from fake_packages import packages_in

from benchmarks.town.write import write_town
from fprf.blocks.config import BisectConfig, GridConfig, LayoutConfig, SingleConfig
from fprf.blocks.partition import make_plan, site_of
from fprf.blocks.windows import cut_into_windows
from fprf.cli.main import main
from fprf.config import TrainConfig
from fprf.config_files import load_config, save_config
from fprf.errors import ConfigError
from fprf.methods import fprf_lite, fprf_splats
from fprf.plugins import registry
from fprf.plugins.slots import resolve
from fprf.splats.cells import load_cells
from fprf.splats.config import GaussiansConfig
from fprf.splats.gaussians import from_tensors
from fprf.training.checkpoint import load_latest
from fprf.training.loading import open_run

HALVES = '''
from dataclasses import dataclass, replace

import torch

from fprf.blocks.config import LayoutConfig
from fprf.interfaces import BlockLayout
from fprf.types import Cell


@dataclass(frozen=True, kw_only=True)
class HalvesConfig(LayoutConfig):
    """Two halves, one before and one behind a place."""

    at: float = 0.0
    """Where along the capture, in distances that views commonly see."""

    def build(self):
        return Halves(self.at)


class Halves(BlockLayout):
    def __init__(self, at):
        self.at = at

    def cut(self, site):
        """Both reach as high as anything, and neither holds what lies far across."""
        low, high = torch.tensor([[-torch.inf, -2.0, -torch.inf], [torch.inf, 2.0, torch.inf]], dtype=torch.float64)
        middle = torch.tensor([self.at, 2.0, torch.inf], dtype=torch.float64)
        border = torch.full((3,), 0.1, dtype=torch.float64)
        first = Cell(low=low, high=middle, border=border)
        return [first, replace(first, low=torch.tensor([self.at, -2.0, -torch.inf], dtype=torch.float64), high=high)]
'''


@pytest.fixture
def halves(tmp_path: Path) -> Iterator[LayoutConfig]:
    with packages_in(tmp_path / "site") as packages:
        packages.install(
            "acme-halves",
            {"fprf.layouts": {"halves": "acme_halves:HalvesConfig"}},
            code={"acme_halves": HALVES},
        )
        yield registry.make("fprf.layouts", "halves", LayoutConfig)


def test_both_kinds_are_cut_at_the_same_place(halves: LayoutConfig) -> None:
    scene = drone()
    plan = make_plan(scene, halves)
    cells = cut_into_windows(scene, halves)
    assert len(plan.cells) == len(cells) == 2
    assert all(bool(cell.low.isfinite().all() and cell.high.isfinite().all()) for cell in plan.cells)
    assert float(plan.cells[0].high[0]) == float(plan.cells[1].low[0]) == 0.0
    # A camera is in the same half by the frames of both.
    centre = scene.cameras.pose[:, :, 3]
    local = site_of(scene, plan.space).position[:, 0]
    assert torch.equal(cells[0].holds(centre[scene.train]), local < 0)
    assert torch.equal(cells[1].holds(centre[scene.train]), local >= 0)


def test_what_no_cell_holds_stays_as_the_whole_scene_has_it(halves: LayoutConfig, tmp_path: Path) -> None:
    town = tmp_path / "town"
    write_town(town, seed=0, palette="day", views=10, width=96, height=72)
    run = tmp_path / "run"
    words = ["--downscale", "1", "--steps", "40", "--initial", "300", "--cap", "600", "--output", str(run)]
    assert (
        main(["train", "fprf-splats", "--data", str(town), "--cells", "halves", "--cells.at", "0.0", *words])
        == 0
    )
    config, _ = load_config(run / "config.json")
    assert isinstance(config, GaussiansConfig) and config.cells == halves
    cells = load_cells(run)
    union, _ = load_latest(run / "checkpoints")
    whole, _ = load_latest(run / "overview" / "checkpoints")
    assert union is not None and whole is not None
    means = from_tensors(union.model).means
    before = from_tensors(whole.model).means
    outside = ~torch.stack([cell.holds(before) for cell in cells]).any(0)
    assert 0 < int(outside.sum()) < len(before)
    kept = means[~torch.stack([cell.holds(means) for cell in cells]).any(0)]
    assert torch.equal(kept, before[outside])
    assert len(open_run(run, "cpu").scene.names) == 10


@pytest.mark.parametrize(
    ("text", "layout"), [("1", SingleConfig()), ("4", BisectConfig(count=4)), ("grid", GridConfig())]
)
def test_a_number_stands_for_as_many_parts(text: str, layout: LayoutConfig) -> None:
    splats, rest = resolve(fprf_splats(), ["--cells", text])
    lite, _ = resolve(fprf_lite(), ["--blocks", text])
    assert not rest and splats.cells == lite.blocks == layout
    with pytest.raises(ConfigError, match="at least 1"):
        resolve(fprf_splats(), ["--cells", "0"])


@pytest.mark.parametrize(("number", "layout"), [(1, SingleConfig()), (16, BisectConfig(count=16))])
def test_a_run_from_before_cells_had_layouts_opens(tmp_path: Path, number: int, layout: LayoutConfig) -> None:
    path = tmp_path / "config.json"
    save_config(path, fprf_splats(), "fprf-splats")
    document = json.loads(path.read_text())
    document["config"]["cells"] = number
    del document["plugins"]["cells"]
    path.write_text(json.dumps(document))
    config, _ = load_config(path)
    assert isinstance(config, GaussiansConfig) and config.cells == layout
    for wrong in (0, -1, 1.5, "4", True):
        document["config"]["cells"] = wrong
        path.write_text(json.dumps(document))
        with pytest.raises(ConfigError, match=r"config\.cells"):
            load_config(path)


def test_without_points_fields_are_cut_by_their_cameras() -> None:
    plan = make_plan(replace(drone(), points=None, seen=None), BisectConfig(count=3))
    assert len(plan.cells) == 3
    assert isinstance(TrainConfig().blocks, SingleConfig)
