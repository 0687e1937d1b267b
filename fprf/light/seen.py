"""The sun that a photograph was taken in, from what it shows lit and shaded of one kind.

Across the border of a shadow a surface changes by the same factor in each channel, whatever it is: 1 + s, with the
sun's light s over the sky's. So places a few pixels apart are compared: of those that differ as the light of a sun
and a sky may (the sun is the warmer one), the change that most kinds of surfaces share is sought. A border between
two materials has a change of its own, which one kind shows alone, and is as often cooler where it is brighter. A
slope, such as that of haze, shows smaller changes more often than large ones; a shadow does not.

    f = (G, R - B, G - (R + B) / 2) of log change,      score(f) = sum over kinds of min(cap, sum of exp(-|f - f_i|^2 / 2))

with f in units of its deviations. Colours are brought before a camera's shoulder, as in `relight`.

Shapes: a photograph of H W pixels, P pairs of places, K kinds.
"""

import itertools
import math
from collections.abc import Sequence
from typing import Annotated, NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from .captured import scene_light
from .config import Colour
from .sky import LUMA

_LONGEST_PIXELS = 384
"""Longer side at which photographs are looked at: details of materials are smaller than their shadows."""
_STEP = 3
"""Pixels between places."""
_PLACE = 5
"""Pixels across a place."""
_MAX_PLACE_DEVIATION = 0.1
"""Of log luma within a place; others show borders."""
_OFFSETS = ((0, 3), (3, 0), (2, 2), (2, -2), (0, 5), (5, 0), (4, 4), (4, -4), (0, 8), (8, 0))
"""Rows and columns of places between the two of a pair."""
_ADDED_LIGHT = 0.003
"""Added to light before logarithms are taken: below lies noise. With 0.01 lit over shaded is a sixth too low."""
_MIN_LUMA = 0.012
"""Linear light of places that are compared."""
_MAX_VALUE = 0.97
"""sRGB of places that are compared: above it is cut off."""
_MIN_CHANGE = 0.12
"""Log change of green of pairs that are kept."""
_MIN_SUN_CHANGE = 0.33
"""Of pairs that may show a sun: smaller ones are mostly haze and textures."""
_MAX_SUN_CHANGE = 2.4
"""Largest one that is sought."""
_WARMTH = (1.55, 10.0)
"""Sun over sky in red, over the same in blue: 1.7 to 7 on towns; white marks on asphalt have 1.4."""
_MAX_TINT = 0.09
"""Deviation of log s of green from what a sun of that warmth has: towns have 0.02, their white marks 0.1 and more."""
_DEVIATIONS = np.array([0.10, 0.06, 0.04])
"""Of f, within which pairs agree (by eye)."""
_CAP = 25.0
"""Pairs of a kind that count."""
_KIND_SIZES = np.array([0.4, 0.2, 0.1])
"""Of kinds: of shaded luma and of both differences of colour, in logarithms."""
_COOLER_WEIGHT = 3.0
"""Of pairs that are cooler where they are brighter, against those that agree."""
_MIN_SCORE = 27.0
"""More than one kind has."""
_MIN_PEAK = 1.3
"""Score over that of smaller changes of the same hue: slopes have less than one."""
_SMALLER = (0.6, 0.7)
"""These, as shares of f."""
_CHANGE_ROUNDS = 6
"""Rounds in which the change moves to the mean of what agrees."""
_SKY_STEP = 3
"""Difference of neighbouring pixels of one sky, of 255."""
_MIN_SKY_LIGHT = 1.1
"""Luma of what reaches the upper border over that of the rest, from which on it is sky."""
_MIN_SKY_BLUE = 0.25
"""Log of blue over red of it, beyond that of the rest: a deep blue sky is no brighter than what the sun lights."""
_SKY_MARGIN = 7
"""Pixels around the sky that are left out."""
_VIEW_DEGREES = 60.0
"""Field of view that photographs are taken to have (by eye)."""
_BLOCKER_SHARE = 0.3
"""Distance of what casts a shadow from it, over that from the camera (by eye)."""
SHARP_DEGREES = 0.53
"""Diameter of the sun in a clear sky: no edge of a shadow is sharper."""
_SHARP_PIXELS = 1.0
"""Width of the sharpest edges."""
_MAX_DEGREES = 5.0
"""Largest one that is taken."""
_MIN_SINE = 0.5
"""Cosine to the sun of most that it lights, at least: a low sun is seen on walls."""
_LIGHT_OF_LUMA = np.array(LUMA, np.float32)

_Pixels = NDArray[np.float32]


class SeenSun(NamedTuple):
    """A sun as a photograph shows it."""

    strength: Colour
    """Its light on what it lights over the sky's, red, green and blue."""
    degrees: float
    """Diameter of a sun whose shadows are as soft."""
    score: float
    """Pairs of places that agree, not more than 25 of each kind."""


class _Pairs(NamedTuple):
    """Places that are compared."""

    changes: Annotated[_Pixels, "P 3"]
    """Logarithms of the brighter one over the other, linear light."""
    kinds: tuple[Annotated[NDArray[np.int64], "P"], ...]
    """By the colour of the darker one, in eight ways: what spans less than half a kind is within one in some."""
    middles: Annotated[NDArray[np.int64], "P 2"]
    """Row and column between the two, in pixels."""
    across: Annotated[NDArray[np.int64], "P 2"]
    """Rows and columns from the darker to the brighter one, in pixels."""


def seen_sun(photo: NDArray[np.uint8], shown: NDArray[np.bool_] | None = None) -> SeenSun | None:
    """The sun of a photograph [H W 3]; None where it shows too little lit and shaded of the same kinds.

    Only what is `shown` [H W] is looked at; None = all of it.
    """
    height, width = photo.shape[:2]
    scale = min(1.0, _LONGEST_PIXELS / max(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    small = np.asarray(cv2.resize(photo, size, interpolation=cv2.INTER_AREA), np.uint8)
    looked_at = ~_sky(small)
    if shown is not None:
        looked_at &= cv2.resize(shown.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    margin = np.ones((_SKY_MARGIN, _SKY_MARGIN))
    looked_at = cv2.erode(looked_at.astype(np.uint8), margin, borderValue=1) > 0
    light = _scene_light(small)
    pairs = _compared(small, light, looked_at)
    found = _shared_change(pairs)
    if found is None:
        return None
    feature, score, agreeing = found
    red_over_blue = feature[1]
    mean = feature[0] - feature[2]
    strength = np.expm1([mean + red_over_blue / 2, feature[0], mean - red_over_blue / 2])
    log_luma = np.log(light @ _LIGHT_OF_LUMA + _ADDED_LIGHT)
    degrees = _sun_degrees(log_luma, pairs, agreeing)
    return SeenSun((float(strength[0]), float(strength[1]), float(strength[2])), degrees, score)


def facing_strength(sun: SeenSun, elevation: float) -> Colour:
    """Light on a plane that faces the sun over that of the sky, where it stands at so many degrees."""
    facing = max(math.sin(math.radians(elevation)), _MIN_SINE)
    red, green, blue = sun.strength
    return (red / facing, green / facing, blue / facing)


def _scene_light(photo: NDArray[np.uint8]) -> _Pixels:
    """Linear light before a camera's shoulder."""
    light: _Pixels = scene_light(torch.from_numpy(photo) / 255).numpy()
    return light


def _sky(photo: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Pixels of the sky: what is smooth from the upper border on, and brighter or bluer than the rest."""
    height, width = photo.shape[:2]
    smooth = np.ascontiguousarray(cv2.blur(photo, (_PLACE, _PLACE)))
    filled = np.zeros((height + 2, width + 2), np.uint8)
    step = (_SKY_STEP,) * 3
    flags = 4 | cv2.FLOODFILL_MASK_ONLY | (255 << 8)
    for column in range(0, width, 2 * _STEP):
        if not filled[1, column + 1]:
            cv2.floodFill(smooth, filled, (column, 0), 0, step, step, flags)
    sky = filled[1:-1, 1:-1] > 0
    none: NDArray[np.bool_] = np.zeros_like(sky)
    if not sky.any() or sky.all():
        return none
    light = _scene_light(photo)
    luma = light @ _LIGHT_OF_LUMA
    blue = np.log((light[..., 2] + _ADDED_LIGHT) / (light[..., 0] + _ADDED_LIGHT))
    brighter = np.median(luma[sky]) > _MIN_SKY_LIGHT * np.median(luma[~sky])
    bluer = np.median(blue[sky]) > np.median(blue[~sky]) + _MIN_SKY_BLUE
    return sky if brighter or bluer else none


def _compared(photo: NDArray[np.uint8], light: _Pixels, looked_at: NDArray[np.bool_]) -> _Pairs:
    """Pairs of even places that differ in brightness."""
    luma = light @ _LIGHT_OF_LUMA
    told = looked_at & (photo.max(-1) < 255 * _MAX_VALUE) & (luma > _MIN_LUMA)
    log_luma = np.log(luma + _ADDED_LIGHT)
    place = (_PLACE, _PLACE)
    variance = cv2.blur(log_luma * log_luma, place) - cv2.blur(log_luma, place) ** 2
    told = cv2.erode(told.astype(np.uint8), np.ones(place)) > 0
    told = (told & (variance < _MAX_PLACE_DEVIATION**2))[::_STEP, ::_STEP]
    log_light = cv2.blur(np.log(light + _ADDED_LIGHT), place)[::_STEP, ::_STEP]
    rows, columns = told.shape
    changes = []
    darker = []
    middles = []
    across = []
    for down, right in _OFFSETS:
        first = (slice(0, max(0, rows - down)), slice(max(0, -right), max(0, columns - max(0, right))))
        second = (slice(down, None), slice(max(0, right), columns - max(0, -right)))
        change = log_light[second] - log_light[first]
        sign = np.sign(change[..., 1])
        good = told[first] & told[second] & (np.abs(change[..., 1]) > _MIN_CHANGE)
        at = np.argwhere(good) + np.array([0, max(0, -right)])
        brighter = sign[good][:, None]
        changes.append((change * sign[..., None])[good])
        darker.append(np.where(brighter > 0, log_light[first][good], log_light[second][good]))
        middles.append(_STEP * at + np.array([_STEP * down // 2, _STEP * right // 2]))
        across.append((brighter * (_STEP * down, _STEP * right)).astype(np.int64))
    shaded = np.concatenate(darker)
    tint = shaded[:, 1] - (shaded[:, 0] + shaded[:, 2]) / 2
    place = np.stack([shaded @ _LIGHT_OF_LUMA, shaded[:, 0] - shaded[:, 2], tint], 1) / _KIND_SIZES
    kinds = tuple(_numbered(place + np.array(moved)) for moved in itertools.product((0.0, 0.5), repeat=3))
    return _Pairs(np.concatenate(changes), kinds, np.concatenate(middles), np.concatenate(across))


def _numbered(place: NDArray[np.floating]) -> Annotated[NDArray[np.int64], "P"]:
    """Number of the unit cube that each point lies in, of those that hold any."""
    if not len(place):
        return np.zeros(0, np.int64)
    return np.unique(np.floor(place).astype(np.int64), axis=0, return_inverse=True)[1].ravel()


def _features(changes: NDArray[np.floating]) -> NDArray[np.float64]:
    """f above."""
    red, green, blue = changes.astype(np.float64).T
    return np.stack([green, red - blue, green - (red + blue) / 2], 1)


def _usual_tint(warmth: NDArray[np.floating]) -> NDArray[np.float64]:
    """Log s of green over the mean of those of red and blue: of suns through the air and skies, about."""
    return np.asarray(0.17 * np.log(warmth) - 0.05)


def _of_suns(changes: Annotated[_Pixels, "P 3"]) -> Annotated[NDArray[np.bool_], "P"]:
    """Changes that a sun may make."""
    strength = np.expm1(changes.astype(np.float64))
    positive = (strength > 0.05).all(1) & (changes[:, 1] > _MIN_SUN_CHANGE)
    red, green, blue = np.maximum(strength, 0.05).T
    warmth = red / blue
    tint = np.log(green / np.sqrt(red * blue)) - _usual_tint(warmth)
    found: NDArray[np.bool_] = (
        positive & (warmth > _WARMTH[0]) & (warmth < _WARMTH[1]) & (np.abs(tint) < _MAX_TINT)
    )
    return found


def _tried() -> Annotated[NDArray[np.float64], "T 3"]:
    """f of suns that are tried."""
    found = []
    for warmth in np.geomspace(1.05 * _WARMTH[0], 0.9 * _WARMTH[1], 9):
        for change in np.arange(_MIN_SUN_CHANGE + 0.07, _MAX_SUN_CHANGE, 0.1):
            green = math.expm1(change)
            mean = green / math.exp(float(_usual_tint(warmth)))
            root = math.sqrt(warmth)
            found.append(np.log1p([mean * root, green, mean / root]))
    return _features(np.array(found))


class _Scores:
    """Scores of changes among some pairs."""

    def __init__(self, features: NDArray[np.float64], kinds: Sequence[NDArray[np.int64]]) -> None:
        self._features = features
        self._kinds = kinds

    def agreeing(self, feature: NDArray[np.float64]) -> NDArray[np.float64]:
        """Agreement of pairs with a change [P], in [0, 1]."""
        away = (self._features - feature) / _DEVIATIONS
        return np.asarray(np.exp(-(away**2).sum(1) / 2))

    def score(self, feature: NDArray[np.float64]) -> float:
        """Score of a change, above; by that way of telling kinds which tells fewest."""
        weight = self.agreeing(feature)
        return min(float(np.minimum(np.bincount(each, weight), _CAP).sum()) for each in self._kinds)

    def moved(self, feature: NDArray[np.float64]) -> NDArray[np.float64]:
        """Mean of what agrees with a change, each kind as far as it counts."""
        weight = self.agreeing(feature)
        kinds = np.maximum(np.bincount(self._kinds[0], weight), 1e-9)
        weight = weight * np.minimum(1, _CAP / kinds)[self._kinds[0]]
        return np.asarray((weight[:, None] * self._features).sum(0) / max(weight.sum(), 1e-9))


def _shared_change(
    pairs: _Pairs,
) -> tuple[NDArray[np.float64], float, Annotated[NDArray[np.float64], "P"]] | None:
    """The change f that most kinds share, its score, and how far each pair agrees; None where none stands out."""
    of_suns = _of_suns(pairs.changes)
    if of_suns.sum() < _MIN_SCORE:
        return None
    features = _features(pairs.changes)
    every = _Scores(features, pairs.kinds)
    suns = _Scores(features[of_suns], [each[of_suns] for each in pairs.kinds])
    cooler = np.array([1.0, -1.0, -1.0])

    def surplus(feature: NDArray[np.float64]) -> float:
        return suns.score(feature) - _COOLER_WEIGHT * every.score(cooler * feature)

    best = max(_tried(), key=surplus)
    for _ in range(_CHANGE_ROUNDS):
        best = suns.moved(best)
    score = suns.score(best)
    smaller = max(every.score(share * best) for share in _SMALLER)
    if surplus(best) < _MIN_SCORE or score < _MIN_PEAK * smaller:
        return None
    return best, score, every.agreeing(best) * of_suns


def _sun_degrees(log_luma: _Pixels, pairs: _Pairs, agreeing: Annotated[NDArray[np.float64], "P"]) -> float:
    """Diameter of a sun whose shadows have edges as wide as those between agreeing places.

    Edges of materials, which other pairs of as much change show, tell how sharp the photograph is.
    """
    shadow = _edge_width(log_luma, pairs, agreeing > 0.3)
    other = _edge_width(log_luma, pairs, (agreeing < 0.01) & (pairs.changes[:, 1] > _MIN_SUN_CHANGE))
    wider = max(0.0, shadow - max(other, _SHARP_PIXELS))
    seen = wider * _VIEW_DEGREES / max(log_luma.shape)
    return float(min(SHARP_DEGREES + seen / _BLOCKER_SHARE, _MAX_DEGREES))


def _edge_width(log_luma: _Pixels, pairs: _Pairs, chosen: Annotated[NDArray[np.bool_], "P"]) -> float:
    """Median share of the way between two places, in pixels, on which luma rises from a fifth to four fifths."""
    middles = pairs.middles[chosen]
    if not len(middles):
        return 0.0
    across = pairs.across[chosen]
    along = np.linspace(-0.5, 0.5, 25)
    at = middles[:, None] + along[None, :, None] * across[:, None]
    rows = np.clip(np.rint(at[..., 0]).astype(np.int64), 0, log_luma.shape[0] - 1)
    columns = np.clip(np.rint(at[..., 1]).astype(np.int64), 0, log_luma.shape[1] - 1)
    profile = log_luma[rows, columns]
    low = profile[:, :3].mean(1, keepdims=True)
    high = profile[:, -3:].mean(1, keepdims=True)
    rise = (profile - low) / np.maximum(high - low, 1e-3)
    between = ((rise > 0.2) & (rise < 0.8)).mean(1)
    return float(np.median(between * np.linalg.norm(across, axis=1)))
