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
    RegionInfo,
    State,
    add_key,
    add_photograph,
    interpolate_looks,
    move_key,
    remove_key,
    remove_photograph,
    renumber_regions,
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
PLAIN, ONE, TWO = Look(), Look(mix=((A, 1.0),)), Look(mix=((B, 1.0),), strength=0.5)


def test_pins_replace_each_other_and_forbidden_references_add_up() -> None:
    look = Look(mix=((A, 1.0), (B, 1.0), (C, 1.0)))
    look = set_rule(set_rule(look, 1, "pin", A), 1, "pin", B)
    assert {*look.rules} == {(1, "pin", B)}
    look = set_rule(set_rule(look, 1, "forbid", A), 1, "forbid", B)
    assert {*look.rules} == {(1, "forbid", A), (1, "forbid", B)}
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


def test_fades_that_have_one_end_only_become_a_strength() -> None:
    one = replace(ONE, strength=0.8)
    assert simplified(replace(one, towards=TWO, at=0.0)) == one
    assert simplified(replace(one, towards=TWO, at=1.0)) == TWO
    assert simplified(replace(one, towards=TWO, at=0.4)).towards == TWO
    assert simplified(replace(one, towards=PLAIN, at=0.25)) == replace(one, strength=0.6000000000000001)
    assert simplified(replace(PLAIN, towards=one, at=0.5)) == replace(one, strength=0.4)


def test_a_new_photograph_is_the_style_or_joins() -> None:
    state = add_photograph(State(), A)
    assert state.look.mix == ((A, 1.0),) and state.shelf == (A,)
    assert add_photograph(state, B).look.mix == ((B, 1.0),)
    mixed = add_photograph(replace(state, drop_mode="in the mix"), B)
    assert mixed.look.mix == ((A, 1.0), (B, 1.0)) and mixed.shelf == (A, B)
    off = replace(state, look=replace(state.look, strength=0.0))
    assert add_photograph(off, B).look.strength == 1.0  # else nothing would be seen of it


@pytest.mark.parametrize("mode", ["alone", "in the mix"])
def test_the_shelf_is_bounded(mode: str) -> None:
    state = save_look(add_photograph(State(drop_mode=mode), A), "mine")  # type: ignore[arg-type]
    for number in range(10, 10 + 3 * SHELF):
        state = add_photograph(state, card(number))
        assert len(state.shelf) <= SHELF and state.look.mix[-1][0] is state.shelf[-1] and state.shelf[-1].number == number
    assert mode == "in the mix" or A in state.shelf  # the look that was kept needs it


def test_kept_looks_outlive_their_photographs() -> None:
    state = save_look(add_photograph(State(), A), "  autumn   light ")
    assert state.saved == (("autumn light", state.look),)
    assert save_look(state, "autumn light").saved == state.saved
    gone = remove_photograph(state, A)
    assert gone.shelf == () and gone.look.plain and gone.saved == state.saved and A in gone.in_use
    for k in range(63):
        state = save_look(state, f"look {k}")
    for name in ("  ", "one too many"):
        with pytest.raises(UsageError, match="keep look"):
            save_look(state, name)


@pytest.mark.parametrize("wrong", [{"map": "x"}, {"wipe": 1.5}, {"pixels": 3}, {"pixels": 5000}, {"map_opacity": -1.0}])
def test_an_impossible_state_is_refused(wrong: dict[str, object]) -> None:
    with pytest.raises((UsageError, ConfigError)):
        replace(State(), **wrong)  # type: ignore[arg-type]


def test_new_numbers_of_regions_reach_every_look() -> None:
    fading = replace(set_rule(ONE, 0, "pin", A), towards=set_rule(TWO, 1, "keep"), at=0.5)
    state = State(look=fading, picked=RegionInfo(1, 0.5, ()), saved=(("x", fading),), keys=(key(0, fading),))
    state = renumber_regions(state, [2, 0])
    wanted = replace(set_rule(ONE, 2, "pin", A), towards=set_rule(TWO, 0, "keep"), at=0.5)
    assert state.look == wanted and state.saved == (("x", wanted),) and state.keys == (key(0, wanted),)
    assert state.picked == RegionInfo(0, 0.5, ()) and state.names_regions and not State().names_regions


def key(number: int, look: Look = PLAIN) -> Key:
    return Key(CameraState((1, 0, 0, 0), (float(number), 0, 0), 1.0, 1.0), look)


def numbers(state: State) -> list[int]:
    return [round(each.camera.position[0]) for each in state.keys]


def state_of(count: int, at: int | None) -> State:
    return State(keys=tuple(key(k) for k in range(count)), selected_key=at)


def test_keys_are_added_replaced_and_removed_at_the_selected_one() -> None:
    state = add_key(add_key(add_key(State(), key(0)), key(1)), key(2))
    assert numbers(state) == [0, 1, 2] and state.selected_key == 2
    state = add_key(select_key(state, 0), key(3))
    assert numbers(state) == [0, 3, 1, 2] and state.selected_key == 1
    state = replace_key(state, key(7))
    assert numbers(state) == [0, 7, 1, 2] and state.selected_key == 1
    for left, at in (([0, 1, 2], 0), ([1, 2], 0), ([2], 0), ([], None)):
        state = remove_key(state)
        assert numbers(state) == left and state.selected_key == at
    with pytest.raises(UsageError, match="64 keys"):
        add_key(state_of(64, None), key(0))
    for edit in (remove_key, restore_key, lambda s: move_key(s, 1), lambda s: replace_key(s, key(0))):
        with pytest.raises(UsageError, match="no key is chosen"):
            edit(state_of(2, None))
    for at in (-1, 2, 99):
        with pytest.raises(UsageError, match="of 2"):
            select_key(state_of(2, None), at)


@given(st.integers(1, 6), st.data())
def test_moving_keeps_all_keys_and_follows_the_selected_one(count: int, data: st.DataObject) -> None:
    at, by = data.draw(st.integers(0, count - 1)), data.draw(st.integers(-8, 8))
    state = move_key(state_of(count, at), by)
    assert sorted(numbers(state)) == list(range(count)) and state.selected_key is not None
    assert numbers(state)[state.selected_key] == at and state.selected_key == min(count - 1, max(0, at + by))
    rest = [n for n in numbers(state) if n != at]
    assert rest == sorted(rest)


def test_looks_fade_from_key_to_key_as_in_the_film() -> None:
    keys = (key(0, ONE), key(1, TWO), key(2, TWO))
    for at, wanted in ((-1.0, ONE), (0.0, ONE), (1.0, TWO), (1.7, TWO), (2.0, TWO), (9.0, TWO)):
        assert interpolate_looks(keys, at) == wanted
    assert interpolate_looks(keys, 0.5) == replace(ONE, towards=TWO, at=0.5)
    assert interpolate_looks(keys, 0.25).at == pytest.approx(0.25**2 * 2.5)  # smoothstep
    assert interpolate_looks((key(0, ONE),), 0.0) == ONE
    between = replace(ONE, towards=TWO, at=0.3)  # a fade itself, so it holds for half of the way
    keys = (key(0, between), key(1, PLAIN))
    assert interpolate_looks(keys, 0.4) == between and interpolate_looks(keys, 0.6) == PLAIN
