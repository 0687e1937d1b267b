"""Pictures restyled one by one: flat scenes, global transfers."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kornia.color import rgb_to_lab
from torch import Tensor
from two_sided import region_adain

from benchmarks.single_image import encoded, flat_scene, histogram_matching, reinhard, render_flat
from benchmarks.styles import flat_reference, painted
from fprf.datamanagers.config import GuidedConfig
from fprf.interfaces import Decoder, Encoder
from fprf.plugins.decoders.config import MlpDecoderConfig
from fprf.plugins.encoders.config import BundledContentConfig
from fprf.plugins.stylizers.config import RegionOtConfig, StylizerConfig
from fprf.style.dictionary import build_dictionary
from fprf.style.look import Restyle

GUIDED = GuidedConfig()
TWO_SIDED = [region_adain(), RegionOtConfig()]


def photo(seed: int, height: int = 40, width: int = 56) -> Tensor:
    """Soft blobs: a sky and a ground with some texture."""
    draw = torch.Generator().manual_seed(seed)
    coarse = torch.rand(1, 3, 4, 5, generator=draw)
    smooth = torch.nn.functional.interpolate(coarse, (height, width), mode="bicubic").clamp(0.05, 0.95)[0]
    return smooth.permute(1, 2, 0).contiguous()


@pytest.fixture(scope="module")
def content() -> Encoder:
    return BundledContentConfig().build()


@pytest.fixture(scope="module")
def decoder(content: Encoder) -> Decoder:
    return MlpDecoderConfig().build(encoder=content.identity, channels=content.channels)


@pytest.mark.parametrize("config", TWO_SIDED)
def test_painted_regions_take_the_colours_of_their_like(content: Encoder, decoder: Decoder, config: StylizerConfig) -> None:
    """Left is 0 here and right is 0 there: each half must take the colour of the other half's place."""
    regions = (torch.arange(56) >= 28).long().expand(40, 56)
    image, style = 0.4 + 0.2 * photo(2), 0.2 * photo(3)
    style[:, :28] += torch.tensor([0.7, 0.2, 0.1])
    style[:, 28:] += torch.tensor([0.1, 0.2, 0.7])
    flat = flat_scene(encoded(image, content, GUIDED), painted(regions, 2, (40, 56)), (40, 56))
    there = painted(1 - regions, 2, (40, 56))
    reference = flat_reference("halves", encoded(style, content, GUIDED), there)
    assert len(flat.style.keys) == 2
    stylizer = config.build(dictionary=build_dictionary([reference], blend=0.0), scene=flat.style)
    found = render_flat(flat, Restyle(stylizer), decoder)
    for here, right, wrong in ((slice(4, 24), slice(32, 52), slice(4, 24)), (slice(32, 52), slice(4, 24), slice(32, 52))):
        colour = found[:, here].mean((0, 1))
        near, far = ((colour - style[:, part].mean((0, 1))).norm() for part in (right, wrong))
        assert near < 0.25 * far


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
