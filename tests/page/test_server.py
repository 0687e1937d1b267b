"""Hostile and slow clients, origins, tokens and sizes, on a server of its own."""

import json
import socket
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from types import SimpleNamespace
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import BaseRoute, Route
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from fprf.errors import UsageError
from fprf.page import EXAMPLES, access, server
from fprf.page.access import Access, cookie_name, make_access, network_address
from fprf.page.server import Client, ViewerServer

HERE = Access("127.0.0.1", None)
TOKEN = "a-token-of-sixteen-characters"
THERE = Access("0.0.0.0", TOKEN)
COOKIE = "fprf-token-8080"


def test_this_machine_alone_is_let_in_by_its_names_and_from_its_own_pages() -> None:
    for name in ("127.0.0.1:8080", "localhost:8080", "localhost", "[::1]:8080", "127.9.8.7:1"):
        assert (
            HERE.refusal({"host": name}) is None
            and HERE.refusal({"host": name, "origin": f"http://{name}"}) is None
        )
    for name in (
        "evil.example:8080",
        "127.0.0.1.evil.example",
        "",
        "[",
        "192.168.0.7:8080",
        "localhost.evil",
    ):
        assert HERE.refusal({"host": name}) is not None
    for origin in ("http://evil.example", "null", "http://127.0.0.1:9999", "", "https://localhost:8080"):
        assert HERE.refusal({"host": "127.0.0.1:8080", "origin": origin}) is not None


def test_from_elsewhere_a_token_is_needed_in_one_of_three_places() -> None:
    host = {"host": "machine.example:8080"}
    assert THERE.refusal(host, TOKEN) is None
    assert THERE.refusal({**host, "cookie": f"other=1; {COOKIE}={TOKEN}"}) is None
    assert THERE.refusal({**host, "authorization": f"Bearer {TOKEN}"}) is None
    assert THERE.refusal(host) is not None and THERE.refusal({}, TOKEN) is not None
    assert THERE.refusal(host, "wrong-token-of-16-chars") is not None
    assert THERE.refusal(host, "töken-that-is-no-ascii") is not None
    assert THERE.refusal({**host, "cookie": f"{COOKIE}=x{TOKEN}"}) is not None
    both = {
        "cookie": f"{COOKIE}={TOKEN}; fprf-token-8081=another; fprf-token-80={TOKEN}"
    }  # viewers on other ports
    assert (
        THERE.refusal({**host, **both}) is None and THERE.refusal({"host": "[::1]:8081", **both}) is not None
    )
    assert THERE.refusal({"host": "[::1]", **both}) is None
    assert THERE.refusal({**host, "origin": "http://evil.example", "cookie": f"{COOKIE}={TOKEN}"}) is not None


def test_tokens_are_made_where_they_are_needed_and_weak_ones_are_refused() -> None:
    assert make_access("127.0.0.1", None).token is None and make_access("localhost", TOKEN).token == TOKEN
    one, two = (make_access("0.0.0.0", None).token for _ in range(2))
    assert one is not None and two is not None and one != two and len(one) >= 32
    for token in ("short", "", "with spaces in its midst", "tökentökentökentök", "line\nbreak-in-a-long"):
        with pytest.raises(UsageError, match="--token"):
            make_access("127.0.0.1", token)


class Probe(ViewerServer):
    """The viewer's server with some more pages."""

    def _routes(self) -> list[BaseRoute]:
        async def echo(request: Request) -> Response:
            return JSONResponse({"size": len(await self.body(request)), "query": dict(request.query_params)})

        async def film(request: Request) -> Response:
            return Response(b"x" * (64 << 20), media_type="video/mp4")

        async def full(request: Request) -> Response:
            raise PermissionError(13, "Permission denied", "/made/yard")

        return [
            Route("/full", full),
            Route("/echo", echo, methods=["POST"]),
            Route("/film64", film),
            *super()._routes(),
        ]


@pytest.fixture
def http(monkeypatch: pytest.MonkeyPatch) -> Iterator[ViewerServer]:
    monkeypatch.setattr(server, "_MAX_BODY_BYTES", 100_000)
    for module in (server, access):
        monkeypatch.setattr(module, "MAX_WAIT_SECONDS", 0.5)
    with Probe(HERE, 0) as found:
        yield found


def connected(http: ViewerServer) -> socket.socket:
    return socket.create_connection(("127.0.0.1", http.port), timeout=30)


def talk(http: ViewerServer, data: bytes) -> bytes:
    """The answer to some bytes, as soon as the server hangs up."""
    with connected(http) as wire:
        wire.sendall(data)
        answer = b""
        while piece := wire.recv(65536):
            answer += piece
    return answer


def request(http: ViewerServer, line: str, *headers: str, body: bytes = b"") -> bytes:
    return talk(
        http,
        "\r\n".join([f"{line} HTTP/1.1", f"Host: 127.0.0.1:{http.port}", *headers, "", ""]).encode() + body,
    )


def status(http: ViewerServer, line: str, *headers: str, body: bytes = b"") -> int:
    return int(request(http, line, *headers, body=body).split(b" ", 2)[1])


def test_a_page_comes_with_headers_that_keep_it_to_itself(http: ViewerServer) -> None:
    answer = request(http, "GET /")
    assert answer.startswith(b"HTTP/1.1 200 ") and answer.endswith(b"</html>\n")
    for header in (b"x-frame-options: DENY", b"x-content-type-options: nosniff", b"connection: close"):
        assert header in answer


def test_photographs_that_ship_are_offered_and_no_other_file(http: ViewerServer) -> None:
    page = request(http, "GET /").decode()
    for name, path in EXAMPLES.items():
        assert f'data-example="{name}"' in page
        assert request(http, f"GET /examples/{name}").endswith(path.read_bytes())
    assert len(EXAMPLES) >= 4 and status(http, "GET /examples/..%2ftransforms.json") == 404


def test_bodies_and_queries_arrive(http: ViewerServer) -> None:
    body = b"x" * 100_000
    chunked = f"{len(body):x}\r\n".encode() + body + b"\r\n0\r\n\r\n"
    for header, sent in (("Content-Length: 100000", body), ("Transfer-Encoding: chunked", chunked)):
        answer = request(http, "POST /echo?name=a%20b&x=1", header, body=sent)
        assert json.loads(answer.rpartition(b"\r\n\r\n")[2]) == {
            "size": 100_000,
            "query": {"name": "a b", "x": "1"},
        }


@pytest.mark.parametrize(
    ("line", "headers", "body", "expected"),
    [
        ("GET /nowhere", (), b"", 404),
        ("DELETE /", (), b"", 405),
        ("GET /scene", (), b"", 400),
        ("POST /echo", ("Content-Length: -1",), b"", 400),
        ("POST /echo", ("Content-Length: 100001",), b"", 413),
        ("POST /echo", ("Content-Length: 99999999999999",), b"", 413),
        (
            "POST /echo",
            ("Transfer-Encoding: chunked",),
            b"186a1\r\n" + b"x" * 0x186A1 + b"\r\n0\r\n\r\n",
            413,
        ),
        ("POST /echo", ("Content-Length: 1", "Content-Length: 2"), b"", 400),
        ("POST /echo", ("Content-Length: 10",), b"slow", 408),
        ("GET /", ("Origin: http://evil.example",), b"", 403),
        ("GET /", ("Origin: http://127.0.0.1", "Origin: http://evil.example"), b"", 400),
        ("GET /", ("Host: evil.example",), b"", 400),
        ("GET /?" + "a=1&" * 20, (), b"", 400),
    ],
)
def test_what_is_wrong_is_refused(
    http: ViewerServer, line: str, headers: tuple[str, ...], body: bytes, expected: int
) -> None:
    assert status(http, line, *headers, body=body) == expected
    assert status(http, "GET /") == 200


def test_what_the_system_refuses_is_told(http: ViewerServer) -> None:
    answer = request(http, "GET /full")
    assert answer.startswith(b"HTTP/1.1 400 ") and answer.endswith(b"/made/yard: Permission denied")

    def handle(client: int, message: object) -> None:
        raise OSError(28, "No space left on device", "/films")

    http._session = SimpleNamespace(hello=list, handle=handle, disconnect=str)  # type: ignore[assignment]
    with opened(http) as client:
        client.send(GOOD)
        assert json.loads(client.recv())["text"] == "/films: No space left on device"


def test_nonsense_and_half_heads_end_their_own_connection_alone(http: ViewerServer) -> None:
    for data in (
        b"",
        b"\x16\x03\x01\x02\x00",
        b"\0" * 100 + b"\r\n\r\n",
        b"GET / HTTP/1.1\r\nX: " + b"y" * 20_000,
    ):
        talk(http, data)
        assert status(http, "GET /") == 200


def test_idle_connections_are_closed_and_do_not_shut_others_out(http: ViewerServer) -> None:
    wires = [connected(http) for _ in range(80)]
    deadline = time.monotonic() + 30
    while status(http, "GET /") != 200:
        assert time.monotonic() < deadline
        time.sleep(0.05)
    for wire in wires:
        assert wire.recv(1) == b""
        wire.close()


def test_a_client_that_does_not_read_is_dropped(http: ViewerServer) -> None:
    with connected(http) as wire:
        wire.sendall(f"GET /film64 HTTP/1.1\r\nHost: 127.0.0.1:{http.port}\r\n\r\n".encode())
        time.sleep(1.5)
        size = 0
        while piece := wire.recv(1 << 20):
            size += len(piece)
    assert size < 64 << 20


def test_a_token_in_the_address_becomes_a_cookie() -> None:
    with Probe(Access("127.0.0.1", TOKEN), 0) as http:
        assert http.address.endswith(f"/?token={TOKEN}")
        assert status(http, "GET /scene") == status(http, "GET /") == status(http, "GET /?token=wrong") == 403
        answer = request(http, f"GET /?token={TOKEN}")
        name = cookie_name(f"127.0.0.1:{http.port}")
        assert answer.startswith(b"HTTP/1.1 303 ") and b"location: /\r\n" in answer
        assert f"set-cookie: {name}={TOKEN}; Path=/; HttpOnly; SameSite=Lax".encode() in answer
        assert status(http, "GET /", f"Cookie: {name}={TOKEN}") == 200
        assert status(http, "POST /echo", f"Cookie: {name}={TOKEN}", "Content-Length: 0") == 200
        assert status(http, "POST /echo", "Content-Length: 0") == 403
        with pytest.raises(InvalidStatus) as told, opened(http):
            pass
        assert told.value.response.status_code == 403


def test_an_address_for_others_comes_with_its_code_where_others_may_connect(http: ViewerServer) -> None:
    assert status(http, "GET /address") == 204, "this machine alone may connect"
    assert status(http, "GET /code") == 404
    with ViewerServer(Access("0.0.0.0", TOKEN), 0) as shared:
        cookie = f"Cookie: {cookie_name(f'127.0.0.1:{shared.port}')}={TOKEN}"
        address = request(shared, "GET /address", cookie).partition(b"\r\n\r\n")[2].decode()
        assert address.endswith(f":{shared.port}/?token={TOKEN}")
        picture = request(shared, "GET /code?hash=v%3D1%2C2%26s%3Dnight", cookie).partition(b"\r\n\r\n")[2]
    modules = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_GRAYSCALE)
    code = cv2.resize(modules, None, fx=8, fy=8, interpolation=cv2.INTER_NEAREST)
    text, _, _ = cv2.QRCodeDetector().detectAndDecode(cv2.copyMakeBorder(code, 32, 32, 32, 32, 0, value=255))
    assert text == f"{address}#v=1,2&s=night"


def opened(http: ViewerServer, **more: object) -> ClientConnection:
    return connect(f"ws://127.0.0.1:{http.port}/live", compression=None, proxy=None, **more)  # type: ignore[arg-type]


GOOD = '{"type": "set", "name": "strength", "value": 0.5}'


def test_messages_pass_until_one_is_bad_and_then_that_client_is_out(http: ViewerServer) -> None:
    with opened(http) as bad, opened(http) as other:
        assert json.loads(bad.recv()) == json.loads(other.recv()) == {"type": "loading"}
        for message in (GOOD, [GOOD[:10], GOOD[10:]]):
            bad.send(message)
        http.notify("hello")
        assert json.loads(bad.recv())["text"] == "hello"
        bad.send('{"type": "shutdown"}')
        with pytest.raises(ConnectionClosed) as told:
            bad.recv()
        assert told.value.rcvd is not None and told.value.rcvd.code == 1008
        other.send(GOOD)
        http.notify("still there")
        assert "hello" in other.recv() and "still there" in other.recv()


@pytest.mark.parametrize(
    "message",
    ["x" * (1 << 17), ["x" * 60_000, "x" * 60_000], b"bytes", b"\xff", GOOD + "x", "", "[" * 60_000],
)
def test_messages_that_are_no_message_end_the_connection(
    http: ViewerServer, message: bytes | list[str] | str
) -> None:
    with opened(http) as client, pytest.raises(ConnectionClosed):
        client.recv()
        client.send(message)
        client.recv()
    assert status(http, "GET /") == 200


def test_websockets_of_other_sites_and_too_many_are_refused(
    http: ViewerServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(InvalidStatus) as told, opened(http, origin="http://evil.example"):
        pass
    assert told.value.response.status_code == 403
    with opened(http, origin=f"http://127.0.0.1:{http.port}") as client:
        client.recv()
        monkeypatch.setattr(server, "_MAX_PAGES", 1)
        with pytest.raises(InvalidStatus), opened(http):
            pass
    assert status(http, "GET /") == 200


def test_a_client_that_is_slow_gets_the_newest_of_each_kind_alone() -> None:
    client = Client()
    for number in range(1000):
        client.put("state", str(number))
        client.put(f"said {number % 2}", str(number))
    assert client._waiting == {"said 0": "998", "state": "999", "said 1": "999"}


def test_an_address_for_the_network_is_printed_where_it_is_listened_to() -> None:
    with ViewerServer(THERE, 0) as found:
        host = urlsplit(found.address).hostname
        assert host == network_address("0.0.0.0") and found.address.endswith(f"?token={TOKEN}")
        socket.create_connection((host, found.port), timeout=30).close()  # it leads here


def test_without_a_network_it_is_that_of_this_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    def unreachable(self: socket.socket, address: object) -> None:
        raise OSError(101, "Network is unreachable")

    monkeypatch.setattr(socket.socket, "connect", unreachable)
    assert network_address("0.0.0.0") == "127.0.0.1"
    monkeypatch.undo()
    monkeypatch.setattr(socket.socket, "getsockname", lambda self: ("10.1.2.3", 4))
    assert network_address("0.0.0.0") == "10.1.2.3", "not the loopback, which other machines cannot reach"


def page_of(address: str) -> bytes:
    with urllib.request.urlopen(address, timeout=60) as answer:
        found: bytes = answer.read()
        return found


def test_before_the_scene_is_there_a_page_says_so() -> None:
    with ViewerServer(HERE, 0) as found:
        address = found.address
        assert b"Loading the scene" in page_of(address) and b"class Splats" in page_of(f"{address}app.js")
        found.notify("nobody hears this")

        def load() -> None:
            raise UsageError("no such run")

        with pytest.raises(UsageError, match="no such run"):
            found.open(load)  # type: ignore[arg-type]
        for path in ("scene", "colours?name=x", "card?card=1", "gaussians", "film"):
            with pytest.raises(urllib.error.HTTPError, match="400") as refused:
                page_of(f"{address}{path}")
            refused.value.close()
        with pytest.raises(UsageError, match="choose another port"):
            ViewerServer(HERE, found.port)
    with pytest.raises(OSError):
        page_of(address)
