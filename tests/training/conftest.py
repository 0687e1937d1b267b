"""Trained scenes in parts, for the tests of the engine."""

from collections.abc import Iterator

import pytest
from parts_world import BlockWorld, TaskWorld, made, small_cells, world_of_blocks, world_of_cells

from benchmarks.town.write import write_town
from fprf.training.driver import train


@pytest.fixture(scope="session")
def _block_world(tmp_path_factory: pytest.TempPathFactory, one_thread: None) -> Iterator[BlockWorld]:
    folder = tmp_path_factory.mktemp("blocks")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder / "cache"))
        yield BlockWorld(folder, made(folder))


@pytest.fixture
def block_world(_block_world: BlockWorld, monkeypatch: pytest.MonkeyPatch) -> BlockWorld:
    """The town in three blocks, its features in a cache of its own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(_block_world.folder / "cache"))
    return _block_world


@pytest.fixture(scope="session")
def cell_world(tmp_path_factory: pytest.TempPathFactory, one_thread: None) -> TaskWorld:
    """The town in two cells."""
    folder = tmp_path_factory.mktemp("cells")
    write_town(folder / "town", seed=0, palette="day", views=10, width=96, height=72)
    config = small_cells(folder / "town", folder / "run")
    return world_of_cells(config, train(config, "fprf-splats", quiet=True))


@pytest.fixture(params=["blocks", "cells"])
def task_world(request: pytest.FixtureRequest, block_world: BlockWorld, cell_world: TaskWorld) -> TaskWorld:
    """Each kind of scene in parts."""
    return cell_world if request.param == "cells" else world_of_blocks(block_world.config, block_world.root)
