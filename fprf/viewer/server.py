"""The HTTP server of the viewer: who may connect, the page's requests, and checked WebSocket messages relayed to viser.

uvicorn speaks HTTP and WebSocket. viser, which lets everybody in, listens on an address that only this server knows. By
default this machine alone may connect; from elsewhere a token is needed. A page of another site that is open in the same
browser can send requests here, so Host must name this machine (DNS rebinding) and Origin must be our own page.
"""

import asyncio
import contextlib
import hmac
import importlib
import ipaddress
import logging
import secrets
import socket
import threading
from collections.abc import Awaitable, Callable, Mapping, MutableMapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs, quote, urlsplit

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from ..errors import DataError, FprfError, UsageError
from .routes import Request, Response, Routes, text_response

if TYPE_CHECKING:
    from .restyler import OpenEncoders
    from .session import Session, Viewed

COOKIE = "fprf-token"
_MIN_TOKEN = 16
"""Characters of a token that a user chooses."""
_ANY_ADDRESS = ("0.0.0.0", "::")  # nosec B104  # recognised, never the default
_TIMEOUT = 15.0
"""Seconds for a request's head, for each further piece of a body, and for each piece of a response to be accepted."""
_MAX_HEAD = 16 << 10
_CONNECTIONS = 64
_UPLOADS = 4
"""Bodies received at the same time: bounds the memory."""
_MAX_BODY = 20 << 20
_MAX_MESSAGE = 1 << 20
"""Bytes of a WebSocket message; the page sends a few hundred."""
_PIECE = 1 << 16
_HEADERS = {
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "cache-control": "no-store",
    "connection": "close",
}
_LOADING = b"""<!doctype html><meta charset="utf-8"><meta http-equiv="refresh" content="1"><title>fprf</title>
<body style="font:16px system-ui;display:grid;place-items:center;height:90vh;background:#16181d;color:#dde">
Loading the scene ..."""


@dataclass(frozen=True)
class Access:
    """Checks that a request must pass to be answered."""

    host: str
    """Address that is listened on."""
    token: str | None
    """None = no token is needed."""

    def refusal(self, headers: Mapping[str, str], given: str | None = None) -> str | None:
        """Return why a request is refused, or None. Header names are lower case; `given` is a token in the address."""
        name = headers.get("host", "")
        if not name or (is_loopback(self.host) and not is_loopback(_host_name(name))):
            return f"this viewer does not go by the name {name!r}; open it by the address that it printed"
        origin = headers.get("origin")
        if origin is not None and origin not in (f"http://{name}", f"https://{name}"):
            return "another site may not talk to this viewer"
        if self.token is None:
            return None
        shown = given or _cookie(headers.get("cookie", "")) or headers.get("authorization", "").removeprefix("Bearer ")
        if hmac.compare_digest(shown.encode(), self.token.encode()):
            return None
        return "a token is needed; open the whole address that `fprf view` printed"


def make_access(host: str, token: str | None) -> Access:
    """Make a token where other machines can connect and none is given. Raises UsageError for one that is easily guessed."""
    if token is not None and (len(token) < _MIN_TOKEN or not token.isascii() or not token.isprintable() or " " in token):
        raise UsageError(f"--token: at least {_MIN_TOKEN} plain characters without spaces; leave it out and one is made")
    if token is None and not is_loopback(host):
        token = secrets.token_urlsafe(24)
    return Access(host, token)


def is_loopback(host: str) -> bool:
    """True for a name or address of this machine alone."""
    if host.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


_Event = MutableMapping[str, Any]
_Receive = Callable[[], Awaitable[_Event]]
_Send = Callable[[_Event], Awaitable[None]]


class _Refused(Exception):
    def __init__(self, status: int, text: str) -> None:
        super().__init__(text)
        self.status = status


class _Protocol(H11Protocol):  # type: ignore[misc]  # uvicorn is not there where types are checked
    """HTTP/1.1 with a time limit for the head of a request, which uvicorn does not have."""

    def connection_made(self, transport: asyncio.Transport) -> None:
        super().connection_made(transport)
        self.loop.call_later(_TIMEOUT, self._check_head, transport)

    def _check_head(self, transport: asyncio.Transport) -> None:
        if self.cycle is None and transport.get_protocol() is self:
            transport.close()


class HttpServer:
    """Listens in a thread of its own as soon as it is made; `port` 0 takes a free one.

    One request a connection; a client that breaks a rule loses its connection and harms no other. Raises UsageError where
    the address cannot be listened on.
    """

    def __init__(self, access: Access, port: int, routes: Routes) -> None:
        self.access, self._routes = access, routes
        self._viser: tuple[str, Callable[[bytes], None]] | None = None
        self._uploads, self._relays = asyncio.Semaphore(_UPLOADS), asyncio.Semaphore(_CONNECTIONS)
        listener = _listen(access.host, port)
        self.port: int = listener.getsockname()[1]
        config = uvicorn.Config(
            self._app,
            loop="asyncio",
            http=_Protocol,
            ws="websockets-sansio",
            ws_max_size=_MAX_MESSAGE,
            ws_per_message_deflate=False,  # most of what viser sends are JPEG pictures
            interface="asgi3",
            lifespan="off",
            proxy_headers=False,
            log_config=None,
            log_level=logging.CRITICAL,
            access_log=False,
            server_header=False,
            limit_concurrency=_CONNECTIONS,
            h11_max_incomplete_event_size=_MAX_HEAD,
        )
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._server.run, args=([listener],), name="fprf-http", daemon=True)
        self._thread.start()

    def serve(self, routes: Routes) -> None:
        """Change the routes and relay no WebSockets."""
        self._routes, self._viser = routes, None

    def relay_to(self, routes: Routes, address: tuple[str, int], check: Callable[[bytes], None]) -> None:
        """Change the routes and relay WebSockets to viser; a message for which `check` raises ends its connection."""
        self._routes, self._viser = routes, (f"ws://{address[0]}:{address[1]}", check)

    def close(self) -> None:
        self._server.force_exit = self._server.should_exit = True
        self._thread.join(5)

    async def _app(self, scope: _Event, receive: _Receive, send: _Send) -> None:
        websocket = scope["type"] == "websocket"
        try:
            request = _request(scope)
            given = request.query.get("token")
            refusal = self.access.refusal(request.headers, given)
            if refusal is not None:
                raise _Refused(403, refusal)
            if websocket:
                await self._relay(scope["subprotocols"], receive, send)
                return
            if given is not None and request.method == "GET":
                # Out of the address bar and its history; the cookie is sent to this server alone.
                cookie = f"{COOKIE}={given}; Path=/; HttpOnly; SameSite=Strict"
                response = Response(303, "text/plain", b"", {"location": request.path, "set-cookie": cookie})
            else:
                response = await self._respond(request, receive)
        except _Refused as refused:
            response = text_response(refused.status, str(refused))
        with contextlib.suppress(OSError, TimeoutError):  # the client has gone or is too slow
            await _send(send, response, "websocket.http.response" if websocket else "http.response")

    async def _respond(self, request: Request, receive: _Receive) -> Response:
        handler = self._routes.get((request.method, request.path))
        if handler is None:
            raise _Refused(405 if any(path == request.path for _, path in self._routes) else 404, "no such page")
        try:
            if request.method != "POST":
                return await handler(request)
            async with self._uploads:
                return await handler(request._replace(body=await _body(request, receive)))
        except FprfError as error:
            return text_response(400, str(error))

    async def _relay(self, subprotocols: list[str], receive: _Receive, send: _Send) -> None:
        """Pass messages between a page and viser; the page's are checked first."""
        if self._viser is None or self._relays.locked():
            raise _Refused(503, "still starting, or too many pages; try again")
        from websockets.asyncio.client import connect
        from websockets.exceptions import WebSocketException
        from websockets.typing import Subprotocol

        (address, check), offered = self._viser, [Subprotocol(name) for name in subprotocols]
        try:
            viser = await connect(address, subprotocols=offered or None, compression=None, max_size=None, proxy=None)
        except (OSError, WebSocketException):
            raise _Refused(503, "the viewer is ending") from None

        async def up() -> None:
            while (event := await receive())["type"] == "websocket.receive":
                payload = event.get("bytes") or b""
                check(payload)
                await viser.send(payload)

        async def down() -> None:
            async for message in viser:
                await send({"type": "websocket.send", "bytes": message})

        async with self._relays, viser:
            assert (await receive())["type"] == "websocket.connect"
            await send({"type": "websocket.accept", "subprotocol": viser.subprotocol})
            ways = [asyncio.create_task(up()), asyncio.create_task(down())]
            try:
                await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
            finally:
                for way in ways:
                    way.cancel()
                outcomes = await asyncio.gather(*ways, return_exceptions=True)
            if any(isinstance(outcome, DataError) for outcome in outcomes):
                with contextlib.suppress(OSError, RuntimeError):
                    await send({"type": "websocket.close", "code": 1008})


class ViewerServer:
    """The HTTP server at once, then the scene behind it. Imports little before the port is open. A context manager."""

    def __init__(self, access: Access, port: int, *, preload: bool = True) -> None:
        if preload:  # viser takes a while to import and needs nothing of ours
            threading.Thread(target=_import_viser, daemon=True).start()
        self.visited = threading.Event()
        self._session: Session | None = None
        self._start: Routes | None = None
        self._http = HttpServer(access, port, {("GET", "/"): self._loading_page})
        self._opened = contextlib.ExitStack()

    def __enter__(self) -> "ViewerServer":
        return self

    def __exit__(self, *_: object) -> None:
        self._close_session()
        self._http.close()

    @property
    def address(self) -> str:
        """The URL to open in a browser, with the token."""
        access = self._http.access
        host = "127.0.0.1" if access.host in _ANY_ADDRESS else access.host
        host = f"[{host}]" if ":" in host else host
        token = "" if access.token is None else f"?token={quote(access.token)}"
        return f"http://{host}:{self._http.port}/{token}"

    def show_start(self, routes: Routes) -> None:
        """Show the start page in the place of a scene; its routes stay when one is opened, but for `/`."""
        self._start = routes
        self._close_session()
        self._http.serve(routes)

    def notify(self, text: str) -> None:
        """Show a line on all pages."""
        if self._session is not None:
            self._session.notify(text)

    def open(
        self,
        load: "Callable[[], Viewed]",
        references: Sequence[Path],
        pixels: int,
        open_encoders: "OpenEncoders | None" = None,
    ) -> "Session":
        """Load the scene and let clients in, in the place of one that was open; `open_encoders` opens the encoders of a scene
        that is still trained.

        Raises what `load` raises, and DataError for an unreadable photograph.
        """
        viewed = load()
        self._close_session()
        from .frontend import ViserFrontend, page_of
        from .message_validation import check_message
        from .page import Page
        from .session import Session
        from .state import State

        state = State(pixels=pixels, drop_mode="in the mix" if len(references) > 1 else "alone")
        session = self._opened.enter_context(Session(viewed, state, open_encoders))
        page = Page(session, page_of(viewed.name), start=self._start is not None)
        frontend = ViserFrontend(session, page)
        self._opened.callback(frontend.close)
        self._http.relay_to({**(self._start or {}), **page.routes}, frontend.address, check_message)
        for path in references:
            session.upload(path.read_bytes(), path.name)
        if open_encoders is None:
            session.warm_up()
        self._session = session
        return session

    def _close_session(self) -> None:
        self._opened.close()
        self._session = None

    async def _loading_page(self, request: Request) -> Response:
        self.visited.set()
        return Response(200, "text/html; charset=utf-8", _LOADING)


def _import_viser() -> None:
    with contextlib.suppress(ImportError):  # reported when it is needed
        importlib.import_module("viser")


def _listen(host: str, port: int) -> socket.socket:
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        return socket.create_server(address[:2], family=family)
    except OSError as error:
        raise UsageError(f"--host {host} --port {port}: cannot listen there ({error.strerror}); choose another port") from error


def _request(scope: _Event) -> Request:
    headers: dict[str, str] = {}
    for raw, value in scope["headers"]:
        name = raw.decode("latin-1")
        if name in headers and name in ("host", "origin"):
            raise _Refused(400, f"the header {name} comes twice")
        headers.setdefault(name, value.decode("latin-1"))
    try:
        fields = parse_qs(scope["query_string"].decode("latin-1"), max_num_fields=16)
    except ValueError:
        raise _Refused(400, "the address has too many fields") from None
    return Request(scope.get("method", "GET"), scope["path"], {key: values[0] for key, values in fields.items()}, headers)


async def _body(request: Request, receive: _Receive) -> bytes:
    """Receive a body of at most `_MAX_BODY` bytes. A longer one is refused by its header, or as soon as it is."""
    size = int(request.headers.get("content-length", "0"))  # digits: the parser refuses others
    body, more = bytearray(), True
    while more and size <= _MAX_BODY:
        try:
            event = await asyncio.wait_for(receive(), _TIMEOUT)
        except TimeoutError:
            raise _Refused(408, "the request came too slowly") from None
        if event["type"] == "http.disconnect":
            raise _Refused(400, "the request ended early")
        body += event.get("body", b"")
        size, more = max(size, len(body)), event.get("more_body", False)
    if size > _MAX_BODY:
        raise _Refused(413, f"more than {_MAX_BODY} bytes: make the photograph smaller")
    return bytes(body)


async def _send(send: _Send, response: Response, kind: str) -> None:
    fields = {"content-type": response.content_type, "content-length": str(len(response.body)), **_HEADERS, **response.headers}
    headers = [(name.encode("latin-1"), value.encode("latin-1")) for name, value in fields.items()]
    await send({"type": f"{kind}.start", "status": response.status, "headers": headers})
    for start in range(0, len(response.body) or 1, _PIECE):
        last = start + _PIECE >= len(response.body)
        piece = {"type": f"{kind}.body", "body": response.body[start : start + _PIECE], "more_body": not last}
        await asyncio.wait_for(send(piece), _TIMEOUT)


def _host_name(host: str) -> str:
    """The name in a Host header without its port; empty where it cannot be parsed."""
    try:
        return urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return ""


def _cookie(header: str) -> str:
    for part in header.split(";"):
        key, _, value = part.strip().partition("=")
        if key == COOKIE:
            return value
    return ""
