import math

import pytest
import torch
from fprf_gabor import GaborConfig
from fprf_gabor.bank import gabor_pair

from fprf.testing import check_encoder


def test_keeps_to_the_contract() -> None:
    check_encoder(GaborConfig())
    check_encoder(GaborConfig(orientations=3, wavelengths=(5.0,), stride=7))


@pytest.mark.parametrize("wavelength", [4.0, 8.0])
def test_a_filter_ignores_flat_images_and_has_unit_energy(wavelength: float) -> None:
    pair = gabor_pair(wavelength, 0.3, 25)
    assert pair.sum((1, 2)).abs().max() < 1e-5
    torch.testing.assert_close(pair.square().sum((1, 2)), torch.ones(2))


def test_stripes_wake_the_filter_of_their_own_direction() -> None:
    encoder = GaborConfig(orientations=4, wavelengths=(8.0,)).build()
    x = torch.arange(64.0)
    stripes = (0.5 + 0.4 * torch.cos(2 * math.pi * x / 8)).expand(1, 3, 64, 64)
    energy = encoder(stripes)[0, :4, 4:-4, 4:-4].mean((1, 2))
    assert int(energy.argmax()) == 0
    turned = encoder(stripes.mT)[0, :4, 4:-4, 4:-4].mean((1, 2))
    assert int(turned.argmax()) == 2
