"""Averages over mirrored and resized images."""

from typing import Annotated

import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from fprf.interfaces import Encoder
from fprf.plugins.encoders.composed import AveragedEncoder, ConcatEncoder
from fprf.plugins.encoders.config import (
    AveragedConfig,
    ConcatConfig,
    RandomConfig,
)
from fprf.plugins.encoders.frozen import street


class Slope(Encoder):
    """Brightness of every fourth pixel, plus how far to the left its cell lies: as one-sided as can be."""

    @property
    def identity(self) -> str:
        return "slope"

    @property
    def channels(self) -> int:
        return 1

    def forward(self, image: Annotated[Tensor, "B 3 H W"]) -> Annotated[Tensor, "B C h w"]:
        cells = image.mean(1, keepdim=True)[..., ::4, ::4]
        return cells + torch.arange(cells.shape[-1]).to(cells)


@settings(max_examples=15, deadline=None)
@given(st.integers(1, 40), st.integers(1, 40), st.sampled_from([(1.0,), (1.0, 1.5), (0.5, 2.0)]))
def test_a_mirrored_image_has_mirrored_features(height: int, width: int, scales: tuple[float, ...]) -> None:
    encoder = AveragedConfig(inner=RandomConfig(stride=3), scales=scales).build()
    image = torch.rand(1, 3, height, width)
    torch.testing.assert_close(encoder(image.flip(-1)), encoder(image).flip(-1))


def test_a_flip_is_the_mean_of_both_looks() -> None:
    image, inner = torch.rand(2, 3, 8, 12), Slope()
    encoder = AveragedEncoder(inner, flip=True, scales=(1.0,))
    brightness = (image[..., ::4, ::4].mean(1, keepdim=True) + image.flip(-1)[..., ::4, ::4].mean(1, keepdim=True).flip(-1)) / 2
    torch.testing.assert_close(encoder(image), brightness + 1)  # cells lie at 0, 1, 2: at 1 on average
    plain = AveragedEncoder(inner, flip=False, scales=(1.0,))
    assert torch.equal(plain(image), inner(image))


def test_sizes_meet_on_the_finest_ones_cells() -> None:
    image, inner = torch.rand(1, 3, 32, 48), RandomConfig(stride=4).build()
    both = AveragedEncoder(inner, flip=False, scales=(0.5, 1.0))(image)
    small = F.interpolate(image, (16, 24), mode="bilinear", antialias=True)
    coarse = F.interpolate(inner(small), (8, 12), mode="bilinear")
    torch.testing.assert_close(both, (coarse + inner(image)) / 2)


def length(features: Tensor) -> Tensor:
    """Root mean square length about the mean."""
    return (features - features.mean((0, 2, 3), keepdim=True)).square().sum(1).mean().sqrt()


@settings(max_examples=10, deadline=None)
@given(st.floats(0.05, 20), st.floats(0.05, 20), st.integers(1, 40), st.integers(1, 40))
def test_each_part_has_the_length_of_its_weight(first: float, second: float, few: int, many: int) -> None:
    parts = (RandomConfig(channels=few, stride=8), RandomConfig(channels=many, seed=1))
    encoder = ConcatConfig(first=parts[0], second=parts[1], weights=(first, second)).build()
    assert encoder.channels == few + many
    found = encoder(street())
    # The unit is kept to three digits, and the coarser part loses a little where it is interpolated.
    torch.testing.assert_close(length(found[:, few:]), torch.tensor(second), rtol=6e-3, atol=0)
    assert 0.6 * first < float(length(found[:, :few])) <= first * 1.01


def test_parts_are_their_encoders_to_a_factor() -> None:
    image = torch.rand(2, 3, 40, 56)
    parts = [RandomConfig(stride=8).build(), RandomConfig(stride=4, seed=1).build()]
    found = ConcatEncoder(parts, (3.0, 0.5), (2.0, 4.0))(image)
    coarse = F.interpolate(parts[0](image), (10, 14), mode="bilinear") * 1.5
    torch.testing.assert_close(found, torch.cat([coarse, parts[1](image) * 0.125], dim=1))


def test_the_finest_of_each_axis_counts() -> None:
    """Cells of 6 and 5 pixels on a strip: neither part decides both axes alone."""
    encoder = ConcatConfig(first=RandomConfig(stride=6), second=RandomConfig(stride=5), third=RandomConfig(stride=30)).build()
    assert encoder(torch.rand(1, 3, 31, 7)).shape[2:] == (7, 2)
