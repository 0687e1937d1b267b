"""Fixtures of the viewer's tests."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from session_helpers import Listener, viewed
from tiny_world import World

from fprf.training.loading import load_run
from fprf.viewer.restyler import Restyler
from fprf.viewer.session import Session
from fprf.viewer.state import Photograph, State


@pytest.fixture
def restyler(world: World) -> Restyler:
    return Restyler(world.load())


@pytest.fixture
def encoded(restyler: Restyler, world: World) -> tuple[Photograph, Photograph]:
    one, two = (restyler.encode(path, path.name) for path in world.references)
    return one, two


@pytest.fixture
def listener() -> Listener:
    return Listener()


@pytest.fixture
def session(run: Path, listener: Listener) -> Iterator[Session]:
    """A session of a copy of the trained run, with the listener attached."""
    with Session(viewed(load_run(run, "cpu")), State(pixels=64)) as opened:
        opened.attach(listener)
        yield opened
