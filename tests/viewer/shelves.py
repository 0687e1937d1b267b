"""Cards for tests, made once."""

from tiny_world import World

from fprf.viewer.looks import Card
from fprf.viewer.restyler import Studio

__all__ = ["cards_of"]


def cards_of(studio: Studio, world: World) -> tuple[Card, Card]:
    one, two = (studio.card(path, path.name) for path in world.references)
    return one, two
