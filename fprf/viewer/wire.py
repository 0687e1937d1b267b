"""What a browser sends over a WebSocket, message by message, before anything else reads it (RFC 6455, client to server).

Bytes go in as they arrive; whole messages come out, each with the very bytes that carried it, to be passed on or not.
"""

from collections.abc import Iterator
from typing import NamedTuple

from ..errors import DataError

__all__ = ["LIMIT", "Inbox", "Message"]

LIMIT = 1 << 20
"""Bytes of a message; the page sends a few hundred."""
_CONTINUE, _TEXT, _BINARY = 0, 1, 2


class Message(NamedTuple):
    """One message, or one control frame."""

    raw: bytes
    """As it came."""
    payload: bytes | None
    """What it says; None for control frames (close, ping, pong)."""


class Inbox:
    """Puts messages together. `feed` raises DataError for what is no such stream, or too much of it."""

    def __init__(self, limit: int = LIMIT) -> None:
        self._limit = limit
        self._bytes = bytearray()
        self._raw, self._payload = bytearray(), bytearray()
        self._inside = False

    def feed(self, data: bytes) -> Iterator[Message]:
        """The messages that are whole now."""
        self._bytes += data
        while (frame := self._frame()) is not None:
            start, end, first = frame
            raw, kind, last = bytes(self._bytes[:end]), first & 0x0F, bool(first & 0x80)
            payload = _unmasked(raw[start - 4 : start], raw[start:])
            del self._bytes[:end]
            if kind >= 8:
                yield Message(raw, None)
                continue
            if (kind == _CONTINUE) != self._inside or kind not in (_CONTINUE, _TEXT, _BINARY):
                raise DataError("WebSocket: frames out of order")
            self._raw += raw
            self._payload += payload
            if len(self._payload) > self._limit or len(self._raw) > 2 * self._limit:
                raise DataError(f"WebSocket: a message of more than {self._limit} bytes")
            self._inside = not last
            if last:
                yield Message(bytes(self._raw), bytes(self._payload))
                self._raw.clear()
                self._payload.clear()

    def _frame(self) -> tuple[int, int, int] | None:
        """Where the payload of the first frame begins and ends, and its first byte; None until it is all there."""
        have = self._bytes
        if len(have) < 2:
            return None
        if have[0] & 0x70:
            raise DataError("WebSocket: an extension that was not agreed on")
        if not have[1] & 0x80:
            raise DataError("WebSocket: a frame without a mask")
        size, start = have[1] & 0x7F, 2
        if have[0] & 0x08 and (size > 125 or not have[0] & 0x80):
            raise DataError("WebSocket: a control frame that is too long or in parts")
        if size >= 126:
            count = 2 if size == 126 else 8
            if len(have) < 2 + count:
                return None
            size, start = int.from_bytes(have[2 : 2 + count], "big"), 2 + count
        if size > self._limit:
            raise DataError(f"WebSocket: a message of more than {self._limit} bytes")
        end = start + 4 + size
        return (start + 4, end, have[0]) if len(have) >= end else None


def _unmasked(mask: bytes, data: bytes) -> bytes:
    keys = (mask * (len(data) // 4 + 1))[: len(data)]
    return (int.from_bytes(data) ^ int.from_bytes(keys)).to_bytes(len(data))
