"""Colour signals to sRGB, against values of the standards and a second way of computing them, in float64."""

import numpy as np
import pytest

from fprf.io.transfer import (
    BT709,
    CURVES,
    DISPLAY_P3,
    PRIMARIES,
    ColourSpace,
    colour_space,
    hlg_light,
    picture_of,
    pq_light,
    rgb_to_xyz,
    srgb_signal,
    to_srgb,
    tone_mapped,
)

PQ = ColourSpace(curve="pq")
HLG = ColourSpace(curve="hlg")


def pq_signal(nits: np.ndarray) -> np.ndarray:
    """BT.2100, table 4: the inverse EOTF."""
    m1, m2 = 2610 / 16384, 2523 / 4096 * 128
    c1, c2, c3 = 3424 / 4096, 2413 / 4096 * 32, 2392 / 4096 * 32
    y = (nits / 10000) ** m1
    return ((c1 + c2 * y) / (1 + c3 * y)) ** m2


def hlg_signal(scene: np.ndarray) -> np.ndarray:
    """BT.2100, table 5: the OETF."""
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    return np.where(scene <= 1 / 12, (3 * scene) ** 0.5, a * np.log(np.maximum(12 * scene - b, 1e-9)) + c)


def test_light_is_what_the_standards_say() -> None:
    nits = np.array([0.0, 0.005, 0.1, 1, 10, 100, 203, 1000, 4000, 10000])
    assert pq_light(pq_signal(nits)) * 203 == pytest.approx(nits, rel=1e-9, abs=1e-6)
    # BT.2408, table 1: 203 cd/m2 are 58 % of PQ and 75 % of HLG.
    assert pq_signal(np.array(203.0)) == pytest.approx(0.58, abs=0.001)
    assert hlg_light(np.array([0.0, 0.5, 0.75])) == pytest.approx([0, 1 / 12 / 0.26496, 1], abs=1e-4)
    scene = np.linspace(0, 1, 41)
    assert hlg_light(hlg_signal(scene)) == pytest.approx(scene / 0.2649626, rel=1e-6, abs=1e-9)


def test_matrices_are_those_of_the_standards() -> None:
    # BT.709 and BT.2087, table 4 (its inverse is printed with four digits); SMPTE RP 177 of P3.
    assert rgb_to_xyz(BT709)[1] == pytest.approx([0.2126, 0.7152, 0.0722], abs=5e-5)
    assert rgb_to_xyz(PRIMARIES[9])[1] == pytest.approx([0.2627, 0.6780, 0.0593], abs=5e-5)
    light = np.array([[0.6274, 0.0691, 0.0164], [0.3293, 0.9195, 0.0880], [0.0433, 0.0114, 0.8956]])
    linear = colour_space(9, 8)
    assert linear is not None
    assert to_srgb(light, linear) == pytest.approx(np.eye(3), abs=0.015)
    grey = np.full((1, 3), 0.4)
    for code in PRIMARIES:  # whites are adapted
        space = colour_space(code, 13)
        assert space is not None
        assert to_srgb(grey, space) == pytest.approx(grey, abs=1e-6), code


def test_colours_of_other_primaries_keep_their_chromaticity() -> None:
    srgb = np.random.default_rng(0).uniform(0.05, 0.95, (200, 3))
    light = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    for name, primaries in (("P3", DISPLAY_P3), ("BT.2020", PRIMARIES[9])):
        wide = light @ (np.linalg.inv(rgb_to_xyz(primaries)) @ rgb_to_xyz(BT709)).T
        assert to_srgb(srgb_signal(wide), ColourSpace(primaries=primaries)) == pytest.approx(
            srgb, abs=1e-6
        ), name
        dim = wide * 0.85  # below the knee nothing is compressed
        for curve, signal in (("pq", pq_signal(dim * 203)), ("hlg", hlg_signal(dim * 0.2649626))):
            there = to_srgb(signal, ColourSpace(primaries=primaries, curve=curve))
            assert there == pytest.approx(srgb_signal(light * 0.85), abs=2e-5), (name, curve)


def test_colours_out_of_gamut_are_clipped_channel_by_channel() -> None:
    red = to_srgb(np.array([[1.0, 0, 0]]), ColourSpace(primaries=DISPLAY_P3))
    assert red == pytest.approx(np.array([[1.0, 0, 0]]))


def test_tone_mapping_keeps_hue_and_order_and_ends_at_white() -> None:
    grey = np.linspace(0, 50, 5001)[:, None].repeat(3, 1)
    mapped = tone_mapped(grey)[:, 0]
    assert np.array_equal(mapped[:90], grey[:90, 0])
    assert np.diff(mapped).min() > -1e-12 and 0.99 < mapped[-1] < 1 + 1e-12
    slope = np.diff(mapped) / 0.01
    assert np.abs(np.diff(slope)).max() < 0.11, "no edge"
    orange = np.array([4.0, 2.0, 1.0])
    assert tone_mapped(orange) == pytest.approx(orange / 4, rel=1e-6)
    white = to_srgb(np.full((1, 3), pq_signal(np.array(203.0))), PQ)
    assert white[0, 0] * 255 == pytest.approx(250.83, abs=0.01)


@pytest.mark.parametrize("bits", [8, 10, 16])
@pytest.mark.parametrize("code", [(12, 13), (9, 16), (9, 18), (9, 14), (11, 17), (4, 4), (7, 7)])
def test_whole_numbers_become_the_nearest_of_8_bits(bits: int, code: tuple[int, int]) -> None:
    space = colour_space(*code)
    assert space is not None
    largest = 2**bits - 1
    levels = np.random.default_rng(1).integers(0, largest + 1, (40, 50, 3)).astype(np.uint16)
    exact = to_srgb(levels / largest, space) * 255
    assert np.abs(picture_of(levels, space, largest=largest) - exact).max() < 0.56
    narrow = picture_of(levels, space, largest=largest, full_range=False)
    unit = 2 ** (bits - 8)
    signal = ((levels / unit - 16) / 219).clip(0, 1)
    assert np.abs(narrow - to_srgb(signal, space) * 255).max() < 0.56


def test_reserved_code_points_and_logarithms_are_no_colour_space() -> None:
    assert colour_space(2, 2) == ColourSpace()
    for primaries, curve in ((0, 13), (3, 13), (23, 13), (1, 0), (1, 3), (1, 9), (1, 10), (1, 19), (1, 255)):
        assert colour_space(primaries, curve) is None
    assert all(colour_space(1, curve) is not None for curve in CURVES)
