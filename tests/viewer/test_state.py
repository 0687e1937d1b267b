from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from fprf.errors import ConfigError, UsageError
from fprf.style.dictionary import Reference
from fprf.viewer.cameras import Eye
from fprf.viewer.film import Key
from fprf.viewer.looks import Card, Look, only, ordered, settled, style_of, weighed
from fprf.viewer.restyler import Picked
from fprf.viewer.state import SHELF, State, dropped, kept, removed


def card(number: int) -> Card:
    empty = Reference(f"{number}", torch.zeros(0, 2), torch.zeros(0, 2))
    return Card(number, f"{number}.png", Path(f"/tmp/{number}.png"), np.zeros((1, 1, 3), np.uint8), empty)


A, B, C = (card(i) for i in range(3))


def test_equal_looks_are_one() -> None:
    assert Look(mix=((A, 1.0),)) == Look(mix=((A, 1.0),)) and Look(mix=((A, 1.0),)) != Look(mix=((card(0), 1.0),))
    assert len({Look(), Look(strength=1.0), Look(strength=0.5)}) == 2


@pytest.mark.parametrize("wrong", [{"strength": 1.1}, {"blend": -0.1}, {"clusters": 0}, {"temperature": 0.0}, {"at": 2.0}])
def test_ranges_are_those_of_styles(wrong: dict[str, float]) -> None:
    with pytest.raises(ConfigError):
        replace(Look(), **wrong)  # type: ignore[arg-type]
    with pytest.raises(ConfigError):
        Look(mix=((A, 0.0),))


def test_weights_order_and_void_wishes() -> None:
    look = weighed(weighed(Look(), B, 2.0, (A, B)), A, 1.0, (A, B))
    assert look.mix == ((A, 1.0), (B, 2.0))
    look = ordered(ordered(look, 3, "pin", B), 4, "keep")
    alone = only(look, A)
    assert alone.mix == ((A, 1.0),) and {order.region for order in alone.orders} == {4}
    assert weighed(look, B, 0.0, (A, B)).orders == alone.orders


def test_wishes_replace_each_other_but_bans_add_up() -> None:
    look = Look(mix=((A, 1.0), (B, 1.0), (C, 1.0)))
    look = ordered(ordered(look, 1, "pin", A), 1, "pin", B)
    assert [(o.verb, o.card) for o in look.orders] == [("pin", B)]
    look = ordered(ordered(look, 1, "forbid", A), 1, "forbid", B)
    assert {(o.verb, o.card) for o in look.orders} == {("forbid", A), ("forbid", B)}
    assert ordered(look, 1, "forbid", C).orders == frozenset()  # nothing would be left to take
    assert ordered(look, 1, None).orders == frozenset()


def test_a_look_in_the_terms_of_a_style() -> None:
    look = Look(mix=((A, 1.0), (B, 0.5)), strength=0.7, temperature=0.2, clusters=4, blend=0.1, luminance=0.3)
    look = ordered(ordered(ordered(look, 2, "pin", B), 0, "forbid", A), 5, "keep")
    style = style_of(look)
    assert style.references == (A.path, B.path) and style.weights == (1.0, 0.5)
    assert (style.strength, style.clusters, style.blend, style.luminance) == (0.7, 4, 0.1, 0.3)
    assert style.pin == ("2=1",) and style.forbid == ("0=0",) and style.keep == ("5",)
    assert getattr(style.stylizer, "temperature") == 0.2  # noqa: B009  the slot's own config has it


def test_fades_that_have_one_end_only_settle() -> None:
    a, b, plain = Look(mix=((A, 1.0),), strength=0.8), Look(mix=((B, 1.0),)), Look()
    assert settled(replace(a, towards=b, at=0.0)) == a
    assert settled(replace(a, towards=b, at=1.0)) == b
    assert settled(replace(a, towards=b, at=0.4)).towards == b
    assert settled(replace(a, towards=plain, at=0.25)) == replace(a, strength=0.6000000000000001)
    assert settled(replace(plain, towards=a, at=0.5)) == replace(a, strength=0.4)


def test_a_dropped_photograph_is_the_style_or_joins() -> None:
    state = dropped(State(), A)
    assert state.look.mix == ((A, 1.0),) and state.shelf == (A,)
    assert dropped(state, B).look.mix == ((B, 1.0),)
    mixed = dropped(replace(state, landing="in the mix"), B)
    assert mixed.look.mix == ((A, 1.0), (B, 1.0)) and mixed.shelf == (A, B)
    off = replace(state, look=replace(state.look, strength=0.0))
    assert dropped(off, B).look.strength == 1.0  # else nothing would be seen of it


def test_the_shelf_is_bounded_and_what_is_needed_stays() -> None:
    state = dropped(State(), A)
    state = kept(state, "mine")
    for number in range(10, 10 + 3 * SHELF):
        state = dropped(state, card(number))
        assert len(state.shelf) <= SHELF
    assert A in state.shelf  # the look that was kept needs it
    assert state.look.mix[0][0] is state.shelf[-1]


def test_a_shelf_full_of_photographs_in_use_still_takes_one() -> None:
    state = State(landing="in the mix")
    for number in range(SHELF + 5):
        state = dropped(state, card(number))
    assert len(state.shelf) == SHELF and state.shelf[-1].number == SHELF + 4


def test_removing_and_keeping() -> None:
    state = kept(dropped(State(), A), "  autumn   light ")
    assert state.saved == (("autumn light", state.look),)
    assert kept(state, "autumn light").saved == state.saved
    gone = removed(state, A)
    assert gone.shelf == () and gone.look.plain and gone.saved == state.saved and A in gone.in_use
    with pytest.raises(UsageError, match="name"):
        kept(state, "  ")


def test_what_is_shown_and_what_must_be_painted() -> None:
    assert State().shown.layers == {"look"}
    state = State(map="matches", wipe=0.3, picked=Picked(2, 0.1, ()))
    assert state.shown.layers == {"look", "matches", "plain", "region 2"}


@pytest.mark.parametrize("wrong", [{"map": "x"}, {"wipe": 1.5}, {"pixels": 3}, {"pixels": 5000}, {"cover": -1.0}])
def test_a_state_that_cannot_be_is_refused(wrong: dict[str, object]) -> None:
    with pytest.raises((UsageError, ConfigError)):
        replace(State(), **wrong)  # type: ignore[arg-type]


def test_keys_are_bounded() -> None:
    key = Key(Eye((1, 0, 0, 0), (0, 0, 0), 1.0, 1.0), Look())
    with pytest.raises(UsageError, match="64 keys"):
        State(keys=(key,) * 65)
