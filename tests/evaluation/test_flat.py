import pytest
import torch
from torch import Tensor

from benchmarks.styles import cells_basis, flat_reference, painted
from fprf.datamanagers.config import GuidedConfig
from fprf.evaluation.metrics import psnr
from fprf.evaluation.single_image import Flat, encoded, flat_scene, render_flat
from fprf.interfaces import Decoder, Encoder
from fprf.plugins.decoders.config import MlpDecoderConfig
from fprf.plugins.encoders.config import BundledContentConfig, RandomConfig
from fprf.plugins.stylizers.config import AdainConfig, RegionAdainConfig, RegionOtConfig, StylizerConfig
from fprf.style.dictionary import build_dictionary
from fprf.style.look import Restyle
from fprf.style.scene import own_style

GUIDED = GuidedConfig()
TWO_SIDED = [RegionAdainConfig(), RegionOtConfig()]


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


@pytest.fixture(scope="module")
def scene(content: Encoder) -> Flat:
    image = photo(0)
    semantic = RandomConfig(channels=8).build()
    basis = cells_basis(image, semantic, 4)
    return flat_scene(encoded(image, content, GUIDED), encoded(image, semantic, GUIDED, basis), (40, 56), regions=3)


@pytest.mark.parametrize("config", [AdainConfig(), *TWO_SIDED])
def test_a_photographs_own_style_returns_it(scene: Flat, decoder: Decoder, config: StylizerConfig) -> None:
    stylizer = config.build(dictionary=own_style(scene.style), scene=scene.style)
    plain = decoder(scene.content).reshape(40, 56, 3)
    assert psnr(render_flat(scene, Restyle(stylizer), decoder), plain) > 40
    assert psnr(plain, photo(0)) > 15  # such colours are none that the decoder has met


def test_strength_zero_is_the_decoded_photograph(scene: Flat, decoder: Decoder, content: Encoder) -> None:
    other = flat_reference("other", encoded(photo(1), content, GUIDED), None)
    bare = scene._replace(semantic=None, style=flat_scene(scene.content, None, (40, 56)).style)
    stylizer = AdainConfig().build(dictionary=build_dictionary([other]), scene=bare.style)
    with torch.inference_mode():  # as in rendering: kernels and gradients round differently
        plain = decoder(scene.content).reshape(40, 56, 3)
    assert render_flat(bare, Restyle(stylizer, 0.0), decoder).equal(plain)
    assert psnr(render_flat(bare, Restyle(stylizer), decoder), plain) < 40


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
