"""The gate with real sockets on this machine."""

import json
import socket
import threading
import time
from collections.abc import Iterator

import pytest
from test_wire import frame

from fprf.errors import DataError, UsageError
from fprf.viewer.access import COOKIE, Access
from fprf.viewer.server import Answer, Gate, Request

TOKEN = "a-token-of-sixteen-characters"


async def hello(request: Request) -> Answer:
    return Answer(200, "text/plain", b"hello")


async def echo(request: Request) -> Answer:
    return Answer(200, "application/json", json.dumps({"size": len(request.body), "query": dict(request.query)}).encode())


async def angry(request: Request) -> Answer:
    raise UsageError("the scene has no such thing")


async def broken(request: Request) -> Answer:
    raise ValueError("a fault of ours")


ROUTES = {("GET", "/"): hello, ("POST", "/echo"): echo, ("GET", "/angry"): angry, ("GET", "/broken"): broken}


@pytest.fixture
def gate() -> Iterator[Gate]:
    gate = Gate(Access("127.0.0.1", None), 0, ROUTES, largest=1000)
    gate.open()
    yield gate
    gate.close()


def talk(gate: Gate, data: bytes) -> bytes:
    with socket.create_connection(("127.0.0.1", gate.port), timeout=30) as wire:
        wire.sendall(data)
        found = b""
        while piece := wire.recv(65536):
            found += piece
    return found


def request(gate: Gate, line: str, *headers: str, body: bytes = b"", host: str | None = None) -> bytes:
    name = f"127.0.0.1:{gate.port}" if host is None else host
    return talk(gate, "\r\n".join([f"{line} HTTP/1.1", f"Host: {name}", *headers, "", ""]).encode() + body)


def status(answer: bytes) -> int:
    return int(answer.split(b" ", 2)[1])


def test_a_page_comes_with_headers_that_keep_it_to_itself(gate: Gate) -> None:
    answer = request(gate, "GET /")
    assert status(answer) == 200 and answer.endswith(b"\r\n\r\nhello")
    for header in (b"x-frame-options: DENY", b"x-content-type-options: nosniff", b"connection: close"):
        assert header in answer


def test_bodies_and_queries_arrive(gate: Gate) -> None:
    answer = request(gate, "POST /echo?name=a%20b&x=1", "Content-Length: 1000", body=b"x" * 1000)
    assert json.loads(answer.rpartition(b"\r\n\r\n")[2]) == {"size": 1000, "query": {"name": "a b", "x": "1"}}


@pytest.mark.parametrize(
    ("line", "headers", "expected"),
    [
        ("GET /nowhere", (), 404),
        ("DELETE /", (), 405),
        ("POST /echo", (), 411),
        ("POST /echo", ("Content-Length: -1",), 411),
        ("POST /echo", ("Content-Length: 1001",), 413),
        ("POST /echo", ("Content-Length: 99999999999999",), 413),
        ("POST /echo", ("Content-Length: 1", "Content-Length: 2"), 400),
        ("GET /", ("Origin: http://evil.example",), 403),
        ("GET /", ("Host: evil.example",), 400),
        ("GET /angry", (), 400),
        ("GET / extra", (), 400),
        ("GET /", ("no colon",), 400),
        ("GET /", ("X: " + "y" * 20_000,), 431),
        ("GET http://[bad/", (), 400),
        ("GET /", ("Upgrade: websocket", "Connection: Upgrade"), 503),
    ],
)
def test_what_is_wrong_is_refused(gate: Gate, line: str, headers: tuple[str, ...], expected: int) -> None:
    assert status(request(gate, line, *headers)) == expected
    assert status(request(gate, "GET /")) == 200


def test_faults_are_told_as_text(gate: Gate) -> None:
    assert b"the scene has no such thing" in request(gate, "GET /angry")


def test_another_name_for_this_machine_is_refused(gate: Gate) -> None:
    assert status(request(gate, "GET /", host="evil.example")) == 403


@pytest.mark.parametrize("data", [b"", b"\x16\x03\x01\x02\x00", b"GET / HTTP/1.1\r\n", b"\r\n\r\n", b"\0" * 100 + b"\r\n\r\n"])
def test_nonsense_ends_its_own_connection_alone(gate: Gate, data: bytes) -> None:
    with socket.create_connection(("127.0.0.1", gate.port)) as wire:
        wire.sendall(data)
    assert status(request(gate, "GET /")) == 200


def test_many_idle_connections_do_not_shut_others_out_for_good(gate: Gate) -> None:
    wires = [socket.create_connection(("127.0.0.1", gate.port)) for _ in range(80)]
    time.sleep(0.2)
    for wire in wires:
        wire.close()
    deadline = time.monotonic() + 30
    while status(request(gate, "GET /")) != 200:
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_a_token_in_the_address_becomes_a_cookie() -> None:
    gate = Gate(Access("127.0.0.1", TOKEN), 0, ROUTES, largest=1000)
    gate.open()
    try:
        assert status(request(gate, "GET /")) == 403
        assert status(request(gate, "GET /?token=wrong")) == 403
        answer = request(gate, f"GET /?token={TOKEN}")
        assert status(answer) == 303 and b"location: /\r\n" in answer
        assert f"set-cookie: {COOKIE}={TOKEN}; Path=/; HttpOnly; SameSite=Strict".encode() in answer
        assert status(request(gate, "GET /", f"Cookie: {COOKIE}={TOKEN}")) == 200
        assert status(request(gate, "POST /echo", f"Cookie: {COOKIE}={TOKEN}", "Content-Length: 0")) == 200
        assert status(request(gate, "POST /echo", "Content-Length: 0")) == 403
    finally:
        gate.close()


def test_a_port_that_is_taken_is_told(gate: Gate) -> None:
    other = Gate(Access("127.0.0.1", None), gate.port, ROUTES, largest=1000)
    with pytest.raises(UsageError, match=f"--port {gate.port}"):
        other.open()


class Inner:
    """A server that says hello and then sends back what it gets."""

    def __init__(self) -> None:
        self.got = b""
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.address: tuple[str, int] = self.listener.getsockname()
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        while True:
            try:
                wire, _ = self.listener.accept()
            except OSError:
                return
            threading.Thread(target=self._serve, args=(wire,), daemon=True).start()

    def _serve(self, wire: socket.socket) -> None:
        with wire:
            while data := wire.recv(65536):
                self.got += data
                wire.sendall(data[-20:])


def check(payload: bytes) -> None:
    if payload.startswith(b"bad"):
        raise DataError("message: bad")


def test_messages_pass_until_one_is_bad_and_then_that_client_is_out(gate: Gate) -> None:
    inner = Inner()
    gate.lead(ROUTES, inner.address, check)
    head = f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{gate.port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n\r\n".encode()
    with socket.create_connection(("127.0.0.1", gate.port), timeout=30) as wire:
        wire.sendall(head)
        assert wire.recv(100) == head[-20:]
        good, bad = frame(b"a good message"), frame(b"bad message")
        wire.sendall(good)
        assert wire.recv(100) == good[-20:]
        wire.sendall(frame(b"another") + bad + frame(b"after"))
        while wire.recv(100):
            pass
    assert good in inner.got and bad not in inner.got and frame(b"after", mask=b"....") not in inner.got
    assert status(request(gate, "GET /")) == 200
    inner.listener.close()


def test_a_websocket_of_another_site_is_refused(gate: Gate) -> None:
    gate.lead(ROUTES, ("127.0.0.1", 9), check)
    headers = ("Upgrade: websocket", "Connection: Upgrade", "Origin: http://evil.example")
    assert status(request(gate, "GET /", *headers)) == 403
    request(gate, "GET /", *headers[:2])  # nobody listens inside: the connection ends
    assert status(request(gate, "GET /")) == 200
