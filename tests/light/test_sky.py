"""Lights by the sun's elevation, and colours as flags say them."""

import pytest
import torch

from fprf.errors import ConfigError
from fprf.light.config import SunConfig, parse_light_colour
from fprf.light.sky import kelvin_colour, light_of, sun_colour


def test_a_sun_is_dimmer_and_redder_the_lower_it_stands() -> None:
    before = None
    for elevation in (60.0, 30.0, 10.0, 3.0):
        light = light_of(SunConfig(sun=(0.0, elevation)))
        if before is not None:
            assert float(light.sun[1]) < float(before.sun[1])
            assert float(light.sun[0] / light.sun[2]) > float(before.sun[0] / before.sun[2])
        before = light
    assert float(sun_colour(5.0) @ torch.tensor([0.2126, 0.7152, 0.0722])) == pytest.approx(1.0)


def test_black_bodies_are_red_below_white_and_blue_above() -> None:
    red, _, blue = kelvin_colour(2500.0).tolist()
    assert red > 1.4 and blue < 0.4
    assert torch.allclose(kelvin_colour(6504.0), torch.ones(3), atol=0.06)
    red, _, blue = kelvin_colour(15000.0).tolist()
    assert red < 0.9 and blue > 1.3


@pytest.mark.parametrize("text", ["", "sun", "#12345", "900K", "-3", "30000K", "#gggggg"])
def test_other_texts_are_no_colours(text: str) -> None:
    with pytest.raises(ConfigError, match="sun_colour"):
        parse_light_colour("sun_colour", text)


def test_colours_take_the_place_of_the_lights_own() -> None:
    plain = light_of(SunConfig(light="noon"))
    coloured = light_of(SunConfig(light="noon", sun_colour="#ff8000", sky_colour="20000K"))
    luma = torch.tensor([0.2126, 0.7152, 0.0722])
    assert float(coloured.sun @ luma) == pytest.approx(float(plain.sun @ luma), rel=1e-5)
    assert float(coloured.sun[2]) < 0.1 * float(coloured.sun[0])
    assert float(coloured.sky[2] / coloured.sky[0]) > float(plain.sky[2] / plain.sky[0])
    assert parse_light_colour("sun_colour", "3500K") == 3500.0
