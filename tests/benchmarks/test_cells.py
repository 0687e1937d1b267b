"""Styles without clusters: which cell a pixel lies in, and what its code is made of."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tiny_world import World

from benchmarks.paper_styles import CELL, cell_dictionary, cells
from fprf.errors import DataError
from fprf.evaluation.single_image import encoded
from fprf.style.dictionary import StyleDictionary, whole_style
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


def test_references_keep_their_order_and_their_shares(world: World, encoders: Encoders) -> None:
    d = made(world, encoders, a=image(16, 16), b=image(24, 17, 1))
    assert d.names == ("a", "b") and d.reference.tolist() == [0] * 4 + [1] * 6
    for k in range(2):
        assert float(d.share[d.reference == k].sum()) == pytest.approx(1)
    assert float(d.share[4:].max()) > float(d.share[4:].min()), "the last column is nine pixels wide"
    assert d.blend == 0.1 and bool((d.weight == 1).all())


def test_cells_together_are_the_whole_photograph(world: World, encoders: Encoders) -> None:
    picture = image(24, 32, 3)
    values = encoded(picture, encoders.content, world.load().config.datamanager.guided).double()
    for blend in (0.0, 0.4):
        mean, spread = whole_style(made(world, encoders, blend, a=picture))
        torch.testing.assert_close(mean, values.mean(0), rtol=1e-4, atol=1e-4)
        torch.testing.assert_close(spread, torch.cov(values.T, correction=0), rtol=1e-3, atol=1e-3)


def test_full_blend_leaves_one_style(world: World, encoders: Encoders) -> None:
    d = made(world, encoders, 1.0, a=image(24, 32))
    torch.testing.assert_close(d.mean, d.mean[:1].expand_as(d.mean))
    torch.testing.assert_close(d.covariance, d.covariance[:1].expand_as(d.covariance))
    assert float((d.keys - d.keys[0]).abs().max()) > 0.01, "they are still told apart"


def test_scenes_without_semantics_have_no_cells(world: World, encoders: Encoders) -> None:
    for missing in (encoders._replace(semantic=None), encoders._replace(basis=None)):
        with pytest.raises(DataError, match="no semantics"):
            cell_dictionary({"a": image(16, 16)}, world.load(), missing)
