from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from fprf.errors import ConfigError, UsageError
from fprf.page import messages
from fprf.page.drawing import Key
from fprf.page.messages import Camera
from fprf.page.restyler import Look, Photograph, Restyler, matching_regions, renumbered, set_rule, style_config
from fprf.page.session import SHELF, State, _added, _kept, _keyed, _removed
from fprf.style.dictionary import Reference
from fprf.style.files import StyleFile
from fprf.style.look import Restyle
from fprf.style.regions import Regions, membership_view
from fprf.style.restyle import apply_style
from fprf.training.views import render_view


def rendered(restyler: Restyler, restyle: Restyle | None) -> torch.Tensor:
    trained = restyler.scene
    return render_view(trained.model, trained.known.facts, trained.known.cameras, 2, trained.config.render, restyle).rgb


def test_a_look_is_the_style_that_the_command_line_makes(restyler: Restyler, encoded: tuple[Photograph, Photograph]) -> None:
    a, b = encoded
    look = set_rule(Look(mix=((a, 1.0), (b, 0.5)), strength=0.8, clusters=3, luminance=0.2), 1, "pin", b)
    wanted = apply_style(restyler.scene, StyleFile(style_config(look)))
    assert torch.allclose(rendered(restyler, restyler.restyle(look)), rendered(restyler, wanted.restyle), atol=2e-5)


def test_styles_are_kept_and_bounded(restyler: Restyler, encoded: tuple[Photograph, Photograph]) -> None:
    first = Look(mix=((encoded[0], 1.0),), clusters=2)
    styled = restyler.styled(first)
    assert restyler.styled(replace(first)) is styled
    for step in range(30):
        restyler.styled(replace(first, strength=0.01 * (step + 1)))
    assert len(restyler._styles) <= 24 and len(restyler._dictionaries) == 1
    restyler.retain(encoded[:1])
    assert restyler._styles and restyler._dictionaries
    restyler.retain([])
    assert not restyler._styles and not restyler._dictionaries


def test_a_pixel_finds_the_region_that_is_there(restyler: Restyler) -> None:
    cameras = restyler.scene.cameras.select(torch.tensor([2]))
    share, _ = membership_view(Regions(restyler.scene, restyler.encoders.scene_style, restyler.encoders.basis), 2, 1000)
    for x, y in ((3, 4), (20, 18), (31, 23)):
        assert restyler.region_at(cameras, (x + 0.5, y + 0.5)) == int(share[y, x].argmax())
    with pytest.raises(UsageError, match="outside"):
        restyler.region_at(cameras, (32.0, 1.0))


def test_regions_are_matched_whatever_their_order(restyler: Restyler) -> None:
    generator = torch.Generator().manual_seed(0)
    keys, noise = torch.randn(2, 6, 8, generator=generator)
    style = restyler.encoders.scene_style._replace(keys=keys, semantic_mean=torch.randn(8, generator=generator))
    order = torch.randperm(6, generator=generator)
    moved = style._replace(keys=keys[order] + 0.01 * noise)
    assert torch.equal(order[matching_regions(style, moved)], torch.arange(6))
    assert matching_regions(style, style._replace(keys=keys[:4])).max() < 4
    blind = style._replace(keys=keys[:, :0])
    assert torch.equal(matching_regions(blind, blind), torch.zeros(6, dtype=torch.int64))


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


@pytest.mark.parametrize(
    "wrong", [{"strength": 1.5}, {"bold": -1.0}, {"clusters": 0}, {"temperature": 0.0}, {"smoothness": -1.0}]
)
def test_an_impossible_look_is_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ConfigError):
        replace(ONE, **wrong)  # type: ignore[arg-type]


def test_a_new_photograph_is_the_style_or_joins() -> None:
    state = _added(State(), A)
    assert state.look.mix == ((A, 1.0),) and state.shelf == (A,)
    assert _added(state, B).look.mix == ((B, 1.0),)
    mixed = _added(replace(state, together=True), B)
    assert mixed.look.mix == ((A, 1.0), (B, 1.0)) and mixed.shelf == (A, B)
    off = replace(state, look=replace(state.look, strength=0.0))
    assert _added(off, B).look.strength == 1.0  # else nothing would be seen of it


@pytest.mark.parametrize("together", [False, True])
def test_the_shelf_is_bounded(together: bool) -> None:
    state = kept(_added(State(together=together), A), "mine")
    for number in range(10, 10 + 3 * SHELF):
        state = _added(state, card(number))
        assert len(state.shelf) <= SHELF and state.look.mix[-1][0] is state.shelf[-1] and state.shelf[-1].number == number
    assert together or A in state.shelf  # the look that was kept needs it


def kept(state: State, name: str, action: str = "keep") -> State:
    return _kept(state, messages.Keep(name=name, action=action))  # type: ignore[arg-type]


def test_kept_looks_outlive_their_photographs() -> None:
    state = kept(_added(State(), A), "  autumn   light ")
    assert state.kept == (("autumn light", state.look),)
    assert kept(state, "autumn light").kept == state.kept
    gone = _removed(state, A)
    assert gone.shelf == () and gone.look.plain and gone.kept == state.kept and A in gone.in_use
    assert kept(gone, "autumn light", "restore").look == state.look and kept(gone, "autumn light", "drop").kept == ()
    for k in range(63):
        state = kept(state, f"look {k}")
    for name in ("  ", "one too many", "Now"):
        with pytest.raises(UsageError, match="keep look"):
            kept(state, name)


def test_new_numbers_of_regions_reach_a_look() -> None:
    look = renumbered(set_rule(set_rule(ONE, 0, "pin", A), 1, "keep"), [2, 0])
    assert look == set_rule(set_rule(ONE, 2, "pin", A), 0, "keep")


def camera(number: int) -> Camera:
    return Camera((float(number), 0, 0), ((1, 0, 0), (0, 1, 0), (0, 0, 1)), (9, 9, 8, 6), (16, 12))


def numbers(state: State) -> list[int]:
    return [round(each.camera.place[0]) for each in state.keys]


def keyed(state: State, action: str, at: int = 0, number: int | None = None) -> State:
    where = None if number is None else camera(number)
    return _keyed(state, messages.Key(action=action, at=at, camera=where))  # type: ignore[arg-type]


def test_keys_are_added_replaced_moved_and_removed() -> None:
    state = State()
    for number in range(3):
        state = keyed(state, "add", number=number)
    assert numbers(state) == [0, 1, 2] and state.keys[0] == Key(camera(0), state.look)
    assert numbers(keyed(state, "earlier", 2)) == [0, 2, 1] and numbers(keyed(state, "earlier", 0)) == [0, 1, 2]
    assert numbers(keyed(state, "remove", 1)) == [0, 2]
    for action in ("earlier", "remove"):
        with pytest.raises(UsageError, match="of 3"):
            keyed(state, action, 3, 1)
    with pytest.raises(UsageError, match="camera"):
        keyed(state, "add")
    with pytest.raises(UsageError, match="64 keys"):
        keyed(State(keys=(Key(camera(0), PLAIN),) * 64), "add", number=1)
