"""Encoded photographs for tests."""

from tiny_world import World

from fprf.viewer.restyler import Restyler
from fprf.viewer.state import Photograph

__all__ = ["encoded"]


def encoded(restyler: Restyler, world: World) -> tuple[Photograph, Photograph]:
    one, two = (restyler.encode(path, path.name) for path in world.references)
    return one, two
