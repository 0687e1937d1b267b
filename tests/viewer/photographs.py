"""Encoded photographs, viewed runs and waiting for tests."""

import time
from collections.abc import Callable

from tiny_world import World

from fprf.training.loading import Trained
from fprf.viewer.restyler import Restyler
from fprf.viewer.session import Viewed, view_of_run
from fprf.viewer.state import Photograph


def encoded(restyler: Restyler, world: World) -> tuple[Photograph, Photograph]:
    one, two = (restyler.encode(path, path.name) for path in world.references)
    return one, two


def viewed(trained: Trained) -> Viewed:
    return view_of_run(trained, trained.run, trained.known)


def until(true: Callable[[], bool], act: Callable[[], object] = lambda: None) -> None:
    """Wait for something to hold, and act meanwhile; fail after two minutes."""
    end = time.monotonic() + 120
    while not true():
        assert time.monotonic() < end
        act()
        time.sleep(0.01)
