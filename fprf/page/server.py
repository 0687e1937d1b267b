"""The HTTP server of the viewer: the page's requests, and its WebSocket of small messages."""

import asyncio
import contextlib
import json
import logging
import socket
import threading
from collections.abc import Callable, Hashable, Mapping
from itertools import count
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import uvicorn
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import BaseRoute, Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect
from uvicorn.protocols.http.h11_impl import H11Protocol

from ..errors import DataError, FprfError, UsageError
from . import EXAMPLES, css, read_asset, script
from .access import MAX_WAIT_SECONDS, Access, Guard, is_loopback, network_address, qr_code
from .messages import SEARCHED_SHARE, PictureRequest, StartRequest, read_message
from .start import Start

if TYPE_CHECKING:
    from .session import Session, Viewed

_MAX_HASH_CHARACTERS = 400
"""Characters of a link behind its #, at most: a view and the name of a style."""
_ANY_ADDRESS = ("0.0.0.0", "::")  # nosec B104  # recognised, never the default
_MAX_HEAD_BYTES = 16 << 10
"""Bytes of a request's head; browsers send less than one thousand."""
_MAX_CONNECTIONS = 64
"""Connections at the same time; by eye."""
_MAX_PAGES = 24
"""WebSockets at the same time; by eye."""
_MAX_RECEIVED_BODIES = 4
"""Bodies received at the same time: bounds the memory."""
_MAX_BODY_BYTES = 20 << 20
"""Bytes of a body: those of a photograph (`uploads.MAX_BYTES`)."""
_MAX_MESSAGE_BYTES = 1 << 16
"""Bytes of a WebSocket message; the page sends a few hundred."""
_LIVE_SCRIPTS = (
    *("requests.js", "notes.js", "field.js", "film.js", "saving.js", "panel.js"),
    *("photographs.js", "dropped.js", "live_sun.js", "start.js", "live.js"),
)
"""Scripts of the served page, beside those of every page."""
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; font-src data:; connect-src 'self'; "
    "worker-src blob:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)


class _Protocol(H11Protocol):  # type: ignore[misc]  # uvicorn's types are not followed
    """HTTP/1.1 with a time limit for the head of a request, which uvicorn does not have."""

    def connection_made(self, transport: asyncio.Transport) -> None:
        super().connection_made(transport)
        self.loop.call_later(MAX_WAIT_SECONDS, self._check_head, transport)

    def _check_head(self, transport: asyncio.Transport) -> None:
        if self.cycle is None and transport.get_protocol() is self:
            transport.close()


class Client:
    """A page's WebSocket: messages wait by their kind, a newer one takes the place of one that was not sent
    yet.
    """

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
                await (
                    socket.send_bytes(message) if isinstance(message, bytes) else socket.send_text(message)
                )


class ViewerServer:
    """Listens in a thread of its own as soon as it is made; `port` 0 takes a free one. A context manager.

    Shows that a scene is loading, a start page, or a scene. One request a connection; a client that breaks a
    rule loses its connection and harms no other. Raises UsageError where the address cannot be listened on.
    """

    def __init__(self, access: Access, port: int) -> None:
        self.access = access
        self._start: Start | None = None
        self._session: Session | None = None
        self._opened = contextlib.ExitStack()
        self._clients: dict[Hashable, Client] = {}
        self._numbers = count(1)
        self._waits: dict[str, Mapping[str, Any]] = {}
        """Waits of now, which a new page is told too."""
        self._uploads = asyncio.Semaphore(_MAX_RECEIVED_BODIES)
        self._loop: asyncio.AbstractEventLoop | None = None
        try:
            address = socket.getaddrinfo(access.host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[
                0
            ]
            self._listener = socket.create_server(address[4][:2], family=address[0])
        except OSError as error:
            fault = f"--host {access.host} --port {port}: cannot listen there ({error.strerror}); choose another port"
            raise UsageError(fault) from error
        self.port: int = self._listener.getsockname()[1]
        # A mistake of the page's user, or what this machine cannot do, is a line in the answer.
        wrong = dict.fromkeys(
            (FprfError, OSError), lambda request, error: PlainTextResponse(_line(error), 400)
        )
        app = Starlette(
            routes=self._routes(), middleware=[Middleware(Guard, access=access)], exception_handlers=wrong
        )
        # Bounded connections, heads and messages; no proxy is believed, and nothing of a request is logged.
        config = uvicorn.Config(
            app,
            loop="asyncio",
            http=_Protocol,
            ws="websockets-sansio",
            ws_max_size=_MAX_MESSAGE_BYTES,
            ws_per_message_deflate=False,
            interface="asgi3",
            lifespan="off",
            proxy_headers=False,
            log_config=None,
            log_level=logging.CRITICAL,
            access_log=False,
            server_header=False,
            limit_concurrency=_MAX_CONNECTIONS,
            h11_max_incomplete_event_size=_MAX_HEAD_BYTES,
        )
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(
            target=self._server.run, args=([self._listener],), name="fprf-http", daemon=True
        )
        self._thread.start()

    def __enter__(self) -> "ViewerServer":
        return self

    def __exit__(self, *_: object) -> None:
        self._close_session()
        # Open WebSockets would hold an orderly end up for ever.
        self._server.force_exit = True
        self._server.should_exit = True
        self._thread.join(5)
        self._listener.close()  # uvicorn leaves it open where it ends before it has begun

    @property
    def address(self) -> str:
        """The URL to open in a browser, with the token."""
        if self.access.host in _ANY_ADDRESS:
            host = network_address(self.access.host)
        else:
            host = self.access.host
        host = f"[{host}]" if ":" in host else host
        if self.access.token is None:
            token = ""
        else:
            token = f"?token={quote(self.access.token)}"
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

    def wait(self, kind: str, what: str = "", share: float | None = None) -> None:
        """Show on all pages how far something is that takes its time; done where `what` is empty."""
        self.post(None, f"wait {kind}", {"type": "wait", "kind": kind, "what": what, "share": share})

    def open(self, load: "Callable[[], Viewed]", *, warm: bool = True) -> "Session":
        """Load a scene and show it in the place of what was shown, prepared for the first photograph if it is
        to be `warm`.

        Raises what `load` raises, and DataError for an unreadable photograph.
        """
        from .session import Session

        try:
            self.wait("opening", "Reading the scene", 0.0)
            viewed = load()  # while what was open stays open
            self._close_session()
            self.wait("opening", f"{viewed.name}: preparing it for the browser", SEARCHED_SHARE)
            session = self._opened.enter_context(Session(viewed, self.post))
        finally:
            self.wait("opening")
        for path in viewed.references:
            try:
                session.upload(path.read_bytes(), path.name)
            except (DataError, OSError) as error:
                if isinstance(error, OSError):
                    why = error.strerror
                else:
                    why = str(error).removeprefix("photograph: ")
                raise DataError(f"{path}: {why}") from error
        if warm:
            session.warm_up()
        self._session = session
        self._greet()
        return session

    def post(self, client: Hashable | None, kind: str, message: Mapping[str, Any] | bytes) -> None:
        """Send one client, or all (None), a message; from any thread."""
        if not isinstance(message, bytes) and message["type"] == "wait":
            if message["what"]:
                self._waits[kind] = message
            else:
                self._waits.pop(kind, None)
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
        if self._start is None:
            start = []
        else:
            start = [("start", self._start.state())]
        if self._session is not None:  # without a start there is none to go back to
            return [*self._session.hello(), *start]
        return start or [("scene", {"type": "loading"})]

    def _close_session(self) -> None:
        self._session = None
        self._opened.close()

    def _routes(self) -> list[BaseRoute]:
        # The stage of any page, with the panel of the served one.
        examples = "\n".join(_example(name) for name in EXAMPLES)
        panel = Template(read_asset("panel.html")).substitute(examples=examples)
        stage = Template(read_asset("stage.html")).substitute(still="hidden", panel=panel)
        page = Template(read_asset("live.html")).substitute(stage=stage, examples=examples)
        return [
            Route("/", _asset("text/html", lambda: page)),
            Route("/app.js", _asset("text/javascript", lambda: script(*_LIVE_SCRIPTS) + "\nlive();\n")),
            Route("/app.css", _asset("text/css", lambda: css("live.css"))),
            WebSocketRoute("/live", self._live),
            Route("/scene", self._scene),
            Route("/colours", self._colours),
            Route("/surfaces", self._surfaces),
            Route("/light", self._light),
            Route("/card", self._card),
            Route("/address", self._address),
            Route("/code", self._code),
            Route("/examples/{name}", self._example),
            Route("/gaussians", self._gaussians),
            Route("/film", self._film),
            Route("/style", self._style),
            Route("/style", self._take_style, methods=["POST"]),
            Route("/picture", self._picture, methods=["POST"]),
            Route("/photograph", self._photograph, methods=["POST"]),
            Route("/preview", self._keep_preview, methods=["POST"]),
            Route("/start/preview", self._preview),
            Route("/start", self._start_request, methods=["POST"]),
            Route("/start/piece", self._start_piece, methods=["POST"]),
        ]

    async def _live(self, socket: WebSocket) -> None:
        if len(self._clients) >= _MAX_PAGES:
            raise HTTPException(503, "too many pages; close one and try again")
        await socket.accept()
        self._loop = asyncio.get_running_loop()
        # From here on it hears what is posted to all, beginning with what is shown now.
        number = next(self._numbers)
        client = Client()
        self._clients[number] = client
        for kind, message in (*self._hello(), *self._waits.items()):
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
                    except (FprfError, OSError) as error:
                        client.put("said", json.dumps({"type": "said", "text": _line(error), "bad": True}))

        # Whichever ends first, a client that leaves or one that does not read, ends the other.
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
        # A message that our page does not send: close as a violation of policy (RFC 6455, 7.4.1).
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

    async def _surfaces(self, request: Request) -> Response:
        return Response(
            await asyncio.to_thread(self.session.lights.surfaces), media_type="application/octet-stream"
        )

    async def _light(self, request: Request) -> Response:
        data = self.session.lights.light(request.query_params.get("name", ""))
        return Response(data, media_type="application/octet-stream")

    async def _colours(self, request: Request) -> Response:
        data = self.session.colours(request.query_params.get("name", ""))
        return Response(data, media_type="application/octet-stream")

    async def _card(self, request: Request) -> Response:
        from ..io.images import encode

        photograph = self.session.state.photograph(_integer(request, "card"))
        return Response(encode(photograph.thumbnail, "webp"), media_type="image/webp")

    def _shared(self) -> str:
        """The address of the page for other machines, with the token. Raises HTTPException where this machine
        alone may connect.
        """
        if is_loopback(self.access.host):
            raise HTTPException(404, "this machine alone may connect; --host lets others")
        return self.address

    async def _address(self, request: Request) -> Response:
        if is_loopback(self.access.host):
            return Response(
                status_code=204
            )  # every page asks, and browsers write refusals into their console
        return Response(self._shared(), media_type="text/plain")

    async def _code(self, request: Request) -> Response:
        """A picture of the address as a QR code, with what stands behind its #."""
        from ..io.images import encode

        behind = request.query_params.get("hash", "")[:_MAX_HASH_CHARACTERS]
        return Response(encode(qr_code(f"{self._shared()}#{behind}"), "png"), media_type="image/png")

    async def _example(self, request: Request) -> Response:
        path = EXAMPLES.get(request.path_params["name"])
        if path is None:
            raise HTTPException(404, "no such photograph")
        return FileResponse(path)

    async def _gaussians(self, request: Request) -> Response:
        query = request.query_params
        shown = query.get("shown", "Now")
        start = query.get("start", "Captured")
        share = _integer(request, "percent") / 100 if "percent" in query else 1.0
        suffix = f".{query.get('format', 'ply')}"
        path = await asyncio.to_thread(self.session.gaussians, shown, start, min(1.0, share), suffix)
        return self._download(path, f"{_file_name(shown)}{suffix}")

    async def _style(self, request: Request) -> Response:
        shown = request.query_params.get("shown", "Now")
        path = await asyncio.to_thread(self.session.style_archive, shown)
        return self._download(path, f"{_file_name(shown)}.zip")

    async def _take_style(self, request: Request) -> Response:
        data = await self.body(request)
        await asyncio.to_thread(self.session.take_style, data)
        return JSONResponse({})

    async def _picture(self, request: Request) -> Response:
        asked = read_message(await self.body(request), PictureRequest)
        data = await asyncio.to_thread(self.session.picture, asked)
        return Response(data, media_type="image/png")

    async def _film(self, request: Request) -> Response:
        path = self.session.state.film.path
        if path is None or not path.is_file():
            raise HTTPException(404, "no film yet")
        return self._download(path, f"{path.parent.name}.mp4")

    def _download(self, path: Path, name: str) -> Response:
        """A file to be saved under the scene's name and its own."""
        return FileResponse(path, filename=f"{self.session.viewed.name}-{name}")

    async def _photograph(self, request: Request) -> Response:
        name = request.query_params.get("name", "photograph")
        data = await self.body(request)
        join = "join" in request.query_params
        photograph = await asyncio.to_thread(lambda: self.session.upload(data, name, join=join))
        return JSONResponse({"card": photograph.number, "name": photograph.name})

    @property
    def start(self) -> Start:
        """The start page. Raises HTTPException where there is none."""
        if self._start is None:
            raise HTTPException(404, "no start page here")
        return self._start

    async def _keep_preview(self, request: Request) -> Response:
        data = await self.body(request)
        await asyncio.to_thread(self.session.keep_preview, data)
        return JSONResponse({})

    async def _preview(self, request: Request) -> Response:
        data = await asyncio.to_thread(self.start.preview, request.query_params.get("name", ""))
        if data is None:
            return Response(status_code=204)  # none yet; browsers write refusals into their console
        return Response(data, media_type="image/webp")

    async def _start_request(self, request: Request) -> Response:
        asked = read_message(await self.body(request), StartRequest)
        return JSONResponse(await asyncio.to_thread(self.start.handle, asked))

    async def _start_piece(self, request: Request) -> Response:
        query = request.query_params
        data = await self.body(request)
        place = (
            query.get("scene", ""),
            query.get("name", ""),
            _integer(request, "at"),
            _integer(request, "size"),
        )
        await asyncio.to_thread(self.start.piece, *place, data)
        return JSONResponse({})

    async def body(self, request: Request) -> bytes:
        """A body of at most `_MAX_BODY_BYTES` bytes. A longer one is refused by its header, or as soon as it is."""
        body = bytearray()
        async with self._uploads:
            try:
                async with asyncio.timeout(MAX_WAIT_SECONDS) as patience:
                    size = int(
                        request.headers.get("content-length", "0")
                    )  # digits: the parser refuses others
                    stream = request.stream()
                    while size <= _MAX_BODY_BYTES:
                        if (piece := await anext(stream, None)) is None:
                            return bytes(body)
                        body += piece
                        size = max(size, len(body))
                        patience.reschedule(asyncio.get_running_loop().time() + MAX_WAIT_SECONDS)
            except TimeoutError:
                raise HTTPException(408, "the request came too slowly") from None
        raise HTTPException(413, f"more than {_MAX_BODY_BYTES} bytes: make the photograph smaller")


def _line(error: Exception) -> str:
    """The text of an error for the client; of an OSError its file and reason."""
    if isinstance(error, OSError) and error.filename:
        return f"{error.filename}: {error.strerror}"
    return str(error)


def _file_name(shown: str) -> str:
    """Name of a saved file of a look, beside its scene."""
    if shown == "Now":
        return "restyled"
    return "".join(c if c.isalnum() or c in "-_" else "-" for c in shown).strip("-").lower() or "look"


def _integer(request: Request, name: str) -> int:
    """A whole number from 0 on, of at most 12 digits, in a query. Raises UsageError for anything else."""
    text = request.query_params.get(name, "")
    if not (text.isdigit() and text.isascii() and len(text) <= 12):
        raise UsageError(f"{name}: {text[:20]!r} is no number from 0")
    return int(text)


def _example(name: str) -> str:
    """A photograph that ships with fprf, as a link that saves it where no script takes it."""
    link = f'class="example" data-example="{name}" href="/examples/{name}" download title="by Greg Zaal, CC0"'
    word = name.partition(".")[0].capitalize()
    return f'<a {link}><img src="/examples/{name}" alt="">{word}</a>'


def _asset(kind: str, text: Callable[[], str]) -> Callable[[Request], Response]:
    """The handler of a text of the page."""
    return lambda request: Response(text(), media_type=kind, headers={"content-security-policy": _POLICY})
