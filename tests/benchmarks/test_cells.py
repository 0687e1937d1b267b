"""Styles without clusters: which cell a pixel lies in, and what its code is made of."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tiny_world import World

from benchmarks.paper_styles import CELL, cell_dictionary, cells
from fprf.evaluation.single_image import encoded
from fprf.style.dictionary import StyleDictionary
from fprf.style.references import Encoders


def image(height: int, width: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(height, width, 3, generator=torch.Generator().manual_seed(seed))


@pytest.fixture
def encoders(world: World) -> Encoders:
    return world.load().encoders()


def made(world: World, encoders: Encoders, blend: float = 0.1, **images: torch.Tensor) -> StyleDictionary:
    return cell_dictionary(images, world.load(), encoders, blend)


@given(st.integers(1, 60), st.integers(1, 60))
def test_every_pixel_lies_in_the_cell_around_it(height: int, width: int) -> None:
    found = cells(height, width).view(height, width)
    down, across = max(1, height // CELL), max(1, width // CELL)
    for y in (0, height // 2, height - 1):
        for x in (0, width // 2, width - 1):
            assert int(found[y, x]) == min(y // CELL, down - 1) * across + min(x // CELL, across - 1)
    counts = torch.bincount(found.flatten(), minlength=down * across)
    assert len(counts) == down * across
    assert int(counts.min()) >= min(height, CELL) * min(width, CELL), "no cell is smaller than a whole one"


def test_a_code_is_the_mean_of_its_cell(world: World, encoders: Encoders) -> None:
    picture = image(24, 32)
    d = made(world, encoders, 0.0, a=picture)
    assert d.keys.shape == (12, 8) and d.mean.shape[0] == 12 and d.names == ("a",)
    guided = world.load().config.datamanager.guided
    content = encoded(picture, encoders.content, guided).double()
    assert encoders.semantic is not None
    semantic = encoded(picture, encoders.semantic, guided, encoders.basis).double()
    label, colour = cells(24, 32), picture.reshape(-1, 3).double()
    assert d.colour_mean is not None and d.colour_covariance is not None
    for k in (0, 5, 11):
        inside = label == k
        for found, values in ((d.keys, semantic), (d.mean, content), (d.colour_mean, colour)):
            torch.testing.assert_close(found[k].double(), values[inside].mean(0), rtol=1e-4, atol=1e-5)
        for spread, values in ((d.covariance, content), (d.colour_covariance, colour)):
            expected = torch.cov(values[inside].T, correction=0)
            torch.testing.assert_close(spread[k].double(), expected, rtol=1e-3, atol=1e-5)
