from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from fprf.errors import ConfigError, UsageError
from fprf.style.dictionary import Reference
from fprf.viewer.cameras import CameraState
from fprf.viewer.state import (
    SHELF,
    Key,
    Look,
    Photograph,
    State,
    add_key,
    add_photograph,
    interpolate_looks,
    move_key,
    remove_key,
    remove_photograph,
    replace_key,
    restore_key,
    save_look,
    select_key,
    set_rule,
    simplified,
    style_config,
)


def card(number: int) -> Photograph:
    empty = Reference(f"{number}", torch.zeros(0, 2), torch.zeros(0, 2))
    return Photograph(number, f"{number}.png", Path(f"/tmp/{number}.png"), np.zeros((1, 1, 3), np.uint8), empty)


A, B, C = (card(i) for i in range(3))


def test_wishes_replace_each_other_but_bans_add_up() -> None:
    look = Look(mix=((A, 1.0), (B, 1.0), (C, 1.0)))
    look = set_rule(set_rule(look, 1, "pin", A), 1, "pin", B)
    assert [(o.action, o.photograph) for o in look.rules] == [("pin", B)]
    look = set_rule(set_rule(look, 1, "forbid", A), 1, "forbid", B)
    assert {(o.action, o.photograph) for o in look.rules} == {("forbid", A), ("forbid", B)}
    assert set_rule(look, 1, "forbid", C).rules == frozenset()  # nothing would be left to take
    assert set_rule(look, 1, None).rules == frozenset()


def test_a_look_in_the_terms_of_a_style() -> None:
    look = Look(mix=((A, 1.0), (B, 0.5)), strength=0.7, temperature=0.2, clusters=4, blend=0.1, luminance=0.3)
    look = set_rule(set_rule(set_rule(look, 2, "pin", B), 0, "forbid", A), 5, "keep")
    style = style_config(look)
    assert style.references == (A.path, B.path) and style.weights == (1.0, 0.5)
    assert (style.strength, style.clusters, style.blend, style.luminance) == (0.7, 4, 0.1, 0.3)
    assert style.pin == ("2=1",) and style.forbid == ("0=0",) and style.keep == ("5",)
    assert getattr(style.stylizer, "temperature") == 0.2  # noqa: B009  the slot's own config has it


def test_fades_that_have_one_end_only_settle() -> None:
    a, b, plain = Look(mix=((A, 1.0),), strength=0.8), Look(mix=((B, 1.0),)), Look()
    assert simplified(replace(a, towards=b, at=0.0)) == a
    assert simplified(replace(a, towards=b, at=1.0)) == b
    assert simplified(replace(a, towards=b, at=0.4)).towards == b
    assert simplified(replace(a, towards=plain, at=0.25)) == replace(a, strength=0.6000000000000001)
    assert simplified(replace(plain, towards=a, at=0.5)) == replace(a, strength=0.4)


def test_a_dropped_photograph_is_the_style_or_joins() -> None:
    state = add_photograph(State(), A)
    assert state.look.mix == ((A, 1.0),) and state.shelf == (A,)
    assert add_photograph(state, B).look.mix == ((B, 1.0),)
    mixed = add_photograph(replace(state, drop_mode="in the mix"), B)
    assert mixed.look.mix == ((A, 1.0), (B, 1.0)) and mixed.shelf == (A, B)
    off = replace(state, look=replace(state.look, strength=0.0))
    assert add_photograph(off, B).look.strength == 1.0  # else nothing would be seen of it


def test_the_shelf_is_bounded_and_what_is_needed_stays() -> None:
    state = add_photograph(State(), A)
    state = save_look(state, "mine")
    for number in range(10, 10 + 3 * SHELF):
        state = add_photograph(state, card(number))
        assert len(state.shelf) <= SHELF
    assert A in state.shelf  # the look that was kept needs it
    assert state.look.mix[0][0] is state.shelf[-1]


def test_removing_and_keeping() -> None:
    state = save_look(add_photograph(State(), A), "  autumn   light ")
    assert state.saved == (("autumn light", state.look),)
    assert save_look(state, "autumn light").saved == state.saved
    gone = remove_photograph(state, A)
    assert gone.shelf == () and gone.look.plain and gone.saved == state.saved and A in gone.in_use
    with pytest.raises(UsageError, match="name"):
        save_look(state, "  ")


@pytest.mark.parametrize("wrong", [{"map": "x"}, {"wipe": 1.5}, {"pixels": 3}, {"pixels": 5000}, {"map_opacity": -1.0}])
def test_a_state_that_cannot_be_is_refused(wrong: dict[str, object]) -> None:
    with pytest.raises((UsageError, ConfigError)):
        replace(State(), **wrong)  # type: ignore[arg-type]


PLAIN, ONE, TWO = Look(), Look(mix=((A, 1.0),)), Look(mix=((B, 1.0),), strength=0.5)


def key(number: int, look: Look = PLAIN) -> Key:
    return Key(CameraState((1, 0, 0, 0), (float(number), 0, 0), 1.0, 1.0), look)


def numbers(state: State) -> list[int]:
    return [round(each.camera.position[0]) for each in state.keys]


def state_of(count: int, at: int | None) -> State:
    return State(keys=tuple(key(k) for k in range(count)), selected_key=at)


def test_a_key_comes_behind_the_chosen_one_and_is_chosen() -> None:
    state = add_key(add_key(add_key(State(), key(0)), key(1)), key(2))
    assert numbers(state) == [0, 1, 2] and state.selected_key == 2
    state = add_key(select_key(state, 0), key(3))
    assert numbers(state) == [0, 3, 1, 2] and state.selected_key == 1
    with pytest.raises(UsageError, match="64 keys"):
        add_key(state_of(64, None), key(0))


def test_the_chosen_key_is_replaced_and_removed() -> None:
    state = replace_key(state_of(3, 1), key(7))
    assert numbers(state) == [0, 7, 2] and state.selected_key == 1
    state = remove_key(state)
    assert numbers(state) == [0, 2] and state.selected_key == 0
    state = remove_key(remove_key(state))
    assert state.keys == () and state.selected_key is None


@pytest.mark.parametrize("edit", [remove_key, restore_key, lambda s: move_key(s, 1), lambda s: replace_key(s, key(0))])
def test_without_a_chosen_key_there_is_nothing_to_edit(edit: object) -> None:
    with pytest.raises(UsageError, match="no key is chosen"):
        edit(state_of(2, None))  # type: ignore[operator]


@pytest.mark.parametrize("at", [-1, 2, 99])
def test_keys_that_are_none_cannot_be_chosen(at: int) -> None:
    with pytest.raises(UsageError, match="of 2"):
        select_key(state_of(2, None), at)


@given(st.integers(1, 6), st.data())
def test_shifting_keeps_all_keys_and_follows_the_chosen_one(count: int, data: st.DataObject) -> None:
    at, by = data.draw(st.integers(0, count - 1)), data.draw(st.integers(-8, 8))
    state = move_key(state_of(count, at), by)
    assert sorted(numbers(state)) == list(range(count)) and state.selected_key is not None
    assert numbers(state)[state.selected_key] == at and state.selected_key == min(count - 1, max(0, at + by))
    rest = [n for n in numbers(state) if n != at]
    assert rest == sorted(rest)


def test_looks_fade_from_key_to_key_as_in_the_film() -> None:
    keys = (key(0, ONE), key(1, TWO), key(2, TWO))
    assert interpolate_looks(keys, 0.0) == ONE and interpolate_looks(keys, 1.0) == TWO and interpolate_looks(keys, 1.7) == TWO
    assert interpolate_looks(keys, 2.0) == TWO and interpolate_looks(keys, -1.0) == ONE and interpolate_looks(keys, 9.0) == TWO
    half, quarter = interpolate_looks(keys, 0.5), interpolate_looks(keys, 0.25)
    assert half == replace(ONE, towards=TWO, at=0.5)
    assert quarter.at == pytest.approx(0.25**2 * 2.5)  # smoothstep
    assert interpolate_looks((key(0, ONE),), 0.0) == ONE


def test_a_shelf_full_of_photographs_in_use_still_takes_one() -> None:
    state = State(drop_mode="in the mix")
    for number in range(SHELF + 5):
        state = add_photograph(state, card(number))
    assert len(state.shelf) == SHELF and state.shelf[-1].number == SHELF + 4


def test_looks_that_are_fades_themselves_hold_for_half_the_way() -> None:
    between = replace(ONE, towards=TWO, at=0.3)
    keys = (key(0, between), key(1, PLAIN))
    assert interpolate_looks(keys, 0.4) == between and interpolate_looks(keys, 0.6) == PLAIN
