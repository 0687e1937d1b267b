"""Ctrl-C and SIGTERM while training: the first lets the step end and is then obeyed, the second one ends it at once.

An optimiser that is interrupted halfway has moved some of its numbers and not others, which no checkpoint may hold.
"""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

__all__ = ["Stop", "held_back"]

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Stop:
    """What was asked for since."""

    def __init__(self) -> None:
        self.asked = False
        """Once: end when the step is done."""
        self.hurried = False
        """Twice: ended within a step, so that what is in memory is of no use."""

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Take note of a signal; the second raises KeyboardInterrupt wherever the program is."""
        self.hurried = self.asked
        self.asked = True
        if self.hurried:
            raise KeyboardInterrupt

    def obey(self) -> None:
        """Raise KeyboardInterrupt if it was asked for."""
        if self.asked:
            raise KeyboardInterrupt


@contextmanager
def held_back() -> Iterator[Stop]:
    """Hold signals back inside the block, and as before after it. Other threads than the first cannot, and don't."""
    stop = Stop()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    before = {number: signal.signal(number, stop) for number in _SIGNALS}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
