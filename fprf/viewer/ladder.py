"""From coarse to sharp: which sizes a view is rendered at, and with which one to begin.

A moving camera must see something at once; a still one shall see everything. So the first picture is the finest one that can
be had within `FIRST` seconds, as fast as this machine has been so far, and each next one has four times the pixels.
"""

__all__ = ["FIRST", "Speed", "rungs"]

FIRST = 0.1
"""Seconds that the first picture of a new camera may take."""
_STEP = 2
_SMALLEST = 16
"""No picture's longer side is smaller, unless that of the largest is."""


def rungs(size: tuple[int, int]) -> list[tuple[int, int]]:
    """Sizes (width, height) from the coarsest to `size` itself, each twice as wide as the one before."""
    found, divisor = [size], _STEP
    while max(size) / divisor >= _SMALLEST:
        found.append((max(1, round(size[0] / divisor)), max(1, round(size[1] / divisor))))
        divisor *= _STEP
    return found[::-1]


class Speed:
    """Seconds a pixel, learnt from what was rendered: a mean that forgets."""

    def __init__(self, guess: float) -> None:
        self.seconds = guess

    def learn(self, pixels: int, seconds: float) -> None:
        """A picture of so many pixels took so long."""
        if pixels > 0:
            self.seconds += 0.3 * (seconds / pixels - self.seconds)

    def first(self, sizes: list[tuple[int, int]], limit: float = FIRST) -> int:
        """The finest of `sizes` (coarse to fine) that should take at most `limit` seconds; the coarsest where none does."""
        fits = [i for i, (width, height) in enumerate(sizes) if width * height * self.seconds <= limit]
        return max(fits, default=0)
