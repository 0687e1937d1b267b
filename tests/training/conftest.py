"""A trained scene of blocks, for the tests of the engine."""

from collections.abc import Iterator

import pytest
from block_world import BlockWorld, made


@pytest.fixture(scope="session")
def _block_world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[BlockWorld]:
    folder = tmp_path_factory.mktemp("blocks")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder / "cache"))
        yield BlockWorld(folder, made(folder))


@pytest.fixture
def block_world(_block_world: BlockWorld, monkeypatch: pytest.MonkeyPatch) -> BlockWorld:
    """The town in three blocks, its features in a cache of its own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(_block_world.folder / "cache"))
    return _block_world
