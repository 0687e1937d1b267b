"""Fixtures of the viewer's tests."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from pages import seen
from session_helpers import Listener
from splat_ball import ball
from tiny_world import World

from fprf.page.drawing import Restyler
from fprf.page.looks import Photograph
from fprf.page.session import Session, Viewed, view_of_run
from fprf.training.loading import open_run


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
    """A session of a copy of the trained run of fields."""
    with Session(replace(view_of_run(open_run(run, "cpu")), pixels=64), listener.post) as opened:
        yield opened


@pytest.fixture
def splats(listener: Listener, tmp_path: Path) -> Iterator[Session]:
    """A session of a ball of Gaussians."""
    with Session(
        Viewed(seen(ball(400, 2)), "ball", 1, tmp_path / "ball", pixels=64), listener.post
    ) as opened:
        yield opened
