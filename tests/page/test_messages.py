import json
import math
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from session_helpers import camera_of
from tiny_world import World

from fprf.errors import DataError, UsageError
from fprf.page import messages
from fprf.page.drawing import cameras_of
from fprf.page.messages import StartRequest, read_message

CAMERA = {"place": [0, 1, 2.5], "axes": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "lens": [300, 300, 160, 120], "size": [320, 240]}
MESSAGES: list[dict[str, Any]] = [
    {"type": "view", "camera": CAMERA, "captured": True},
    {"type": "set", "name": "strength", "value": 0.5},
    {"type": "preset", "name": "gentle"},
    {"type": "card", "card": 3, "action": "weight", "weight": 0.5},
    {"type": "pick", "camera": CAMERA, "x": 0.5, "y": 1},
    {"type": "region", "action": "pin", "card": 1},
    {"type": "region", "action": "close"},
    {"type": "map", "map": "regions"},
    {"type": "keep", "name": "dusk", "action": "keep"},
    {"type": "key", "action": "add", "camera": CAMERA},
    {"type": "film", "seconds": 2},
]


def test_what_the_page_sends_passes() -> None:
    kinds = {type(read_message(json.dumps(message))).__name__ for message in MESSAGES}
    assert kinds == {"View", "Set", "Preset", "Card", "Pick", "Region", "Map", "Keep", "Key", "Film"}


WRONG: list[tuple[str, dict[str, Any]]] = [
    ("set", {"name": "mix"}), ("set", {"value": "1"}), ("set", {"value": True}), ("set", {"value": 1e40}), ("set", {"more": 1}),
    ("view", {"camera": {**CAMERA, "place": [0, 1]}}), ("view", {"camera": {**CAMERA, "place": [0, 1, 1e30]}}),
    ("view", {"camera": {**CAMERA, "size": [0, 10]}}), ("view", {"camera": {**CAMERA, "size": [1e6, 10]}}),
    ("view", {"camera": {**CAMERA, "lens": [0, 1, 1, 1]}}), ("view", {"camera": {**CAMERA, "more": 1}}),
    ("view", {"camera": None}),
    ("pick", {"x": 1.5}), ("pick", {"y": -0.1}), ("pick", {"x": math.nan}), ("card", {"card": -1}), ("card", {"card": 1.5}),
    ("card", {"weight": 5}), ("card", {"action": "eat"}), ("region", {"action": "x"}), ("map", {"map": "x"}),
    ("keep", {"name": "x" * 81}), ("keep", {"name": 3}), ("film", {"seconds": 1e9}),
    ("key", {"at": -1}), ("set", {"type": "shutdown"}), ("set", {"type": None}), ("set", {"type": ["set"]}),
]  # fmt: skip
TEXTS = ["", "x", "[]", "{}", "null", "3", '{"type": 3}', "[" * 100_000, '{"type": "set"}', "\ud800", b"\xff\xfe", b"{}"]


def test_anything_else_does_not() -> None:
    base = {message["type"]: message for message in MESSAGES}
    for kind, change in WRONG:
        with pytest.raises(DataError, match="message"):
            read_message(json.dumps({**base[kind], **change}))
    for text in TEXTS:
        with pytest.raises(DataError, match="message"):
            read_message(text)


def test_requests_of_the_start_page_are_messages_too() -> None:
    assert read_message('{"type": "open", "path": "yard", "minutes": 10}', StartRequest) == messages.Open("yard", 10)
    for text in ('{"type": "open"}', '{"type": "open", "path": "yard", "minutes": "2"}', '{"type": "view"}', *TEXTS):
        with pytest.raises(DataError, match="message"):
            read_message(text, StartRequest)
    for minutes in ("0", "1e9", "true", "NaN"):
        with pytest.raises(DataError, match="message"):
            read_message(f'{{"type": "make", "scene": "yard", "minutes": {minutes}}}', StartRequest)


values = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=6), inner, max_size=4),
    max_leaves=20,
)
names = sorted({name for message in MESSAGES for name in message} | {"else"})


@given(st.dictionaries(st.sampled_from(names), values), st.sampled_from(MESSAGES))
def test_it_refuses_or_passes_but_never_breaks(changes: dict[str, Any], base: dict[str, Any]) -> None:
    for message in ({**base, **changes}, {**base, **changes, "type": base["type"]}):
        try:
            found = read_message(json.dumps(message))
        except DataError:
            continue
        assert isinstance(found, messages.Message)


def test_cameras_of_clients_are_those_that_they_see_with(world: World) -> None:
    scene = world.load()
    made = cameras_of([camera_of(scene, view) for view in (2, 3)], longest=64)
    assert made.size.tolist() == [[64, 48], [64, 48]]
    assert torch.allclose(made.pose, scene.cameras.pose[2:4], atol=1e-9)
    assert torch.allclose(made.focal, 2 * scene.cameras.focal[2:4])
    assert torch.allclose(made.centre, 2 * scene.cameras.centre[2:4])
    with pytest.raises(UsageError, match="no rotation"):
        cameras_of([messages.Camera((0, 0, 0), ((1, 0, 0), (0, 1, 0), (0, 0, -1)), (1, 1, 0, 0), (2, 2))])
