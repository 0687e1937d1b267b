import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kornia.color import rgb_to_lab
from torch import Tensor

from fprf.errors import DataError
from fprf.evaluation.single_image import histogram_matching, reinhard


def colours(count: int, seed: int, low: float = 0.3, high: float = 0.7) -> Tensor:
    return low + (high - low) * torch.rand(count, 3, generator=torch.Generator().manual_seed(seed))


def lab(x: Tensor) -> Tensor:
    return rgb_to_lab(x.T.reshape(1, 3, -1, 1))[0, :, :, 0].T


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 1000), st.integers(20, 200), st.integers(20, 200))
def test_reinhard_takes_mean_and_deviation(seed: int, n: int, m: int) -> None:
    content, style = colours(n, seed), colours(m, seed + 1, 0.4, 0.6)
    there, found = lab(style), lab(reinhard(content, style))
    assert torch.allclose(found.mean(0), there.mean(0), atol=0.05)
    assert torch.allclose(found.std(0, correction=0), there.std(0, correction=0), atol=0.05)


def test_reinhard_with_its_own_colours_changes_nothing() -> None:
    content = colours(300, 0, 0.0, 1.0)
    assert torch.allclose(reinhard(content, content), content, atol=2e-3)


def test_reinhard_of_one_colour_is_the_styles_mean() -> None:
    content, style = torch.full((50, 3), 0.5), colours(80, 1)
    found = reinhard(content, style)
    assert torch.allclose(lab(found), lab(style).mean(0).expand(50, 3), atol=0.05)
    assert bool(torch.isfinite(reinhard(style, content)).all())


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 1000), st.integers(1, 60))
def test_as_many_pixels_of_the_style_are_taken_over_as_they_are(seed: int, n: int) -> None:
    content, style = colours(n, seed, 0, 1), colours(n, seed + 1, 0, 1)
    found = histogram_matching(content, style)
    assert torch.allclose(found.sort(0).values, style.sort(0).values, atol=1e-6)
    for channel in range(3):
        order = content[:, channel].argsort()
        assert bool((found[order, channel].diff() >= 0).all())


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 1000), st.integers(1, 40), st.integers(1, 40))
def test_ranks_are_those_of_numpys_quantiles(seed: int, n: int, m: int) -> None:
    content, style = colours(n, seed, 0, 1).double(), colours(m, seed + 1, 0, 1).double()
    found = histogram_matching(content, style)
    for channel in range(3):
        rank = (np.argsort(np.argsort(content[:, channel].numpy())) + 0.5) / n
        wanted = np.quantile(style[:, channel].numpy(), rank, method="hazen")
        assert np.allclose(found[:, channel].numpy(), wanted, atol=1e-12)


@pytest.mark.parametrize("transfer", [reinhard, histogram_matching])
def test_no_pixels_are_refused(transfer: object) -> None:
    assert callable(transfer)
    with pytest.raises(DataError, match="0 pixels and 2 of the style"):
        transfer(torch.zeros(0, 3), torch.zeros(2, 3))
    with pytest.raises(DataError, match="at least one"):
        transfer(torch.zeros(2, 3), torch.zeros(0, 3))
