"""What a plan says against what training then takes."""

from dataclasses import replace

import pytest
from block_world import BlockWorld, small

from fprf.fields.layouts import SingleConfig, StreetConfig
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


def test_time_follows_the_steps_until_the_limit(block_world: BlockWorld) -> None:
    config = replace(block_world.config, steps=1_000_000, minutes=2.0)
    limited = estimates(config, *plan_scene(config))
    assert limited[-1].seconds == pytest.approx(120)


def test_one_block_has_no_surroundings(block_world: BlockWorld) -> None:
    for layout in (SingleConfig(), StreetConfig(segments=1)):
        config = replace(small(block_world.config.data, block_world.root), blocks=layout)
        (row,) = estimates(config, *plan_scene(config))
        assert (row.name, row.views, row.rays) == ("whole", 10, 10 * 32 * 24)
