"""What a plan says against what training then takes."""

from dataclasses import replace

import pytest
import torch
from block_world import BlockWorld, small

from fprf.fields.config import PlanesConfig
from fprf.fields.layouts import SingleConfig, StreetConfig
from fprf.training import block_plan
from fprf.training.block_plan import Estimate, estimates, plan_scene


@pytest.fixture(scope="module")
def rows(_block_world: BlockWorld) -> list[Estimate]:
    return estimates(_block_world.config, *plan_scene(_block_world.config))


def test_a_row_for_the_surroundings_each_block_and_all(rows: list[Estimate], block_world: BlockWorld) -> None:
    _, plan = plan_scene(block_world.config)
    assert [row.name for row in rows] == ["surroundings", "00", "01", "02", "together"]
    assert [row.rays for row in rows[1:4]] == plan.rays.tolist()
    assert rows[0].rays == 10 * 32 * 24 and rows[0].views == 10
    assert [row.views for row in rows[1:4]] == [len(plan.views_of(b)) for b in range(3)]
    assert rows[-1].rays == sum(row.rays for row in rows[:-1])
    assert rows[-1].seconds == pytest.approx(sum(row.seconds for row in rows[:-1]))
    assert rows[-1].memory_mib == max(row.memory_mib for row in rows[:-1])


def test_disk_is_what_training_writes(rows: list[Estimate], block_world: BlockWorld) -> None:
    """Finished tensors and two checkpoints of parameters and both moments; the decoder and logs come on top."""
    frozen = sum(f.stat().st_size for f in (block_world.root / "blocks/00").glob("block.safetensors"))
    for row, name in zip(rows, ("surroundings", "00", "01", "02"), strict=False):
        folder = block_world.root / "blocks" / name
        written = sum(f.stat().st_size for f in folder.rglob("*.safetensors")) / 2**20
        assert 0.3 * written < row.disk_mib < 3 * written + frozen / 2**20


def test_lengths_are_world_units(rows: list[Estimate], block_world: BlockWorld) -> None:
    _, plan = plan_scene(block_world.config)
    size = (plan.boxes.high[0] - plan.boxes.low[0]) / plan.space.scale
    assert rows[1].extent == pytest.approx(tuple(size.tolist()))


def test_bigger_fields_take_more(block_world: BlockWorld, rows: list[Estimate]) -> None:
    config = block_world.config
    field = PlanesConfig(resolutions=(8, 64), channels=8, hidden=16, layers=1)
    bigger = estimates(replace(config, content=replace(config.content, field=field)), *plan_scene(config))
    for more, less in zip(bigger, rows, strict=True):
        assert more.memory_mib > less.memory_mib and more.disk_mib > less.disk_mib


def test_time_follows_the_steps_until_the_limit(block_world: BlockWorld) -> None:
    config = replace(block_world.config, steps=1_000_000, minutes=2.0)
    limited = estimates(config, *plan_scene(config))
    assert limited[-1].seconds == pytest.approx(120)


def test_many_pixels_take_disk_and_no_memory(
    block_world: BlockWorld, rows: list[Estimate], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(block_plan, "HELD", 0)
    mapped = estimates(block_world.config, *plan_scene(block_world.config))
    pixels = 3 * 10 * 32 * 24 / 2**20
    assert rows[0].memory_mib - mapped[0].memory_mib == pytest.approx(pixels)
    assert mapped[0].disk_mib - rows[0].disk_mib == pytest.approx(pixels)


def test_one_block_has_no_surroundings(block_world: BlockWorld) -> None:
    for layout in (SingleConfig(), StreetConfig(segments=1)):
        config = replace(small(block_world.config.data, block_world.root), blocks=layout)
        (row,) = estimates(config, *plan_scene(config))
        assert (row.name, row.views, row.rays) == ("whole", 10, 10 * 32 * 24)


def test_planning_leaves_models_of_training_alone(block_world: BlockWorld) -> None:
    """Timed steps move parameters of models of their own: two plans say the same."""
    config = block_world.config
    first, second = (estimates(config, *plan_scene(config)) for _ in range(2))
    assert [(r.memory_mib, r.disk_mib) for r in first] == [(r.memory_mib, r.disk_mib) for r in second]
    assert torch.initial_seed() == 0


def test_cells_and_json() -> None:
    row = Estimate("07", 1234, 5_000_000, (10.0, 20.0, 3.25), 1500.4, 20.0, 3725.0)
    assert row.cells() == ("07", "1,234", "5,000,000", "10 x 20 x 3.25", "1,500 MiB", "20 MiB", "1:02:05")
    assert replace(row, seconds=61.0).cells()[-1] == "1:01"
    assert row.json()["images"] == 1234 and row.json()["extent"] == [10.0, 20.0, 3.25]
