"""Encoders side by side."""

import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from fprf.plugins.encoders.composed import UNITS, ConcatEncoder, unit_of
from fprf.plugins.encoders.config import (
    SEMANTICS,
    ConcatConfig,
    Dinov2Config,
    RandomConfig,
)
from fprf.plugins.encoders.frozen import street


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


def test_finer_parts_are_averaged_over_the_cells_of_the_first() -> None:
    image = torch.rand(2, 3, 48, 64)
    coarse, fine = RandomConfig(stride=8).build(), RandomConfig(stride=4, seed=1).build()
    found = ConcatEncoder([coarse, fine], (3.0, 0.5), (2.0, 4.0), cells="first")(image)
    torch.testing.assert_close(found, torch.cat([coarse(image) * 1.5, F.avg_pool2d(fine(image), 2) * 0.125], dim=1))
    turned = ConcatEncoder([fine, coarse], (1.0, 1.0), (1.0, 1.0), cells="first")(image)
    torch.testing.assert_close(turned[:, 16:], F.interpolate(coarse(image), (12, 16), mode="bilinear"))


def test_the_finest_of_each_axis_counts() -> None:
    """Cells of 6 and 5 pixels on a strip: neither part decides both axes alone."""
    encoder = ConcatConfig(first=RandomConfig(stride=6), second=RandomConfig(stride=5), third=RandomConfig(stride=30)).build()
    assert encoder(torch.rand(1, 3, 31, 7)).shape[2:] == (7, 2)


def test_known_units_are_those_measured() -> None:
    parts = [part.build() for part in (SEMANTICS.first, SEMANTICS.second)]
    assert [UNITS[part.identity] for part in parts] == [pytest.approx(unit_of(part, street()), rel=0.01) for part in parts]
    assert len(UNITS) == len(parts)


def test_cut_out_pictures_are_seen_on_white_and_black() -> None:
    image, opacity = torch.rand(2, 3, 16, 24), torch.rand(2, 16, 24)
    encoder, drawn = RandomConfig(stride=4).build(), image * opacity[:, None]
    on_white = drawn + 1 - opacity[:, None]
    torch.testing.assert_close(encoder.cutout(drawn, opacity), (encoder(on_white) + encoder(drawn)) / 2)


def test_each_part_cuts_out_as_it_can() -> None:
    image, opacity = torch.rand(1, 3, 70, 98), torch.zeros(1, 70, 98)
    opacity[:, 20:50, 30:60] = 1
    parts = [Dinov2Config(layer=1, stride=14).build(), RandomConfig(stride=7).build()]
    found = ConcatEncoder(parts, (3.0, 0.5), (2.0, 4.0), cells="first").cutout(image * opacity, opacity)
    tokens, random = (part.cutout(image * opacity, opacity) for part in parts)
    torch.testing.assert_close(found, torch.cat([tokens * 1.5, F.avg_pool2d(random, 2) * 0.125], dim=1))
