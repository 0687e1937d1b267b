"""Fixtures for every test."""

import shutil
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numba
import pytest
import torch
from fake_packages import Packages, packages_in
from hypothesis import HealthCheck, settings

if TYPE_CHECKING:
    from tiny_world import World

# Times vary on a busy machine, and no test minds that its examples share fixtures.
UNCHECKED = [HealthCheck.too_slow, HealthCheck.function_scoped_fixture]
settings.register_profile("tests", deadline=None, suppress_health_check=UNCHECKED)
settings.load_profile("tests")


@pytest.fixture(scope="session")
def shared() -> Path:
    """Scenes, photographs and weights beside the checkout; absent on a user's machine."""
    folder = Path(__file__).resolve().parents[2] / "shared"
    if not (folder / "data").is_dir():
        pytest.skip("no shared/ beside the checkout: scenes and encoder weights are not part of the project")
    return folder


@pytest.fixture(autouse=True)
def _seeded() -> None:
    torch.manual_seed(0)


@pytest.fixture(autouse=True, scope="session")
def _interrupts() -> None:
    """A shell has what it runs in the background ignore SIGINT, and programs that tests start would inherit that."""
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(autouse=True)
def _one_kernel_thread() -> None:
    """Kernels here take a millisecond; on a busy machine waiting for their second thread takes a hundred.

    torch and numba share OpenMP: numba's first call gives torch, too, as many threads as there are cores.
    """
    _use_one_thread()


def _use_one_thread() -> None:
    numba.set_num_threads(1)
    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def one_thread() -> None:
    """For fixtures of a session, which come before those of a test: sums depend on the threads."""
    _use_one_thread()


@pytest.fixture(scope="session")
def _world(tmp_path_factory: pytest.TempPathFactory, one_thread: None) -> Iterator["World"]:
    from tiny_world import make_world  # imports the engine, which few tests need

    folder = tmp_path_factory.mktemp("world")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder / "cache"))
        yield make_world(folder)


@pytest.fixture
def world(_world: "World", monkeypatch: pytest.MonkeyPatch) -> "World":
    """The tiny trained scene, its features in a cache of its own; read it, don't write to it."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(_world.folder / "cache"))
    return _world


@pytest.fixture
def run(world: "World", tmp_path: Path) -> Path:
    """A copy of the trained run, to write to."""
    return shutil.copytree(world.run, tmp_path / "run")


@pytest.fixture
def packages(tmp_path: Path) -> Iterator[Packages]:
    """A folder on the path into which tests install packages."""
    with packages_in(tmp_path / "site") as found:
        yield found
