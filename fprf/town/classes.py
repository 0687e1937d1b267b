"""The classes of the town: fixed ids, the same in every town."""

__all__ = [
    "CAR",
    "CLASSES",
    "DOOR",
    "FACADE",
    "FOLIAGE",
    "LAMP",
    "LAWN",
    "ROAD",
    "ROOF",
    "SIDEWALK",
    "SKY",
    "TRUNK",
    "WINDOW",
]

SKY, LAWN, ROAD, SIDEWALK, FACADE, ROOF, FOLIAGE, TRUNK, WINDOW, LAMP, DOOR, CAR = range(12)

CLASSES = (
    "sky",
    "lawn",
    "road",
    "sidewalk",
    "facade",
    "roof",
    "foliage",
    "trunk",
    "window",
    "lamp",
    "door",
    "car",
)
"""Names by id."""
