"""Pictures restyled one by one: flat scenes, global transfers."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kornia.color import rgb_to_lab
from torch import Tensor

from benchmarks.single_image import histogram_matching, reinhard
from fprf.interfaces import Encoder
from fprf.plugins.encoders.config import BundledContentConfig


@pytest.fixture(scope="module")
def content() -> Encoder:
    return BundledContentConfig().build()


def colours(count: int, seed: int, low: float = 0.3, high: float = 0.7) -> Tensor:
    return low + (high - low) * torch.rand(count, 3, generator=torch.Generator().manual_seed(seed))


def lab(x: Tensor) -> Tensor:
    return rgb_to_lab(x.T.reshape(1, 3, -1, 1))[0, :, :, 0].T


@given(st.integers(0, 1000), st.integers(20, 200), st.integers(20, 200))
def test_reinhard_takes_mean_and_deviation(seed: int, n: int, m: int) -> None:
    content, style = colours(n, seed), colours(m, seed + 1, 0.4, 0.6)
    there, found = lab(style), lab(reinhard(content, style))
    assert torch.allclose(found.mean(0), there.mean(0), atol=0.05)
    assert torch.allclose(found.std(0, correction=0), there.std(0, correction=0), atol=0.05)


@given(st.integers(0, 1000), st.integers(1, 40), st.integers(1, 40))
def test_ranks_are_those_of_numpys_quantiles(seed: int, n: int, m: int) -> None:
    content, style = colours(n, seed, 0, 1).double(), colours(m, seed + 1, 0, 1).double()
    found = histogram_matching(content, style)
    for channel in range(3):
        rank = (np.argsort(np.argsort(content[:, channel].numpy())) + 0.5) / n
        wanted = np.quantile(style[:, channel].numpy(), rank, method="hazen")
        assert np.allclose(found[:, channel].numpy(), wanted, atol=1e-12)
