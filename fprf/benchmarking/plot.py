"""Curves of time against error as a picture: one panel each, time to the right on a logarithmic axis, the front as a line."""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import cv2
import numpy as np

from ..io.images import Picture
from ..io.maps import palette
from .front import Point

__all__ = ["Panel", "draw", "ticks"]

WIDTH, HEIGHT = 900, 620
LEFT, RIGHT, TOP, BOTTOM = 90, 30, 50, 60
INK, FAINT, PAPER = (40, 40, 44), (222, 222, 226), (255, 255, 255)
FONT = cv2.FONT_HERSHEY_SIMPLEX
LEAST = 1e-9
"""Errors are shown from here on: an exact setting has none, and a logarithm."""


class Panel(NamedTuple):
    """One picture."""

    title: str
    points: Sequence[Point]
    front: Sequence[Point]
    value: Callable[[Point], float | None]
    label: str
    """Of the upright axis."""
    log: bool
    """Whether that axis is logarithmic."""


def draw(panels: Sequence[Panel]) -> Picture:
    """All panels, two beside each other."""
    drawn = [_panel(panel) for panel in panels] or [np.full((HEIGHT, WIDTH, 3), 255, np.uint8)]
    if len(drawn) > 1 and len(drawn) % 2:
        drawn.append(np.full_like(drawn[0], 255))
    rows = [np.concatenate(drawn[i : i + 2], 1) for i in range(0, len(drawn), 2)]
    return np.concatenate(rows, 0)


def ticks(low: float, high: float, *, log: bool, most: int = 7) -> list[float]:
    """Round values within [low, high]: powers of ten times 1, 2, 5, or multiples of such; at least the two ends' nearest."""
    if log:
        exponents = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
        for steps in ((1, 2, 5), (1, 3), (1,)):
            found = [s * 10.0**e for e in exponents for s in steps if low <= s * 10.0**e <= high]
            if len(found) <= most:
                break
        return found[:: -(-len(found) // most)] if found else [low, high]
    step = 10.0 ** math.floor(math.log10(max(high - low, 1e-12)))
    width = next(step * m for m in (0.2, 0.5, 1, 2, 5, 10) if (high - low) / (step * m) <= most)
    return [width * k for k in range(math.ceil(low / width), math.floor(high / width) + 1)]


class _Axis(NamedTuple):
    low: float
    high: float
    first: int
    """Pixel of the low end."""
    last: int
    log: bool

    def at(self, value: float) -> int:
        low, high, here = (math.log10(v) for v in (self.low, self.high, value)) if self.log else (self.low, self.high, value)
        return round(self.first + (here - low) / (high - low) * (self.last - self.first))


def _axis(values: Sequence[float], first: int, last: int, *, log: bool) -> _Axis:
    low, high = min(values), max(values)
    if log:
        return _Axis(low / 1.3, high * 1.3, first, last, log)
    edge = 0.08 * (high - low) or 0.5
    return _Axis(low - edge, high + edge, first, last, log)


def _panel(panel: Panel) -> Picture:
    image = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
    shown = [(p, 1e3 * p.seconds.median, _shown(panel, value)) for p in panel.points if (value := panel.value(p)) is not None]
    across = _axis([t for _, t, _ in shown], LEFT, WIDTH - RIGHT, log=True)
    up = _axis([v for _, _, v in shown], HEIGHT - BOTTOM, TOP, log=panel.log)
    _frame(image, panel, across, up)
    knobs = list(dict.fromkeys(p.knob for p in panel.points))
    colours = {k: tuple(int(255 * c) for c in rgb) for k, rgb in zip(knobs, palette(len(knobs)).tolist(), strict=True)}
    line = [(across.at(1e3 * p.seconds.median), up.at(_shown(panel, panel.value(p) or 0.0))) for p in panel.front]
    cv2.polylines(image, [np.array(line, np.int32)], False, INK, 1, cv2.LINE_AA)
    taken: list[tuple[int, int, int, int]] = []
    for point, milliseconds, value in sorted(shown, key=lambda s: s[0] not in panel.front):
        x, y = across.at(milliseconds), up.at(value)
        best = point in panel.front
        cv2.circle(image, (x, y), 6 if best else 4, colours[point.knob], -1 if best else 2, cv2.LINE_AA)
        _label(image, point.name, x, y, taken, INK if best else (130, 130, 134))
    return image


def _shown(panel: Panel, value: float) -> float:
    return max(value, LEAST) if panel.log else value


def _frame(image: Picture, panel: Panel, across: _Axis, up: _Axis) -> None:
    for value in ticks(across.low, across.high, log=True):
        x = across.at(value)
        cv2.line(image, (x, TOP), (x, HEIGHT - BOTTOM), FAINT, 1)
        _text(image, f"{value:g}", (x, HEIGHT - BOTTOM + 20), centred=True)
    for value in ticks(up.low, up.high, log=panel.log):
        y = up.at(value)
        cv2.line(image, (LEFT, y), (WIDTH - RIGHT, y), FAINT, 1)
        text = f"{value:.0e}" if panel.log else f"{value:g}"
        _text(image, text, (LEFT - 8 - _width(text), y + 4))
    cv2.rectangle(image, (LEFT, TOP), (WIDTH - RIGHT, HEIGHT - BOTTOM), INK, 1)
    _text(image, panel.title, (LEFT, 30), size=0.6)
    _text(image, "milliseconds a view", ((LEFT + WIDTH - RIGHT) // 2, HEIGHT - 14), centred=True)
    _text(image, panel.label, (8, TOP - 12))


def _label(
    image: Picture, text: str, x: int, y: int, taken: list[tuple[int, int, int, int]], colour: tuple[int, int, int]
) -> None:
    """The name beside its point, where no other name is; left out where there is no room."""
    width = _width(text)
    for left, base in ((x + 9, y - 5), (x + 9, y + 14), (x - 9 - width, y - 5), (x - 9 - width, y + 14)):
        box = (left, base - 10, left + width, base + 3)
        inside = box[0] >= LEFT and box[2] <= WIDTH - RIGHT and box[1] >= TOP and box[3] <= HEIGHT - BOTTOM
        if inside and not any(_meet(box, other) for other in taken):
            taken.append(box)
            _text(image, text, (left, base), colour=colour)
            return


def _meet(a: tuple[int, int, int, int], b: tuple[int, int, int, int]) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def _width(text: str, size: float = 0.42) -> int:
    return int(cv2.getTextSize(text, FONT, size, 1)[0][0])


def _text(
    image: Picture,
    text: str,
    at: tuple[int, int],
    *,
    size: float = 0.42,
    centred: bool = False,
    colour: tuple[int, int, int] = INK,
) -> None:
    left = at[0] - _width(text, size) // 2 if centred else at[0]
    cv2.putText(image, text, (left, at[1]), FONT, size, colour, 1, cv2.LINE_AA)
