"""Access to the viewer: addresses, names, tokens, and a middleware that refuses others.

By default this machine alone may connect; from elsewhere a token is needed. A page of another site that is
open in the same browser can send requests here, so Host must name this machine (DNS rebinding) and Origin
must be our own page.
"""

import asyncio
import contextlib
import hmac
import ipaddress
import secrets
import socket
from collections.abc import Mapping
from dataclasses import dataclass
from urllib.parse import urlsplit

import numpy as np
from starlette.requests import HTTPConnection, cookie_parser
from starlette.responses import PlainTextResponse, RedirectResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from ..errors import UsageError
from ..io.images import Picture

_MIN_TOKEN_CHARACTERS = 16
"""Characters of a token that a user chooses, at least; by eye."""
MAX_WAIT_SECONDS = 15.0
"""Time for a request's head, for each further piece of a body, and for each piece of a response to be
accepted; by eye.
"""
_MAX_QUERY_FIELDS = 16
"""Fields of an address; the page sends four."""
_SENT_BYTES = 1 << 16
"""Bytes of a piece of a response, which has to be accepted in time."""
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
        """Return why a request is refused, or None. Header names are lower case; `given` is a token in the
        address.
        """
        # A name that leads here by somebody else's DNS is not one of this machine (rebinding).
        name = headers.get("host", "")
        try:
            host = urlsplit(f"//{name}").hostname or ""
        except ValueError:
            host = ""
        if not name or (is_loopback(self.host) and not is_loopback(host)):
            return f"this viewer does not go by the name {name!r}; open it by the address that it printed"
        # Browsers say whose page asks; programs that are no browser say nothing, and have the token alone to
        # pass.
        origin = headers.get("origin")
        if origin is not None and origin not in (f"http://{name}", f"https://{name}"):
            return "another site may not talk to this viewer"
        if self.token is None:
            return None
        kept = cookie_parser(headers.get("cookie", "")).get(cookie_name(name))
        # Compared in constant time: how long it takes tells nothing of how much is right.
        shown = given or kept or headers.get("authorization", "").removeprefix("Bearer ")
        if hmac.compare_digest(shown.encode(), self.token.encode()):
            return None
        return "a token is needed; open the whole address that `fprf view` printed"


def cookie_name(host: str) -> str:
    """Name of the token's cookie under a Host header: with its port, since browsers send cookies to all ports
    of a host.
    """
    port = host.rpartition(":")[2]
    return f"fprf-token-{port if port.isdecimal() else 80}"


def make_access(host: str, token: str | None) -> Access:
    """Make a token where other machines can connect and none is given. Raises UsageError for one that is
    easily guessed.
    """
    if token is not None and (
        len(token) < _MIN_TOKEN_CHARACTERS or not token.isascii() or not token.isprintable() or " " in token
    ):
        raise UsageError(
            f"--token: at least {_MIN_TOKEN_CHARACTERS} plain characters without spaces; leave it out and one is made"
        )
    if token is None and not is_loopback(host):
        token = secrets.token_urlsafe(24)
    return Access(host, token)


def network_address(host: str) -> str:
    """The address by which other machines reach this one, where it listens on all of its own (`host`); without
    a network that of this machine alone. Nothing is sent to find it.
    """
    family = socket.AF_INET
    elsewhere = "192.0.2.1"  # for documentation (RFC 5737)
    here = "127.0.0.1"
    if ":" in host:
        family = socket.AF_INET6
        elsewhere = "2001:db8::1"
        here = "::1"
    with socket.socket(family, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((elsewhere, 9))
            return str(probe.getsockname()[0])
        except OSError:
            return here


def qr_code(text: str) -> Picture:
    """A text as a QR code with its quiet border, a pixel a module."""
    import cv2

    modules = np.asarray(cv2.QRCodeEncoder.create().encode(text), np.uint8)
    return np.repeat(np.pad(modules, 1, constant_values=255)[..., None], 3, 2)


def is_loopback(host: str) -> bool:
    """True for a name or address of this machine alone."""
    if host.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


class _GoneError(Exception):
    """The client has gone or is too slow; no OSError, which is a fault of this machine that the client is
    told.
    """


class Guard:
    """Middleware that answers nobody who may not ask, adds headers, and drops clients that do not read."""

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self._app = app
        self._access = access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Check a request or a WebSocket's handshake, and pass it on."""
        connection = HTTPConnection(scope)
        given = connection.query_params.get("token")
        refused = None
        if any(len(connection.headers.getlist(name)) > 1 for name in ("host", "origin")):
            refused = (400, "the header host or origin comes twice")
        elif len(connection.query_params.multi_items()) > _MAX_QUERY_FIELDS:
            refused = (400, "the address has too many fields")
        elif (refusal := self._access.refusal(connection.headers, given)) is not None:
            refused = (403, refusal)

        async def patient(message: Message) -> None:
            if message["type"].endswith("response.start"):
                added = []
                for name, value in _HEADERS.items():
                    added.append((name.encode(), value.encode()))
                kept = []
                for row in message["headers"]:
                    if row[0].decode().lower() not in _HEADERS:
                        kept.append(row)
                message = {**message, "headers": [*kept, *added]}
            # A body goes in pieces, each of which the client must take in time.
            body = message.get("body", b"")
            start = 0
            try:
                while len(body) - start > _SENT_BYTES:
                    piece = {
                        "type": message["type"],
                        "body": body[start : start + _SENT_BYTES],
                        "more_body": True,
                    }
                    await asyncio.wait_for(send(piece), MAX_WAIT_SECONDS)
                    start += _SENT_BYTES
                await asyncio.wait_for(
                    send({**message, "body": body[start:]} if start else message), MAX_WAIT_SECONDS
                )
            except OSError as error:
                raise _GoneError from error

        with contextlib.suppress(_GoneError):
            if refused is not None:
                await PlainTextResponse(f"{refused[1]}\n", refused[0])(scope, receive, patient)
            elif given is not None and scope["type"] == "http" and scope["method"] == "GET":
                # Out of the address bar and its history. Lax: a link on another site opens the page too; what
                # changes anything has an Origin, which is checked.
                response = RedirectResponse(scope["path"], 303)
                name = cookie_name(connection.headers.get("host", ""))
                response.headers["set-cookie"] = f"{name}={given}; Path=/; HttpOnly; SameSite=Lax"
                await response(scope, receive, patient)
            else:
                await self._app(scope, receive, patient)
