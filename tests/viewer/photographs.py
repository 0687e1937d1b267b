"""Encoded photographs and viewed runs for tests."""

from tiny_world import World

from fprf.training.loading import Trained
from fprf.viewer.restyler import Restyler
from fprf.viewer.session import Viewed, view_of_run
from fprf.viewer.state import Photograph

__all__ = ["encoded", "viewed"]


def encoded(restyler: Restyler, world: World) -> tuple[Photograph, Photograph]:
    one, two = (restyler.encode(path, path.name) for path in world.references)
    return one, two


def viewed(trained: Trained) -> Viewed:
    return view_of_run(trained, trained.run, trained.known)
