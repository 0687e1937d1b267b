"""Looks of the page."""

from session_helpers import card

from fprf.page.looks import Look
from fprf.style.config import StyleConfig

A, B, C = (card(i) for i in range(3))


def test_pins_replace_each_other_and_forbidden_references_add_up() -> None:
    look = Look(mix=((A, 1.0), (B, 1.0), (C, 1.0)))
    assert {*look.ruled(1, "pin", A).ruled(1, "pin", B).rules} == {(1, "pin", B)}
    look = look.ruled(1, "forbid", A).ruled(1, "forbid", B)
    assert {*look.rules} == {(1, "forbid", A), (1, "forbid", B)}
    assert look.ruled(1, "forbid", C).rules == look.ruled(1, None).rules == frozenset(), (
        "something must be left to take"
    )
    assert {*look.mixed([(B, 1.0)]).rules} == {(1, "forbid", B)}, "rules go with their photographs"
    assert {*look.ruled(0, "keep").renumbered([2, 0]).rules} == {
        (0, "forbid", A),
        (0, "forbid", B),
        (2, "keep", None),
    }


def test_a_look_in_the_terms_of_a_style() -> None:
    set_ = StyleConfig(strength=0.7, clusters=4, luminance=0.3)
    look = (
        Look(mix=((A, 1.0), (B, 0.5)), style=set_).ruled(2, "pin", B).ruled(0, "forbid", A).ruled(5, "keep")
    )
    style = look.config()
    assert style.references == (A.path, B.path) and style.weights == (1.0, 0.5)
    assert (style.strength, style.clusters, style.luminance, style.stylizer) == (0.7, 4, 0.3, set_.stylizer)
    assert style.pin == ("2=1",) and style.forbid == ("0=0",) and style.keep == ("5",)
