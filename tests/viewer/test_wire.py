import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fprf.errors import DataError
from fprf.viewer.wire import Inbox, Message


def frame(payload: bytes, *, kind: int = 2, last: bool = True, mask: bytes | None = None) -> bytes:
    mask = b"\x37\xfa\x21\x3d" if mask is None else mask
    head = bytes([(0x80 if last else 0) | kind])
    size = len(payload)
    if size < 126:
        head += bytes([0x80 | size])
    elif size < 1 << 16:
        head += bytes([0x80 | 126]) + size.to_bytes(2)
    else:
        head += bytes([0x80 | 127]) + size.to_bytes(8)
    return head + mask + bytes(b ^ mask[i % 4] for i, b in enumerate(payload))


def fed(inbox: Inbox, data: bytes, piece: int) -> list[Message]:
    return [m for at in range(0, len(data), piece) for m in inbox.feed(data[at : at + piece])]


@settings(deadline=None, suppress_health_check=[HealthCheck.too_slow], max_examples=60)
@given(st.lists(st.binary(max_size=400), max_size=6), st.integers(1, 997), st.binary(min_size=4, max_size=4))
def test_messages_come_out_whole_with_the_bytes_that_carried_them(payloads: list[bytes], piece: int, mask: bytes) -> None:
    data = b"".join(frame(p, mask=mask) for p in payloads)
    found = fed(Inbox(), data, piece)
    assert [m.payload for m in found] == payloads
    assert b"".join(m.raw for m in found) == data


@settings(deadline=None, suppress_health_check=[HealthCheck.too_slow], max_examples=60)
@given(st.binary(min_size=1, max_size=300), st.integers(1, 7), st.integers(1, 50))
def test_parts_are_joined_and_control_frames_pass_between_them(payload: bytes, parts: int, piece: int) -> None:
    size = -(-len(payload) // parts)
    cut = [payload[i : i + size] for i in range(0, len(payload), size)]
    data, ping = b"", frame(b"hello", kind=9)
    for i, part in enumerate(cut):
        data += frame(part, kind=2 if i == 0 else 0, last=i == len(cut) - 1) + (ping if i < len(cut) - 1 else b"")
    found = fed(Inbox(), data, piece)
    assert [m.payload for m in found if m.payload is not None] == [payload]
    assert sum(m.payload is None for m in found) == len(cut) - 1


def test_large_messages_up_to_the_limit() -> None:
    inbox = Inbox(limit=100_000)
    assert [m.payload for m in inbox.feed(frame(b"x" * 100_000))] == [b"x" * 100_000]
    with pytest.raises(DataError, match="more than 100000 bytes"):
        list(inbox.feed(frame(b"x" * 100_001)[:20]))  # refused by its head, before it is there


def test_a_message_in_parts_is_bounded_as_a_whole() -> None:
    inbox = Inbox(limit=100)
    list(inbox.feed(frame(b"x" * 60, last=False)))
    with pytest.raises(DataError, match="more than 100"):
        list(inbox.feed(frame(b"x" * 60, kind=0)))


def test_empty_parts_without_end_are_bounded_too() -> None:
    inbox = Inbox(limit=100)
    list(inbox.feed(frame(b"", last=False)))
    with pytest.raises(DataError, match="more than"):
        for _ in range(100):
            list(inbox.feed(frame(b"", kind=0, last=False)))


@pytest.mark.parametrize(
    "data",
    [
        b"\x82\x05hello",  # no mask
        b"\xc2\x80....",  # an extension
        frame(b"x", kind=0),  # a part of nothing
        frame(b"x", kind=3),  # a kind that is none
        b"\x89\xfe\x00\x80....",  # a long ping
        b"\x09\x80....",  # a ping in parts
        frame(b"a", last=False) + frame(b"b"),  # a new message inside of another
    ],
)
def test_what_is_no_such_stream_is_refused(data: bytes) -> None:
    with pytest.raises(DataError, match="WebSocket"):
        list(Inbox().feed(data))
