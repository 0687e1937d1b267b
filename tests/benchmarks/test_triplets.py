from pathlib import Path

import torch

from benchmarks.semantic_matching import (
    read_triplets,
    semantic_matching,
    town_cells,
    triplet_names,
)
from fprf.plugins.encoders.config import RandomConfig
from fprf.town.surface import CLASSES, SKY


def test_town_cells_share_their_classes_between_palettes() -> None:
    encoder = RandomConfig(channels=4, stride=8).build()
    cells = town_cells(encoder, ["day", "night"], seeds=[0], views=2, size=(64, 48))
    (day, day_labels), (night, night_labels) = cells["day"], cells["night"]
    assert day.shape == night.shape == (2 * 6 * 8, 4)
    assert day_labels.equal(night_labels)
    assert not torch.allclose(day, night)
    assert set(day_labels.tolist()) <= {-1, *range(len(CLASSES))}
    assert SKY in day_labels


def test_the_triplets_at_hand_are_read_and_compared(shared: Path) -> None:
    folder = shared / "data/pst"
    found = semantic_matching(
        RandomConfig(channels=3, stride=16).build(), read_triplets(folder, names=triplet_names(folder)[:5])
    )
    assert found["triplets"] == 4  # one is painted in a single colour
    assert isinstance(found["matching"], float)
    assert 0.2 < found["matching"] < 0.9
