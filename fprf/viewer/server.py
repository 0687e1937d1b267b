"""The HTTP server of the viewer: who may connect, the page's requests, and its WebSocket of small messages.

By default this machine alone may connect; from elsewhere a token is needed. A page of another site that is open in the same
browser can send requests here, so Host must name this machine (DNS rebinding) and Origin must be our own page.
"""

import asyncio
import contextlib
import hmac
import ipaddress
import json
import logging
import secrets
import socket
import threading
from collections.abc import Awaitable, Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs, quote, urlsplit

import uvicorn
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, RedirectResponse, Response
from starlette.routing import BaseRoute, Route, WebSocketRoute
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect
from uvicorn.protocols.http.h11_impl import H11Protocol

from ..errors import DataError, FprfError, UsageError
from ..page.live import live_page, live_script, live_style
from .start import Start, integer, start_routes

if TYPE_CHECKING:
    from .session import Session, Viewed

COOKIE = "fprf-token"
_MIN_TOKEN = 16
"""Characters of a token that a user chooses."""
_ANY_ADDRESS = ("0.0.0.0", "::")  # nosec B104  # recognised, never the default
_TIMEOUT = 15.0
"""Seconds for a request's head, for each further piece of a body, and for each piece of a response to be accepted."""
_MAX_HEAD = 16 << 10
_CONNECTIONS = 64
_PAGES = 24
"""WebSockets at the same time."""
_UPLOADS = 4
"""Bodies received at the same time: bounds the memory."""
_MAX_BODY = 20 << 20
_MAX_MESSAGE = 1 << 16
"""Bytes of a WebSocket message; the page sends a few hundred."""
_PIECE = 1 << 16
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; connect-src 'self'; "
    "worker-src blob:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_HEADERS = {
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "cache-control": "no-store",
    "connection": "close",
}


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


class _Protocol(H11Protocol):  # type: ignore[misc]  # uvicorn's types are not followed
    """HTTP/1.1 with a time limit for the head of a request, which uvicorn does not have."""

    def connection_made(self, transport: asyncio.Transport) -> None:
        super().connection_made(transport)
        self.loop.call_later(_TIMEOUT, self._check_head, transport)

    def _check_head(self, transport: asyncio.Transport) -> None:
        if self.cycle is None and transport.get_protocol() is self:
            transport.close()


class Guard:
    """Middleware that answers nobody who may not ask, adds headers, and drops clients that do not read."""

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self._app, self._access = app, access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Check a request or a WebSocket's handshake, and pass it on."""
        headers: dict[str, str] = {}
        refused: tuple[int, str] | None = None
        for raw, value in scope["headers"]:
            name = raw.decode("latin-1")
            if name in headers and name in ("host", "origin"):
                refused = (400, f"the header {name} comes twice")
            headers.setdefault(name, value.decode("latin-1"))
        try:
            fields = parse_qs(scope["query_string"].decode("latin-1"), max_num_fields=16)
        except ValueError:
            fields, refused = {}, (400, "the address has too many fields")
        given = fields.get("token", [None])[0]
        if refused is None and (refusal := self._access.refusal(headers, given)) is not None:
            refused = (403, refusal)

        async def patient(message: Message) -> None:
            if message["type"].endswith("response.start"):
                added = [(name.encode(), value.encode()) for name, value in _HEADERS.items()]
                kept = [row for row in message["headers"] if row[0].decode().lower() not in _HEADERS]
                await send({**message, "headers": [*kept, *added]})
                return
            # A body in pieces, each of which must be taken in time.
            body = message.get("body", b"") if message["type"].endswith("response.body") else b""
            for start in range(0, len(body) - _PIECE, _PIECE):
                piece = {**message, "body": body[start : start + _PIECE], "more_body": True}
                await asyncio.wait_for(send(piece), _TIMEOUT)
            last = (len(body) - 1) // _PIECE * _PIECE if body else 0
            await asyncio.wait_for(send({**message, "body": body[last:]} if body else message), _TIMEOUT)

        with contextlib.suppress(OSError, TimeoutError):  # the client has gone or is too slow
            if refused is not None:
                await PlainTextResponse(f"{refused[1]}\n", refused[0])(scope, receive, patient)
            elif given is not None and scope["type"] == "http" and scope["method"] == "GET":
                # Out of the address bar and its history; the cookie is sent to this server alone.
                response = RedirectResponse(scope["path"], 303)
                response.headers["set-cookie"] = f"{COOKIE}={given}; Path=/; HttpOnly; SameSite=Strict"
                await response(scope, receive, patient)
            else:
                await self._app(scope, receive, patient)


class Client:
    """A page's WebSocket: messages wait by their kind, a newer one takes the place of one that was not sent yet."""

    def __init__(self) -> None:
        self._waiting: dict[str, str | bytes] = {}
        self._news = asyncio.Event()

    def put(self, kind: str, message: str | bytes) -> None:
        """Add a message; call this in the server's loop."""
        self._waiting.pop(kind, None)
        self._waiting[kind] = message
        self._news.set()

    async def send(self, socket: WebSocket) -> None:
        """Send messages as they come, until the client goes or does not read."""
        while True:
            await self._news.wait()
            self._news.clear()
            while self._waiting:
                message = self._waiting.pop(next(iter(self._waiting)))
                await (socket.send_bytes(message) if isinstance(message, bytes) else socket.send_text(message))


class ViewerServer:
    """Listens in a thread of its own as soon as it is made; `port` 0 takes a free one. A context manager.

    Shows that a scene is loading, a start page, or a scene. One request a connection; a client that breaks a rule loses its
    connection and harms no other. Raises UsageError where the address cannot be listened on.
    """

    def __init__(self, access: Access, port: int) -> None:
        self.access = access
        self._start: Start | None = None
        self._session: Session | None = None
        self._opened = contextlib.ExitStack()
        self._clients: dict[Hashable, Client] = {}
        self._numbers = count(1)
        self._uploads = asyncio.Semaphore(_UPLOADS)
        self._loop: asyncio.AbstractEventLoop | None = None
        listener = _listen(access.host, port)
        self.port: int = listener.getsockname()[1]
        config = uvicorn.Config(
            self._make_app(),
            loop="asyncio",
            http=_Protocol,
            ws="websockets-sansio",
            ws_max_size=_MAX_MESSAGE,
            ws_per_message_deflate=False,
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

    def __enter__(self) -> "ViewerServer":
        return self

    def __exit__(self, *_: object) -> None:
        self._close_session()
        self._server.force_exit = self._server.should_exit = True
        self._thread.join(5)

    @property
    def address(self) -> str:
        """The URL to open in a browser, with the token."""
        host = "127.0.0.1" if self.access.host in _ANY_ADDRESS else self.access.host
        host = f"[{host}]" if ":" in host else host
        token = "" if self.access.token is None else f"?token={quote(self.access.token)}"
        return f"http://{host}:{self.port}/{token}"

    @property
    def pages(self) -> int:
        """Number of pages that are open."""
        return len(self._clients)

    def show_start(self, start: "Start") -> None:
        """Show the start page in the place of a scene; pages can come back to it from then on."""
        self._start = start
        self._close_session()
        self._greet()

    def notify(self, text: str) -> None:
        """Show a line on all pages."""
        self.post(None, "said", {"type": "said", "text": text, "bad": False})

    def open(
        self, load: "Callable[[], Viewed]", references: Sequence[Path] = (), longest: int = 640, *, warm: bool = True
    ) -> "Session":
        """Load the scene and show it in the place of what was shown. Raises what `load` raises, and DataError for an
        unreadable photograph."""
        from .session import Session

        viewed = load()
        self._close_session()
        made = Session(viewed, self.post, longest=longest, together=len(references) > 1)
        session = self._opened.enter_context(made)
        for path in references:
            session.upload(path.read_bytes(), path.name)
        if warm:
            session.warm_up()
        self._session = session
        self._greet()
        return session

    def post(self, client: Hashable | None, kind: str, message: Mapping[str, Any] | bytes) -> None:
        """Send one client, or all (None), a message; from any thread."""
        data = message if isinstance(message, bytes) else json.dumps(message)
        if self._loop is not None:
            with contextlib.suppress(RuntimeError):  # the loop has ended
                self._loop.call_soon_threadsafe(self._put, client, kind, data)

    def _put(self, client: Hashable | None, kind: str, data: str | bytes) -> None:
        for each in self._clients.values() if client is None else filter(None, [self._clients.get(client)]):
            each.put(kind, data)

    def _greet(self) -> None:
        for kind, message in self._hello():
            self.post(None, kind, message)

    def _hello(self) -> list[tuple[str, dict[str, Any]]]:
        back = {"back": self._start is not None}
        if self._session is not None:
            return [(kind, {**message, **back}) for kind, message in self._session.hello()]
        return [("scene", {"type": "loading"} if self._start is None else self._start.state())]

    def _close_session(self) -> None:
        self._session = None
        self._opened.close()

    def _routes(self) -> list[BaseRoute]:
        return [
            Route("/", _asset("text/html", live_page)),
            Route("/app.js", _asset("text/javascript", live_script)),
            Route("/app.css", _asset("text/css", live_style)),
            WebSocketRoute("/live", self._live),
            Route("/scene", self._scene),
            Route("/colours", self._colours),
            Route("/card", self._card),
            Route("/gaussians", self._gaussians),
            Route("/film", self._film),
            Route("/picture", self._picture),
            Route("/photograph", self._photograph, methods=["POST"]),
            *start_routes(lambda: self._start, self.body),
        ]

    def _make_app(self) -> ASGIApp:
        handlers: Any = {FprfError: _wrong, HTTPException: _missing}
        return Starlette(routes=self._routes(), middleware=[Middleware(Guard, access=self.access)], exception_handlers=handlers)

    async def _live(self, socket: WebSocket) -> None:
        from .messages import read_message

        if len(self._clients) >= _PAGES:
            raise HTTPException(503, "too many pages; close one and try again")
        await socket.accept()
        self._loop = asyncio.get_running_loop()
        number, client = next(self._numbers), Client()
        self._clients[number] = client
        for kind, message in self._hello():
            client.put(kind, json.dumps(message))

        async def receive() -> None:
            while True:
                event = await socket.receive()
                if event["type"] == "websocket.disconnect":
                    return
                message = read_message(event.get("text") or b"")
                session = self._session
                if session is not None:
                    try:
                        session.handle(number, message)
                    except FprfError as error:
                        client.put("said", json.dumps({"type": "said", "text": str(error), "bad": True}))

        ways = [asyncio.create_task(receive()), asyncio.create_task(client.send(socket))]
        try:
            await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
        finally:
            del self._clients[number]
            for way in ways:
                way.cancel()
            outcomes = await asyncio.gather(*ways, return_exceptions=True)
            if (session := self._session) is not None:
                session.disconnect(number)
        if any(isinstance(outcome, DataError) for outcome in outcomes):
            with contextlib.suppress(OSError, RuntimeError, WebSocketDisconnect):
                await socket.close(1008)

    @property
    def session(self) -> "Session":
        """The scene that is open. Raises UsageError without one."""
        if self._session is None:
            raise UsageError("no scene is open")
        return self._session

    async def _scene(self, request: Request) -> Response:
        return Response(self.session.geometry, media_type="application/octet-stream")

    async def _colours(self, request: Request) -> Response:
        data = self.session.colours(request.query_params.get("name", ""))
        return Response(data, media_type="application/octet-stream")

    async def _card(self, request: Request) -> Response:
        from ..io.images import encode

        photograph = self.session.state.photograph(integer(request.query_params, "card"))
        return Response(encode(photograph.thumbnail, "jpg"), media_type="image/jpeg")

    async def _gaussians(self, request: Request) -> Response:
        data = await asyncio.to_thread(self.session.gaussians)
        return self._download("application/octet-stream", data, "restyled.ply")

    async def _film(self, request: Request) -> Response:
        path = self.session.state.film[2]
        if path is None or not path.is_file():
            raise HTTPException(404, "no film yet")
        return self._download("video/mp4", path.read_bytes(), f"{path.parent.name}.mp4")

    async def _picture(self, request: Request) -> Response:
        pictures, number = self.session.state.pictures, integer(request.query_params, "number")
        if number >= len(pictures):
            raise HTTPException(404, "no such picture")
        return self._download("image/png", pictures[number].read_bytes(), pictures[number].name)

    async def _photograph(self, request: Request) -> Response:
        name, data = request.query_params.get("name", "photograph"), await self.body(request)
        photograph = await asyncio.to_thread(self.session.upload, data, name)
        return JSONResponse({"card": photograph.number, "name": photograph.name})

    def _download(self, kind: str, data: bytes, name: str) -> Response:
        """A file to be saved under the scene's name and its own."""
        whole = f"{self.session.viewed.name}-{name}"
        plain = "".join(c if c.isascii() and (c.isalnum() or c in "-_.") else "_" for c in whole)
        return Response(data, media_type=kind, headers={"content-disposition": f'attachment; filename="{plain}"'})

    async def body(self, request: Request) -> bytes:
        """A body of at most `_MAX_BODY` bytes. A longer one is refused by its header, or as soon as it is."""
        size = int(request.headers.get("content-length", "0"))  # digits: the parser refuses others
        body, pieces = bytearray(), request.stream().__aiter__()
        async with self._uploads:
            while size <= _MAX_BODY:
                try:
                    body += await asyncio.wait_for(anext(pieces), _TIMEOUT)
                except StopAsyncIteration:
                    return bytes(body)
                except TimeoutError:
                    raise HTTPException(408, "the request came too slowly") from None
                size = max(size, len(body))
        raise HTTPException(413, f"more than {_MAX_BODY} bytes: make the photograph smaller")


def _asset(kind: str, text: Callable[[], str]) -> Callable[[Request], Awaitable[Response]]:
    """The handler of a text of the page."""

    async def respond(request: Request) -> Response:
        return Response(text(), media_type=kind, headers={"content-security-policy": _POLICY})

    return respond


async def _wrong(request: Request, error: Exception) -> Response:
    return PlainTextResponse(f"{error}\n", 400)


async def _missing(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    return PlainTextResponse(f"{error.detail}\n", error.status_code)


def _listen(host: str, port: int) -> socket.socket:
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        return socket.create_server(address[:2], family=family)
    except OSError as error:
        raise UsageError(f"--host {host} --port {port}: cannot listen there ({error.strerror}); choose another port") from error
