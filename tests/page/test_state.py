"""The state of the viewer, and the messages that change it."""

import json
import math
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from session_helpers import camera_of, card
from tiny_world import World

from fprf.errors import ConfigError, DataError, UsageError
from fprf.page import messages
from fprf.page.drawing import cameras_of
from fprf.page.looks import Look
from fprf.page.messages import SHELF, Camera, Card, Keep, Key, Preset, Set, StartRequest, read_message
from fprf.page.state import MAX_UNDONE_PHOTOGRAPHS, History, PageKeyframe, SharedState
from fprf.plugins.stylizers.config import AdainConfig
from fprf.style.config import StyleConfig

A, B, C = (card(i) for i in range(3))
STATE = SharedState().added(A)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("strength", 1.5),
        ("bold", -1.0),
        ("clusters", 0),
        ("stylizer.temperature", 0.0),
        ("stylizer.smoothness", -1.0),
    ],
)
def test_an_impossible_look_is_refused(name: str, value: float) -> None:
    with pytest.raises(ConfigError):
        STATE.changed(Set(name=name, value=value))  # type: ignore[arg-type]


def test_sliders_and_presets_change_the_style() -> None:
    moved = STATE.changed(Set(name="stylizer.smoothness", value=3)).changed(Set(name="clusters", value=7.0))
    shown = moved.described()["look"]
    assert (shown["stylizer.smoothness"], shown["clusters"]) == (3, 7)
    whole = SharedState(look=Look(style=StyleConfig(strength=1)))  # a whole number in a field of any numbers
    assert whole.changed(Set(name="strength", value=0.4)).described()["look"]["strength"] == 0.4
    assert moved.changed(Preset(name="gentle")).described()["look"]["strength"] == 0.9


def test_a_stylizer_without_a_slider_s_field_has_no_such_slider() -> None:
    state = SharedState(look=Look(style=StyleConfig(stylizer=AdainConfig())))
    shown = state.described()["look"]
    assert "strength" in shown and "stylizer.temperature" not in shown
    with pytest.raises(
        UsageError, match=r"stylizer\.temperature: the stylizer of this scene has no such field"
    ):
        state.changed(Set(name="stylizer.temperature", value=0.5))


def test_a_new_photograph_is_the_style_or_joins() -> None:
    assert STATE.look.mix == ((A, 1.0),) and STATE.shelf == (A,)
    assert STATE.added(B).look.mix == ((B, 1.0),)
    mixed = SharedState(together=True).added(A).added(B)
    assert mixed.look.mix == ((A, 1.0), (B, 1.0)) and mixed.shelf == (A, B)
    off = STATE.changed(Set(name="strength", value=0))
    assert off.look.plain and off.added(B).look.style.strength == 1.0, "else nothing would be seen of it"
    assert mixed.changed(Card(card=1, action="alone")).look.mix == ((B, 1.0),)
    assert mixed.changed(Card(card=1, action="weight", weight=0.5)).look.mix == ((A, 1.0), (B, 0.5))


@pytest.mark.parametrize("together", [False, True])
def test_the_shelf_is_bounded(together: bool) -> None:
    state = SharedState(together=together).added(A).changed(Keep(name="mine", action="keep"))
    for number in range(10, 10 + 3 * SHELF):
        state = state.added(card(number))
        assert (
            len(state.shelf) <= SHELF
            and state.look.mix[-1][0] is state.shelf[-1]
            and state.shelf[-1].number == number
        )
    assert together or A in state.shelf, "the look that was kept needs it"


def test_kept_looks_outlive_their_photographs() -> None:
    state = STATE.changed(Keep(name="  autumn   light ", action="keep"))
    assert (
        state.kept
        == (("autumn light", state.look),)
        == state.changed(Keep(name="autumn light", action="keep")).kept
    )
    other = state.changed(Set(name="strength", value=0.3))
    with pytest.raises(UsageError, match="'autumn light' is there already"):
        other.changed(Keep(name="autumn light", action="keep"))
    replaced = other.changed(Keep(name="autumn light", action="keep", replace=True))
    assert replaced.kept == (("autumn light", other.look),)
    assert replaced.changed(Keep(name="autumn light", action="remove")).kept == ()
    gone = state.changed(Card(card=0, action="remove"))
    assert gone.shelf == () and gone.look.plain and gone.kept == state.kept and A in gone.in_use
    assert gone.changed(Keep(name="autumn light", action="restore")).look == state.look
    for k in range(63):
        state = state.changed(Keep(name=f"look {k}", action="keep"))
    for name in ("  ", "one too many", "Now"):
        with pytest.raises(UsageError, match="keep look"):
            state.changed(Keep(name=name, action="keep"))


def test_what_was_changed_is_undone_and_done_again() -> None:
    history = History()
    states = [STATE]
    messages_ = (
        Set(name="strength", value=0.5),
        Set(name="strength", value=0.4),
        Set(name="bold", value=0.1),
    )
    for message in messages_:
        history.note(states[-1].made, message.name)
        states.append(states[-1].changed(message))
    now = states[-1]
    now = now.remade(history.undo(now.made))
    assert now.look == states[2].look
    now = now.remade(history.undo(now.made))
    assert now.look == STATE.look, "a slider that is moved is one step"
    now = now.remade(history.redo(now.made))
    now = now.remade(history.redo(now.made))
    assert now == states[-1]
    for move in (history.redo, lambda made: history.undo(history.undo(history.undo(made)))):
        with pytest.raises(UsageError):
            move(now.made)


def test_a_removed_photograph_comes_back_but_not_any_number_of_them() -> None:
    history = History()
    state = STATE
    for number in range(10, 10 + 4 * SHELF):
        history.note(state.made)
        state = state.added(card(number))
    used = {*state.shelf} | history.photographs
    assert SHELF < len(used) <= SHELF + MAX_UNDONE_PHOTOGRAPHS + 1
    gone = state.shelf[-1]
    history.note(state.made)
    removed = state.removed(gone)
    assert removed.remade(history.undo(removed.made)).shelf == state.shelf


def test_what_was_kept_joins_what_has_been_made_since() -> None:
    saved = SharedState().added(A).changed(Keep(name="dusk", action="keep")).made
    joined = SharedState().joined(saved)
    assert joined.made == saved
    since = SharedState().added(B).joined(saved)
    assert since.shelf == (A, B) and since.look.mix == ((B, 1.0),) and dict(since.kept) == dict(saved.kept)


def test_keys_are_added_moved_and_removed() -> None:
    def camera(number: int) -> Camera:
        return Camera((float(number), 0, 0), ((1, 0, 0), (0, 1, 0), (0, 0, 1)), (9, 9, 8, 6), (16, 12))

    def numbers(state: SharedState) -> list[int]:
        return [round(each.camera.place[0]) for each in state.keys]

    state = STATE
    for number in range(3):
        state = state.changed(Key(action="add", camera=camera(number)))
    assert numbers(state) == [0, 1, 2] and state.keys[0] == PageKeyframe(camera(0), state.look)
    named = state.changed(Keep(name="dusk", action="keep")).changed(Set(name="strength", value=0.2))
    for shown, look in (("Now", named.look), ("dusk", state.look), ("Captured", None)):
        found = named.changed(Key(action="add", camera=camera(3), shown=shown)).keys[-1].look
        assert found == look or (look is None and found.plain), "what is shown is what is kept"
    assert numbers(state.changed(Key(action="earlier", at=2))) == [0, 2, 1]
    assert numbers(state.changed(Key(action="earlier", at=0))) == [0, 1, 2]
    assert numbers(state.changed(Key(action="remove", at=1))) == [0, 2]
    full = SharedState(keys=(PageKeyframe(camera(0), Look()),) * 64)
    wrong = [(state, Key(action=each, at=3), "of 3") for each in ("earlier", "remove")]  # type: ignore[arg-type]
    wrong += [(state, Key(action="add"), "camera"), (full, Key(action="add", camera=camera(1)), "64 keys")]
    for before, message, told in wrong:
        with pytest.raises(UsageError, match=told):
            before.changed(message)


CAMERA = {
    "place": [0, 1, 2.5],
    "axes": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "lens": [300, 300, 160, 120],
    "size": [320, 240],
}
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
    {"type": "film", "seconds": 2, "side": 1920, "fps": 60},
    {"type": "undo", "again": True},
]


def test_what_the_page_sends_passes() -> None:
    kinds = {type(read_message(json.dumps(message))).__name__ for message in MESSAGES}
    assert kinds == {
        "ViewRequest",
        "Set",
        "Preset",
        "Card",
        "Pick",
        "Region",
        "Map",
        "Keep",
        "Key",
        "Film",
        "Undo",
    }


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
TEXTS = [
    "",
    "x",
    "[]",
    "{}",
    "null",
    "3",
    '{"type": 3}',
    "[" * 100_000,
    '{"type": "set"}',
    "\ud800",
    b"\xff\xfe",
    b"{}",
]


def test_anything_else_does_not() -> None:
    base = {message["type"]: message for message in MESSAGES}
    for kind, change in WRONG:
        with pytest.raises(DataError, match="message"):
            read_message(json.dumps({**base[kind], **change}))
    for text in TEXTS:
        with pytest.raises(DataError, match="message"):
            read_message(text)


def test_requests_of_the_start_page_are_messages_too() -> None:
    assert read_message('{"type": "open", "path": "yard", "minutes": 10}', StartRequest) == messages.Open(
        "yard", 10
    )
    for text in (
        '{"type": "open"}',
        '{"type": "open", "path": "yard", "minutes": "2"}',
        '{"type": "view"}',
        *TEXTS,
    ):
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
