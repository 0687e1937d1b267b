"""The viewer put together: the gate at once, then the scene behind it. Imports little before the gate is open."""

import contextlib
import importlib
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

from .access import Access, is_loopback
from .server import Answer, Gate, Request

if TYPE_CHECKING:
    from ..training.loading import Trained
    from .restyler import Opener
    from .session import Session

__all__ = ["Host"]

_STARTING = b"""<!doctype html><meta charset="utf-8"><meta http-equiv="refresh" content="1"><title>fprf</title>
<body style="font:16px system-ui;display:grid;place-items:center;height:90vh;background:#16181d;color:#dde">
Loading the scene ..."""
_ANYWHERE = ("0.0.0.0", "::")  # nosec B104  # recognised, never the default


class Host:
    """Use as a context manager. Raises UsageError where the port cannot be had."""

    def __init__(self, access: Access, port: int, *, eager: bool = True) -> None:
        if eager:  # viser takes a while to import and needs nothing of ours
            threading.Thread(target=_early, daemon=True).start()
        self.visited = threading.Event()
        self._session: Session | None = None
        self._ends: list[Callable[[], None]] = []
        self._gate = Gate(access, port, {("GET", "/"): self._starting}, largest=20 << 20)
        self._gate.open()
        self._ends.append(self._gate.close)

    def __enter__(self) -> "Host":
        return self

    def __exit__(self, *_: object) -> None:
        for end in reversed(self._ends):
            end()

    @property
    def address(self) -> str:
        """What to open in a browser."""
        access = self._gate.access
        host = "127.0.0.1" if access.host in _ANYWHERE else access.host
        host = f"[{host}]" if ":" in host else host
        token = "" if access.token is None else f"?token={quote(access.token)}"
        return f"http://{host}:{self._gate.port}/{token}"

    @property
    def open_to_others(self) -> bool:
        """Whether other machines can come."""
        return not is_loopback(self._gate.access.host)

    async def _starting(self, request: Request) -> Answer:
        self.visited.set()
        return Answer(200, "text/html; charset=utf-8", _STARTING)

    def say(self, text: str) -> None:
        """A line for all pages."""
        if self._session is not None:
            self._session.say(text)

    def open(
        self, load: "Callable[[], Trained]", references: Sequence[Path], pixels: int, opened: "Opener | None" = None
    ) -> "Session":
        """Load the scene and let clients in; `opened` brings photographs into its terms.

        Raises what `load` raises, and DataError for an unreadable photograph.
        """
        trained = load()
        from .frontend import Server, built_index, check_bytes
        from .page import Page
        from .session import Session
        from .state import Landing, State

        landing: Landing = "in the mix" if len(references) > 1 else "alone"
        session = Session(trained, State(pixels=pixels, landing=landing), opened)
        session.__enter__()
        self._ends.append(session.close)
        page = Page(session, built_index(trained.known.name))
        server = Server(session, page)
        self._ends.append(server.close)
        self._gate.lead(page.routes, server.inner, check_bytes)
        for path in references:
            session.drop(path.read_bytes(), path.name)
        if opened is None:
            session.warm()
        self._session = session
        return session


def _early() -> None:
    with contextlib.suppress(ImportError):  # told when it is needed
        importlib.import_module("viser")
