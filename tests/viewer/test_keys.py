from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_state import A, B

from fprf.errors import UsageError
from fprf.viewer.cameras import Eye
from fprf.viewer.film import Key
from fprf.viewer.keys import added, at_key, between_keys, chosen, replaced, shifted, without
from fprf.viewer.looks import Look
from fprf.viewer.state import State

PLAIN, ONE, TWO = Look(), Look(mix=((A, 1.0),)), Look(mix=((B, 1.0),), strength=0.5)


def key(number: int, look: Look = PLAIN) -> Key:
    return Key(Eye((1, 0, 0, 0), (float(number), 0, 0), 1.0, 1.0), look)


def numbers(state: State) -> list[int]:
    return [round(each.eye.position[0]) for each in state.keys]


def state_of(count: int, at: int | None) -> State:
    return State(keys=tuple(key(k) for k in range(count)), chosen=at)


def test_a_key_comes_behind_the_chosen_one_and_is_chosen() -> None:
    state = added(added(added(State(), key(0)), key(1)), key(2))
    assert numbers(state) == [0, 1, 2] and state.chosen == 2
    state = added(chosen(state, 0), key(3))
    assert numbers(state) == [0, 3, 1, 2] and state.chosen == 1
    with pytest.raises(UsageError, match="64 keys"):
        added(state_of(64, None), key(0))


def test_the_chosen_key_is_replaced_and_removed() -> None:
    state = replaced(state_of(3, 1), key(7))
    assert numbers(state) == [0, 7, 2] and state.chosen == 1
    state = without(state)
    assert numbers(state) == [0, 2] and state.chosen == 0
    state = without(without(state))
    assert state.keys == () and state.chosen is None


@pytest.mark.parametrize("edit", [without, at_key, lambda s: shifted(s, 1), lambda s: replaced(s, key(0))])
def test_without_a_chosen_key_there_is_nothing_to_edit(edit: object) -> None:
    with pytest.raises(UsageError, match="no key is chosen"):
        edit(state_of(2, None))  # type: ignore[operator]


@pytest.mark.parametrize("at", [-1, 2, 99])
def test_keys_that_are_none_cannot_be_chosen(at: int) -> None:
    with pytest.raises(UsageError, match="of 2"):
        chosen(state_of(2, None), at)


@given(st.integers(1, 6), st.data())
def test_shifting_keeps_all_keys_and_follows_the_chosen_one(count: int, data: st.DataObject) -> None:
    at, by = data.draw(st.integers(0, count - 1)), data.draw(st.integers(-8, 8))
    state = shifted(state_of(count, at), by)
    assert sorted(numbers(state)) == list(range(count)) and state.chosen is not None
    assert numbers(state)[state.chosen] == at and state.chosen == min(count - 1, max(0, at + by))
    rest = [n for n in numbers(state) if n != at]
    assert rest == sorted(rest)


def test_going_to_a_key_takes_its_look() -> None:
    state = State(keys=(key(0, ONE), key(1, TWO)), chosen=1, look=PLAIN)
    assert at_key(state).look == TWO and at_key(chosen(state, 0)).look == ONE


def test_looks_fade_from_key_to_key_as_in_the_film() -> None:
    keys = (key(0, ONE), key(1, TWO), key(2, TWO))
    assert between_keys(keys, 0.0) == ONE and between_keys(keys, 1.0) == TWO and between_keys(keys, 1.7) == TWO
    assert between_keys(keys, 2.0) == TWO and between_keys(keys, -1.0) == ONE and between_keys(keys, 9.0) == TWO
    half, quarter = between_keys(keys, 0.5), between_keys(keys, 0.25)
    assert half == replace(ONE, towards=TWO, at=0.5)
    assert quarter.at == pytest.approx(0.25**2 * 2.5)  # smoothstep
    assert between_keys((key(0, ONE),), 0.0) == ONE


def test_looks_that_are_fades_themselves_hold_for_half_the_way() -> None:
    between = replace(ONE, towards=TWO, at=0.3)
    keys = (key(0, between), key(1, PLAIN))
    assert between_keys(keys, 0.4) == between and between_keys(keys, 0.6) == PLAIN
