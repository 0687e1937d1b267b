"""The one door of the viewer: an HTTP server that checks who comes, serves the page, takes photographs, and passes checked
WebSocket messages on to viser, which itself listens where no other page can find it.

One request a connection. Whatever a client does wrong ends its own connection and nothing else.
"""

import asyncio
import contextlib
import threading
from collections.abc import Awaitable, Callable, Mapping
from http import HTTPStatus
from typing import NamedTuple
from urllib.parse import parse_qs, urlsplit

from ..errors import FprfError, UsageError
from .access import COOKIE, Access
from .wire import Inbox

__all__ = ["Answer", "Gate", "Request"]

_HEAD = 16 << 10
"""Bytes of a request's head."""
_PATIENCE = 15.0
"""Seconds within which a head must be there, and within which each piece of a body must follow."""
_CONNECTIONS = 64
_BODIES = 4
"""Bodies that are taken in at once: bounds the memory."""
_PIECE = 1 << 16

_SAFE = {
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "cache-control": "no-store",
}


class Request(NamedTuple):
    """What a client asks."""

    method: str
    path: str
    query: Mapping[str, str]
    headers: Mapping[str, str]
    body: bytes = b""


class Answer(NamedTuple):
    """What it gets."""

    status: int
    kind: str
    body: bytes
    headers: Mapping[str, str] = {}


class _Refused(Exception):
    def __init__(self, status: int, text: str) -> None:
        super().__init__(text)
        self.status = status


Handler = Callable[[Request], Awaitable[Answer]]


class Gate:
    """Listens in a thread of its own. `routes` are by method and path; `lead` changes them, and says where viser listens."""

    def __init__(
        self,
        access: Access,
        port: int,
        routes: Mapping[tuple[str, str], Handler],
        *,
        largest: int,
    ) -> None:
        self.access, self.port = access, port
        self._routes, self._largest = routes, largest
        self._inner: tuple[tuple[str, int], Callable[[bytes], None]] | None = None
        self._loop = asyncio.new_event_loop()
        self._server: asyncio.Server | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        self._bodies = asyncio.Semaphore(_BODIES)
        self._thread = threading.Thread(target=self._loop.run_forever, name="fprf-gate", daemon=True)

    def open(self) -> None:
        """Listen. Raises UsageError where the address or the port cannot be had; `port` 0 takes a free one and becomes it."""
        self._thread.start()
        try:
            self._server = asyncio.run_coroutine_threadsafe(
                asyncio.start_server(self._meet, self.access.host, self.port, limit=_HEAD), self._loop
            ).result()
        except OSError as error:
            self.close()
            raise UsageError(
                f"--host {self.access.host} --port {self.port}: cannot listen there ({error.strerror}); choose another port"
            ) from error
        self.port = self._server.sockets[0].getsockname()[1]

    def lead(self, routes: Mapping[tuple[str, str], Handler], inner: tuple[str, int], check: Callable[[bytes], None]) -> None:
        """From now on to these pages, and over WebSockets to `inner`; `check` raises for messages that are not passed on."""
        self._routes, self._inner = routes, (inner, check)

    def close(self) -> None:
        """Hang up on everybody."""
        if self._thread.is_alive():
            asyncio.run_coroutine_threadsafe(self._end(), self._loop).result(5)
            self._loop.call_soon_threadsafe(self._loop.stop)
            self._thread.join(5)
            self._loop.close()

    async def _end(self) -> None:
        if self._server is not None:
            self._server.close()
        tasks = list(self._tasks)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    async def _meet(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._tasks.add(task)
        try:
            await self._serve(reader, writer)
        except _Refused as refused:
            with contextlib.suppress(OSError):
                await _send(writer, Answer(refused.status, "text/plain; charset=utf-8", f"{refused}\n".encode()))
        except (OSError, EOFError, TimeoutError, FprfError):
            pass  # the client has gone, is too slow, or talks nonsense
        except asyncio.CancelledError:
            pass
        finally:
            self._tasks.discard(task)
            writer.close()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if len(self._tasks) > _CONNECTIONS:
            raise _Refused(503, "too many connections")
        head = await _head(reader)
        request = _parsed(head)
        given = request.query.get("token")
        refusal = self.access.refusal(request.headers, given)
        if refusal is not None:
            raise _Refused(403, refusal)
        if given is not None and request.method == "GET":
            # Out of the address bar and its history; the cookie goes to this very server alone.
            cookie = f"{COOKIE}={given}; Path=/; HttpOnly; SameSite=Strict"
            await _send(writer, Answer(303, "text/plain", b"", {"location": request.path, "set-cookie": cookie}))
            return
        if request.headers.get("upgrade", "").lower() == "websocket":
            await self._pass_on(head, reader, writer)
            return
        handler = self._routes.get((request.method, request.path))
        if handler is None:
            known = any(path == request.path for _, path in self._routes)
            raise _Refused(405 if known else 404, "no such page")
        if request.method == "POST":
            async with self._bodies:
                answer = await _answered(handler, request._replace(body=await self._body(reader, request)))
        else:
            answer = await _answered(handler, request)
        await _send(writer, answer)

    async def _body(self, reader: asyncio.StreamReader, request: Request) -> bytes:
        text = request.headers.get("content-length", "")
        if not (text.isascii() and text.isdigit()) or len(text) > 15:
            raise _Refused(411, "say how long it is")
        size = int(text)
        if size > self._largest:
            raise _Refused(413, f"{size} bytes; at most {self._largest} are taken: make the photograph smaller")
        body = bytearray()
        while len(body) < size:
            piece = await asyncio.wait_for(reader.read(min(_PIECE, size - len(body))), _PATIENCE)
            if not piece:
                raise EOFError
            body += piece
        return bytes(body)

    async def _pass_on(self, head: bytes, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Be the wire between the page and viser; what the page says is looked at first."""
        if self._inner is None:
            raise _Refused(503, "still starting; try again")
        (host, port), check = self._inner
        there, back = await asyncio.open_connection(host, port)
        try:
            back.write(head)
            ways = [asyncio.create_task(_up(reader, back, check)), asyncio.create_task(_down(there, writer))]
            _, rest = await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
            for way in rest:
                way.cancel()
            await asyncio.gather(*ways, return_exceptions=True)
        finally:
            back.close()


async def _up(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, check: Callable[[bytes], None]) -> None:
    inbox = Inbox()
    while data := await reader.read(_PIECE):
        for message in inbox.feed(data):
            if message.payload is not None:
                check(message.payload)
            writer.write(message.raw)
        await writer.drain()


async def _answered(handler: Handler, request: Request) -> Answer:
    try:
        return await handler(request)
    except FprfError as error:
        return Answer(400, "text/plain; charset=utf-8", f"{error}\n".encode())


async def _down(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    while data := await reader.read(_PIECE):
        writer.write(data)
        await writer.drain()


async def _head(reader: asyncio.StreamReader) -> bytes:
    try:
        return await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), _PATIENCE)
    except asyncio.LimitOverrunError:
        raise _Refused(431, "the request's head is too long") from None


def _parsed(head: bytes) -> Request:
    lines = head.decode("latin-1").split("\r\n")
    words = lines[0].split(" ")
    if len(words) != 3 or not words[2].startswith("HTTP/1."):
        raise _Refused(400, "not an HTTP/1 request")
    headers: dict[str, str] = {}
    for line in lines[1:]:
        name, colon, value = line.partition(":")
        name = name.lower()
        if line and (not colon or (name in headers and name in ("host", "origin", "content-length"))):
            raise _Refused(400, "a header that is none, or comes twice")
        headers.setdefault(name, value.strip())
    try:
        target = urlsplit(words[1])
        query = {key: values[0] for key, values in parse_qs(target.query, max_num_fields=16).items()}
    except ValueError:
        raise _Refused(400, "an address that is none") from None
    return Request(words[0], target.path, query, headers)


async def _send(writer: asyncio.StreamWriter, answer: Answer) -> None:
    fields = {"content-type": answer.kind, "content-length": str(len(answer.body)), "connection": "close", **_SAFE}
    lines = [
        f"HTTP/1.1 {answer.status} {HTTPStatus(answer.status).phrase}",
        *(f"{k}: {v}" for k, v in (fields | dict(answer.headers)).items()),
    ]
    writer.write("\r\n".join(lines).encode("latin-1") + b"\r\n\r\n" + answer.body)
    await asyncio.wait_for(writer.drain(), _PATIENCE)
