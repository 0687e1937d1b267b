"""`--view` of `fprf train`: where to show training, and who shows it."""

import contextlib
import importlib.util
from collections.abc import Sequence
from typing import TYPE_CHECKING

from ..errors import UsageError

if TYPE_CHECKING:
    from ..viewer.aside import Aside, Place
    from .progress import Display

__all__ = ["VIEW", "linger", "open_view", "take_view"]

VIEW = "--view"


def take_view(args: Sequence[str]) -> "tuple[list[str], Place | None]":
    """The arguments without `--view [[HOST:]PORT]`, and what it says; None where it is not among them.

    Raises UsageError for what is no port.
    """
    from ..viewer.aside import Place

    rest: list[str] = []
    place: Place | None = None
    words = iter(range(len(args)))
    for i in words:
        name, equals, value = args[i].partition("=")
        if name != VIEW:
            rest.append(args[i])
            continue
        if not equals and i + 1 < len(args) and not args[i + 1].startswith("-"):
            value = args[next(words)]
        place = _place(value) if value or equals else Place()
    return rest, place


def open_view(place: "Place") -> "Aside":
    """The viewer's process, listening. Raises UsageError where it cannot."""
    from ..viewer.aside import Aside

    if importlib.util.find_spec("viser") is None:
        raise UsageError(f"{VIEW}: needs viser; install it with pip install 'fprf[viewer]', or train without {VIEW}")
    return Aside(place)


def linger(view: "Aside | None", display: "Display") -> None:
    """Training is over: on a terminal the view stays as long as somebody looks. Ctrl-C is then no failure."""
    if view is None:
        return
    if view.fault is not None:
        display.say(f"{VIEW}: the viewer has ended ({view.fault}); training did not need it")
    if display.live and view.looked_at:
        display.say("somebody is looking; Ctrl-C ends the view as well")
    with contextlib.suppress(KeyboardInterrupt):
        view.finish(stay=display.live)


def _place(text: str) -> "Place":
    from ..viewer.aside import Place

    host, _, port = text.rpartition(":")
    if not (port.isascii() and port.isdigit() and int(port) < 65536):
        raise UsageError(f"{VIEW} {text}: it takes a port from 0 to 65535, or HOST:PORT, or nothing")
    return Place(host.strip("[]") or Place().host, int(port), strict=True)
