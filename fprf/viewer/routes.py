"""HTTP requests and responses of the pages: what a handler is given, reads out of it, and answers."""

import json
from collections.abc import Awaitable, Callable, Mapping
from importlib.resources import files
from typing import Any, NamedTuple

from ..errors import UsageError

_MAX_JSON = 4096
"""Bytes of a request that is JSON."""


class Request(NamedTuple):
    """An HTTP request."""

    method: str
    path: str
    query: Mapping[str, str]
    headers: Mapping[str, str]
    body: bytes = b""


class Response(NamedTuple):
    """An HTTP response."""

    status: int
    content_type: str
    body: bytes
    headers: Mapping[str, str] = {}


Handler = Callable[[Request], Awaitable[Response]]
Routes = Mapping[tuple[str, str], Handler]
"""Handlers by method and path."""


def asset(name: str) -> Handler:
    """The handler of a .html, .css or .js file of this package."""
    content_type = f"text/{name.rpartition('.')[2].replace('js', 'javascript')}; charset=utf-8"

    async def respond(request: Request) -> Response:
        return Response(200, content_type, (files(__package__) / name).read_bytes())

    return respond


def text_response(status: int, text: str) -> Response:
    """A line of plain text."""
    return Response(status, "text/plain; charset=utf-8", f"{text}\n".encode())


def json_response(value: object) -> Response:
    """A value as JSON."""
    return Response(200, "application/json", json.dumps(value).encode())


def json_body(request: Request) -> dict[str, Any]:
    """The object that a request holds. Raises UsageError where it holds none."""
    if len(request.body) > _MAX_JSON:
        raise UsageError("request: too long")
    try:
        asked = json.loads(request.body)
    except (ValueError, RecursionError):
        raise UsageError("request: not JSON") from None
    if not isinstance(asked, dict):
        raise UsageError("request: not an object")
    return asked


def integer(asked: Mapping[str, Any], name: str, least: int = 0) -> int:
    """A whole number of at most 12 characters in a query or an object. Raises UsageError for anything else."""
    text = str(asked.get(name))
    if not (text.removeprefix("-").isdigit() and text.isascii() and len(text) <= 12 and int(text) >= least):
        raise UsageError(f"{name}: {text[:20]!r} is no number from {least}")
    return int(text)


def number(asked: Mapping[str, Any], name: str, least: float, most: float) -> float:
    """A number in an object. Raises UsageError for anything else, or one out of its range."""
    value = asked.get(name)
    if isinstance(value, bool) or not isinstance(value, int | float) or not least <= value <= most:
        raise UsageError(f"{name}: must be a number from {least:g} to {most:g}")
    return float(value)
