"""Colour signals of photographs and videos to sRGB: other primaries, other curves, high dynamic range.

Signals are nonlinear RGB in [0, 1], arrays [... 3] in the order red, green, blue. Light is linear, 1 is the
white of a sheet of paper (reference white). Numbers of primaries and curves are the code points of ITU-T
H.273 (ISO/IEC 23091-2), which PNG's cICP, AVIF's and HEIC's nclx and videos share.

- PQ (SMPTE ST 2084, ITU-R BT.2100 table 4) says how bright the display is, in cd/m2; reference white lies at
  203 (ITU-R BT.2408).
- HLG (ITU-R BT.2100 table 5) says how bright the scene is; reference white lies at 75 % of the signal
  (BT.2408). BT.2100 gives a display its system gamma by its brightness, BT.2390 extends that: 1 at 301 cd/m2,
  which is about what sRGB is looked at with. So none is applied, and scene and sRGB keep one contrast.
- The curves of BT.709, BT.601 and BT.2020 count as sRGB's, as browsers and players show them: pictures that
  say one or the other are made on the same displays.

Light above white is compressed by `tone_mapped`, in the source's own primaries, as far as it goes over 0.9:
what is no brighter than that keeps its colour exactly. Colours beyond the gamut of sRGB are clipped channel by
channel in linear light, as LittleCMS does with the ICC profiles of photographs.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

Curve: TypeAlias = Literal["srgb", "power", "linear", "smpte240", "pq", "hlg"]
Chromaticities: TypeAlias = tuple[
    tuple[float, float], tuple[float, float], tuple[float, float], tuple[float, float]
]
"""CIE 1931 x, y of red, green, blue and white."""

REFERENCE_WHITE_NITS = 203.0
"""cd/m2 of a white sheet in PQ (ITU-R BT.2408, table 1)."""
REFERENCE_WHITE_HLG = 0.75
"""Signal of a white sheet in HLG (ITU-R BT.2408, table 1)."""
PQ_PEAK_NITS = 10_000.0
"""cd/m2 of the PQ signal 1 (ITU-R BT.2100, table 4)."""
KNEE_LIGHT = 0.9
"""Light up to which nothing is compressed. By eye; white becomes 251 of 255, and is told from what is
brighter."""

D65 = (0.3127, 0.3290)
"""White of sRGB."""
BT709: Chromaticities = ((0.640, 0.330), (0.300, 0.600), (0.150, 0.060), D65)
"""Primaries of BT.709 and sRGB."""
BT2020: Chromaticities = ((0.708, 0.292), (0.170, 0.797), (0.131, 0.046), D65)
"""Primaries of BT.2020 and BT.2100."""
DISPLAY_P3: Chromaticities = ((0.680, 0.320), (0.265, 0.690), (0.150, 0.060), D65)
"""Primaries of SMPTE EG 432-1, which phones use."""
ADOBE_RGB: Chromaticities = ((0.640, 0.330), (0.210, 0.710), (0.150, 0.060), D65)
"""Primaries of Adobe RGB (1998)."""
ADOBE_GAMMA = 563 / 256
"""Exponent of Adobe RGB (1998), section 4.3.4.2."""

_ILLUMINANT_C = (0.310, 0.316)
"""White of BT.470 System M and of generic film (H.273, table 2)."""
_SMPTE170: Chromaticities = ((0.630, 0.340), (0.310, 0.595), (0.155, 0.070), D65)
"""Primaries of SMPTE ST 170 and ST 240, which H.273 numbers 6 and 7."""
PRIMARIES: dict[int, Chromaticities] = {
    1: BT709,
    4: ((0.67, 0.33), (0.21, 0.71), (0.14, 0.08), _ILLUMINANT_C),  # BT.470 M
    5: ((0.64, 0.33), (0.29, 0.60), (0.15, 0.06), D65),  # BT.470 BG, BT.601 with 625 lines
    6: _SMPTE170,  # BT.601 with 525 lines
    7: _SMPTE170,  # SMPTE ST 240, the same
    8: ((0.681, 0.319), (0.243, 0.692), (0.145, 0.049), _ILLUMINANT_C),  # film
    9: BT2020,
    10: ((1.0, 0.0), (0.0, 1.0), (0.0, 0.0), (1 / 3, 1 / 3)),  # CIE XYZ, SMPTE ST 428-1
    11: ((0.680, 0.320), (0.265, 0.690), (0.150, 0.060), (0.314, 0.351)),  # P3 of cinemas, SMPTE RP 431-2
    12: DISPLAY_P3,
    22: ((0.630, 0.340), (0.295, 0.605), (0.155, 0.077), D65),  # EBU Tech 3213-E
}
"""Primaries by their code point (H.273, table 2). 2 is unspecified, others are reserved."""
CURVES: dict[int, tuple[Curve, float]] = {
    1: ("srgb", 1.0),  # BT.709
    4: ("power", 2.2),  # BT.470 M
    5: ("power", 2.8),  # BT.470 BG
    6: ("srgb", 1.0),  # BT.601
    7: ("smpte240", 1.0),
    8: ("linear", 1.0),
    11: ("srgb", 1.0),  # xvYCC, within [0, 1]
    12: ("srgb", 1.0),  # BT.1361, within [0, 1]
    13: ("srgb", 1.0),
    14: ("srgb", 1.0),  # BT.2020, 10 bits
    15: ("srgb", 1.0),  # BT.2020, 12 bits
    16: ("pq", 1.0),
    17: ("power", 2.6),  # SMPTE ST 428-1, white at 48 of 52.37 cd/m2
    18: ("hlg", 1.0),
}
"""Curve, and exponent of a power, by its code point (H.273, table 3). 2 is unspecified; 9 and 10 are
logarithms without a white; others are reserved."""
UNSPECIFIED = 2
"""Code point of primaries and curves that a file leaves open: sRGB's."""

_CINEMA_WHITE = 48 / 52.37
"""Light of white in SMPTE ST 428-1, of the signal 1."""
_BRADFORD = ((0.8951, 0.2664, -0.1614), (-0.7502, 1.7135, 0.0367), (0.0389, -0.0685, 1.0296))
"""XYZ to the cone responses in which whites are adapted (ICC.1:2022, annex E)."""
_SRGB_LEVELS = 1 << 16
"""Steps of light in [0, 1] that are told apart on the way to 8 bits: at most a twentieth of a level."""
_ROWS_AT_ONCE = 256
"""Rows converted at a time: bounds the memory."""


@dataclass(frozen=True, kw_only=True)
class ColourSpace:
    """Meaning of RGB signals."""

    primaries: Chromaticities = BT709
    """CIE 1931 x, y of red, green, blue and white."""
    curve: Curve = "srgb"
    """Curve of the signal."""
    gamma: float = 1.0
    """Exponent of the curve "power"; above 0."""
    white: float = 1.0
    """Light of the signal 1 of the curve "power" is 1 over this."""

    @property
    def high_dynamic_range(self) -> bool:
        """True for PQ and HLG, whose light goes over white."""
        return self.curve in ("pq", "hlg")


SRGB = ColourSpace()
"""IEC 61966-2-1."""


def colour_space(primaries: int, curve: int) -> ColourSpace | None:
    """The colour space of two code points (H.273); unspecified ones are sRGB's. None for what is reserved, and
    for logarithms.
    """
    chromaticities = PRIMARIES.get(1 if primaries == UNSPECIFIED else primaries)
    shape = CURVES.get(13 if curve == UNSPECIFIED else curve)
    if chromaticities is None or shape is None:
        return None
    white = _CINEMA_WHITE if curve == 17 else 1.0
    return ColourSpace(primaries=chromaticities, curve=shape[0], gamma=shape[1], white=white)


def pq_light(signal: NDArray[np.floating]) -> NDArray[np.floating]:
    """Light of PQ signals (BT.2100, table 4: the EOTF), of which 1 is reference white."""
    power = signal ** (32 / 2523)  # 1 / m2
    above = np.maximum(power - 3424 / 4096, 0)  # c1
    nits = PQ_PEAK_NITS * (above / (2413 / 128 - 2392 / 128 * power)) ** (8192 / 1305)  # c2, c3, 1 / m1
    return np.asarray(nits / REFERENCE_WHITE_NITS)


def hlg_light(signal: NDArray[np.floating]) -> NDArray[np.floating]:
    """Light of HLG signals (BT.2100, table 5: the inverse OETF), of which 1 is reference white."""
    return _hlg_scene(signal) / _hlg_scene(np.float64(REFERENCE_WHITE_HLG))


def _hlg_scene(signal: NDArray[np.floating] | np.float64) -> NDArray[np.floating]:
    """Light of the scene in [0, 1] of HLG signals."""
    a = 0.17883277
    b = 1 - 4 * a
    c = 0.5 - a * np.log(4 * a)
    return np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - c) / a) + b) / 12)


def light_of(signal: NDArray[np.floating], space: ColourSpace) -> NDArray[np.floating]:
    """Light of signals in [0, 1] by the curve of a colour space, in float64."""
    values = np.asarray(signal, dtype=np.float64)
    if space.curve == "pq":
        return pq_light(values)
    if space.curve == "hlg":
        return hlg_light(values)
    if space.curve == "srgb":
        return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    if space.curve == "smpte240":
        return np.where(values < 0.0912, values / 4, ((values + 0.1115) / 1.1115) ** (1 / 0.45))
    if space.curve == "power":
        return np.asarray(values**space.gamma / space.white)
    return values


def srgb_signal(light: NDArray[np.floating]) -> NDArray[np.floating]:
    """The sRGB signal of light in [0, 1] (IEC 61966-2-1)."""
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def tone_mapped(light: Annotated[NDArray[np.floating], "... 3"]) -> Annotated[NDArray[np.floating], "... 3"]:
    """Light of any brightness as light of at most 1, with its hue.

    The largest channel m becomes m up to the knee k, and above it k + (1 - k) (1 - exp(-(m - k) / (1 - k))),
    which goes on with the slope 1 and ends at 1; the others are scaled with it (ITU-R BT.2390, section 5.4,
    calls this maxRGB).
    """
    largest = np.maximum(light.max(-1, keepdims=True), KNEE_LIGHT)
    over = (largest - KNEE_LIGHT) / (1 - KNEE_LIGHT)
    mapped = KNEE_LIGHT - (1 - KNEE_LIGHT) * np.expm1(-over)
    return np.asarray(light * (mapped / largest))


def to_srgb(
    signal: Annotated[NDArray[np.floating], "... 3"], space: ColourSpace
) -> Annotated[NDArray[np.floating], "... 3"]:
    """Signals of a colour space in [0, 1] as sRGB in [0, 1], in float64: the definition that `picture_of`
    follows.
    """
    light = light_of(signal, space)
    if space.high_dynamic_range:
        light = tone_mapped(light)
    return srgb_signal((light @ _matrix(space.primaries).T).clip(0, 1))


def picture_of(
    levels: Annotated[NDArray[np.uint8] | NDArray[np.uint16], "H W 3"],
    space: ColourSpace,
    *,
    largest: int,
    full_range: bool = True,
) -> Annotated[NDArray[np.uint8], "H W 3"]:
    """The sRGB picture of whole numbers from 0 to `largest` (255, 1023, 65535).

    `full_range` false: black and white lie at 16 and 235 of 255, and what is beyond counts as these.
    """
    light_table = _light_table(space, largest, full_range)
    signal_table = _signal_table()
    matrix = _matrix(space.primaries).T.astype(np.float32)
    picture = np.empty(levels.shape, dtype=np.uint8)
    for top in range(0, len(levels), _ROWS_AT_ONCE):
        light = light_table[levels[top : top + _ROWS_AT_ONCE]]
        if space.high_dynamic_range and light.max() > KNEE_LIGHT:
            light = tone_mapped(light)
        steps = ((light @ matrix).clip(0, 1) * np.float32(_SRGB_LEVELS - 1) + np.float32(0.5)).astype(
            np.uint16
        )
        picture[top : top + _ROWS_AT_ONCE] = signal_table[steps]
    return picture


@lru_cache(maxsize=8)
def _light_table(space: ColourSpace, largest: int, full_range: bool) -> NDArray[np.float32]:
    """Light of each whole number."""
    signal = np.arange(largest + 1) / largest
    if not full_range:
        # BT.2100, table 9: of n bits black is 16 and white 235, times 2^(n - 8).
        unit = 256 / (largest + 1)
        signal = ((np.arange(largest + 1) * unit - 16) / 219).clip(0, 1)
    return light_of(signal, space).astype(np.float32)


@lru_cache(maxsize=1)
def _signal_table() -> NDArray[np.uint8]:
    """The sRGB signal, in 8 bits, of each step of light."""
    signal = srgb_signal(np.arange(_SRGB_LEVELS) / (_SRGB_LEVELS - 1))
    return np.asarray(np.rint(signal * 255), dtype=np.uint8)


@lru_cache(maxsize=16)
def _matrix(primaries: Chromaticities) -> Annotated[NDArray[np.float64], "3 3"]:
    """Light of primaries to that of sRGB; whites are adapted by Bradford's method."""
    if primaries == BT709:
        return np.eye(3)
    source = rgb_to_xyz(primaries)
    own = rgb_to_xyz(BT709)
    bradford = np.array(_BRADFORD)
    gain = (bradford @ own.sum(1)) / (bradford @ source.sum(1))
    adapted = np.linalg.inv(bradford) @ np.diag(gain) @ bradford
    return np.asarray(np.linalg.inv(own) @ adapted @ source)


def rgb_to_xyz(primaries: Chromaticities) -> Annotated[NDArray[np.float64], "3 3"]:
    """Light of primaries to CIE XYZ, of which white has Y = 1 (SMPTE RP 177)."""
    columns = []
    for x, y in primaries:
        columns.append((x, y, 1 - x - y))
    red_green_blue = np.array(columns[:3]).T
    white = np.array(columns[3]) / primaries[3][1]
    return np.asarray(red_green_blue * np.linalg.solve(red_green_blue, white))
