"""Who may talk to the viewer. By default this machine alone; from elsewhere, who knows the token.

A page of another site, open in the same browser, can send requests to this machine: so the Host that a browser names must be
this machine (against names that are made to point here), and the Origin that it names must be our own page.
"""

import hmac
import ipaddress
import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from urllib.parse import urlsplit

from ..errors import UsageError

__all__ = ["COOKIE", "Access", "make_access"]

COOKIE = "fprf-token"
_SHORTEST = 16
"""Characters of a token that somebody chooses."""


@dataclass(frozen=True)
class Access:
    """What a request must show."""

    host: str
    """Address that is listened on."""
    token: str | None
    """None = none is needed."""

    def refusal(self, headers: Mapping[str, str], given: str | None = None) -> str | None:
        """Why a request is refused, or None. Header names are lower case; `given` is a token in the address."""
        name = headers.get("host", "")
        if not name or (is_loopback(self.host) and not is_loopback(_name(name))):
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
    """Access by a host's address: from elsewhere than this machine a token is needed, and made where none is given.

    Raises UsageError for a token that is easily guessed.
    """
    if token is not None and (len(token) < _SHORTEST or not token.isascii() or not token.isprintable() or " " in token):
        raise UsageError(f"--token: at least {_SHORTEST} plain characters without spaces; leave it out and one is made")
    if token is None and not is_loopback(host):
        token = secrets.token_urlsafe(24)
    return Access(host, token)


def is_loopback(host: str) -> bool:
    """Whether a name or address means this machine alone."""
    if host.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def _name(host: str) -> str:
    """The name in a Host header, without its port; empty for nonsense."""
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
