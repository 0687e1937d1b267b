from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.semantic_matching import (
    COLOURS,
    SIZE,
    read_regions,
    read_triplets,
    semantic_matching,
    town_cells,
    triplet_names,
)
from fprf.errors import DataError
from fprf.io.images import write_image
from fprf.plugins.encoders.config import RandomConfig
from fprf.town.surface import CLASSES, SKY

CODES = [
    (0, 0, 0),
    (255, 255, 255),
    (0, 0, 255),
    (0, 255, 0),
    (255, 0, 0),
    (255, 255, 0),
    (255, 0, 255),
    (0, 255, 255),
    (128, 128, 128),
]


def test_every_colour_is_its_region(tmp_path: Path) -> None:
    ids = np.arange(len(CODES)).repeat(4).reshape(6, 6)
    write_image(tmp_path / "mask.png", np.array(CODES, dtype=np.uint8)[ids])
    assert read_regions(tmp_path / "mask.png").equal(torch.from_numpy(ids))
    assert len(COLOURS) == len(CODES)


def test_other_colours_are_refused(tmp_path: Path) -> None:
    pixels = np.zeros((4, 5, 3), dtype=np.uint8)
    pixels[0, 0] = 77
    write_image(tmp_path / "mask.png", pixels)
    with pytest.raises(DataError, match=r"mask\.png: 5\.0% of the pixels"):
        read_regions(tmp_path / "mask.png")


def test_photographs_are_resized_and_masks_are_not(tmp_path: Path) -> None:
    for name in ("b", "a"):
        for part in ("content", "style"):
            write_image(tmp_path / part / f"{name}.jpg", np.full((30, 40, 3), 90, dtype=np.uint8))
            write_image(tmp_path / "segmentation" / f"{name}_{part}.png", np.zeros((30, 40, 3), dtype=np.uint8))
    assert triplet_names(tmp_path) == ["a", "b"]
    one, two = read_triplets(tmp_path)
    assert (one.name, two.name) == ("a", "b")
    assert tuple(one.content.shape) == (SIZE[1], SIZE[0], 3)
    assert one.content_regions.shape == (30, 40)
    assert float(one.style.mean()) == pytest.approx(90 / 255, abs=1e-6)
    (small,) = read_triplets(tmp_path, names=["b"], size=None)
    assert tuple(small.content.shape) == (30, 40, 3)


def test_a_folder_without_triplets_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no content"):
        read_triplets(tmp_path)


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
