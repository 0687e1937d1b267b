"""`--view` of `fprf train`: where to show training, and the process that shows it."""

import contextlib
import importlib.util
from collections.abc import Sequence
from typing import TYPE_CHECKING

from ..errors import UsageError

if TYPE_CHECKING:
    from ..viewer.live import LiveViewer, ViewAddress
    from .progress import Display

__all__ = ["VIEW", "finish_view", "open_view", "take_view"]

VIEW = "--view"


def take_view(args: Sequence[str]) -> "tuple[list[str], ViewAddress | None]":
    """Split `--view [[HOST:]PORT]` from the other arguments; None where it is absent. Raises UsageError for no port."""
    from ..viewer.live import ViewAddress

    rest: list[str] = []
    address: ViewAddress | None = None
    words = iter(range(len(args)))
    for i in words:
        name, equals, value = args[i].partition("=")
        if name != VIEW:
            rest.append(args[i])
            continue
        if not equals and i + 1 < len(args) and not args[i + 1].startswith("-"):
            value = args[next(words)]
        address = ViewAddress()
        if value or equals:
            host, _, port = value.rpartition(":")
            if not (port.isascii() and port.isdigit() and int(port) < 65536):
                raise UsageError(f"{VIEW} {value}: it takes a port from 0 to 65535, or HOST:PORT, or nothing")
            address = ViewAddress(host.strip("[]") or address.host, int(port), strict=True)
    return rest, address


def open_view(address: "ViewAddress") -> "LiveViewer":
    """Start the viewer's process. Raises UsageError where it cannot listen."""
    from ..viewer.live import LiveViewer

    if importlib.util.find_spec("viser") is None:
        raise UsageError(f"{VIEW}: needs viser; install it with pip install 'fprf[viewer]', or train without {VIEW}")
    return LiveViewer(address)


def finish_view(view: "LiveViewer | None", display: "Display") -> None:
    """After training, keep the view on a terminal as long as somebody looks. Ctrl-C is then no failure."""
    if view is None:
        return
    if view.fault is not None:
        display.say(f"{VIEW}: the viewer has ended ({view.fault}); training did not need it")
    if display.live and view.looked_at:
        display.say("somebody is looking; Ctrl-C ends the view as well")
    with contextlib.suppress(KeyboardInterrupt):
        view.finish(stay=display.live)
