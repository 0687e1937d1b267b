import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fprf.errors import DataError

msgspec = pytest.importorskip("msgspec", reason="the extra `viewer` is not installed")
check_message = pytest.importorskip("fprf.viewer.message_validation").check_message

CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": [1.0, 0, 0, 0], "position": [0, 0.5, 1], "look_at": [0, 0, 0],
    "up_direction": [0, 0, 1], "fov": 1.2, "near": 0.01, "far": 1000.0, "image_height": 720, "image_width": 1280,
}  # fmt: skip
CONTROL = {"type": "GuiUpdateMessage", "uuid": "a-b-c", "updates": {"value": 0.5}}
CLICK = {
    "type": "ScenePointerMessage", "event_type": "click", "ray_origin": [0, 0, 0], "ray_direction": [0, 0, 1],
    "screen_pos": [[0.5, 0.5]], "modifier": None,
}  # fmt: skip


def test_what_the_page_sends_passes() -> None:
    for message in (CAMERA, CONTROL, CLICK, *({**CONTROL, "updates": {"value": v}} for v in ("a", True, 3, None))):
        check_message(msgspec.msgpack.encode(message))


WRONG: dict[str, list[dict[str, Any]]] = {
    "camera": [
        {"fov": math.nan}, {"position": [math.inf, 0, 0]}, {"position": [0, 0]}, {"position": "abc"}, {"image_width": True},
        {"image_width": 1e40}, {"wxyz": None},
    ],
    "control": [
        {"updates": {"update_cb": []}}, {"updates": {"value": 1, "removed": True}}, {"updates": {"value": math.nan}},
        {"updates": [1]}, {"uuid": 3}, {"updates": {"value": "x" * 5000}}, {"updates": {"value": [0.0] * 65}},
        {"updates": {"value": b"bytes"}},
    ],
    "click": [{"event_type": "rect-select"}, {"ray_origin": [0, 0]}, {"screen_pos": [[0.0, 0.0]] * 65}],
}  # fmt: skip
KINDS = ["ShareUrlRequest", "FileTransferStartUpload", "RunJavascriptMessage", ["GuiUpdateMessage"]]
BYTES = [b"", b"\xff", b"x" * 100, b"\x81", b"\x93\x01\x02\x03", b"\x91" * 100_000, b"\x81\xa1\xff\x00"]


def test_anything_else_does_not() -> None:
    others: list[object] = [None, [], "text", {}, {1: 2}, *({"type": kind, "size_bytes": 10**12} for kind in KINDS)]
    for base, changes in zip((CAMERA, CONTROL, CLICK), WRONG.values(), strict=True):
        others += [{**base, **change} for change in changes]
    for payload in (*BYTES, *map(msgspec.msgpack.encode, others)):
        with pytest.raises(DataError):
            check_message(payload)


values = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text(max_size=8) | st.binary(max_size=4),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=6), inner, max_size=4),
    max_leaves=20,
)


@given(st.dictionaries(st.sampled_from([*CAMERA, *CONTROL, *CLICK, "else"]), values), st.sampled_from([CAMERA, CONTROL, CLICK]))
def test_it_refuses_or_passes_but_never_breaks(changes: dict[str, Any], base: dict[str, Any]) -> None:
    for message in ({**base, **changes}, {**base, **changes, "type": base["type"]}):
        try:
            check_message(msgspec.msgpack.encode(message))
        except DataError:
            continue
        assert message["type"] in ("ViewerCameraMessage", "GuiUpdateMessage", "ScenePointerMessage")
