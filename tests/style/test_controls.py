"""What users ask of a style: strengths, luminance, regions and references by their names."""

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from fprf.errors import ConfigError, UsageError
from fprf.style.config import RegionValue, find_reference, labels, parse_place, parse_region_value, parse_strength
from fprf.style.light import luma
from fprf.style.look import blend_strength, keep_luminance, place_weight
from fprf.style.regions import allowed_references

COLOUR = st.tuples(
    *[st.sampled_from([0.0, 1e-7, 0.2, 0.5, 1 / 3, 0.999, 1.0]) | st.floats(0, 1, width=32, allow_subnormal=False)] * 3
)


def test_the_ends_are_bitwise_and_the_same_object() -> None:
    content, styled = torch.randn(7, 3), torch.randn(7, 3)
    assert blend_strength(content, styled, 0.0) is content
    assert blend_strength(content, styled, 1.0) is styled


@settings(max_examples=200, deadline=None)
@given(COLOUR, COLOUR, st.sampled_from([0.0, 0.3, 1.0]))
@example((0.0, 0.0, 1.1754943508222875e-38), (0.0, 0.0, 0.0), 0.0)
def test_kept_luminance_is_the_scenes_and_colours_stay_colours(
    styled: tuple[float, float, float], own: tuple[float, float, float], share: float
) -> None:
    a, b = torch.tensor([styled]), torch.tensor([own])
    out = keep_luminance(a, b, share)
    assert float(out.min()) >= 0 and float(out.max()) <= 1
    # Rounding: a handful of float32 operations on numbers up to 1, and the tint's share of the clamp.
    wanted = luma(a.double()) + share * (luma(b.double()) - luma(a.double()))
    torch.testing.assert_close(luma(out.double()), wanted, rtol=0.0, atol=2e-6)
    if share == 0 or styled == own:
        assert torch.equal(out, a), "bit for bit"


def test_hues_survive_where_there_is_room_and_fade_where_not() -> None:
    orange, bright, dark = (torch.tensor([c]) for c in ((0.6, 0.4, 0.2), (0.55, 0.5, 0.45), (0.0, 0.0, 0.0)))
    moved = keep_luminance(orange, bright, 1.0)
    torch.testing.assert_close(moved - luma(moved), orange - luma(orange), rtol=0.0, atol=1e-6)
    white = keep_luminance(orange, torch.ones(1, 3), 1.0)
    torch.testing.assert_close(white, torch.ones(1, 3))
    assert torch.equal(keep_luminance(orange, dark, 1.0), dark)
    # Too light for so strong a tint: the direction of the tint is the same, its length is what fits.
    light = keep_luminance(torch.tensor([[1.0, 0.0, 0.0]]), torch.full((1, 3), 0.9), 1.0)
    tint, full = (light - luma(light))[0], torch.tensor([1.0, 0.0, 0.0]) - 0.2126
    torch.testing.assert_close(torch.linalg.vecdot(tint, full), tint.norm() * full.norm(), rtol=1e-5, atol=0.0)
    assert float(light.amax()) == pytest.approx(1.0)


def test_pins_exclude_the_others_and_forbidding_leaves_the_rest() -> None:
    allowed = allowed_references(4, 3, pin={0: {1}, 3: {0, 2}}, forbid=[(1, 2), (3, 0)])
    assert allowed.tolist() == [[False, True, False], [True, True, False], [True, True, True], [False, False, True]]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("box:0,-1,-1:1,1,1:0.5", [1.0, 0.84375, 0.5, 0.0, 1.0]),  # a smoothstep from the border's inside to its outside
        ("box:1,1,1:0,-1,-1", [1.0, 0.0, 0.0, 0.0, 1.0]),
        ("path:-1,0,0:0.5,0,0:0.5,2,0:1,0.5", [1.0, 0.84375, 0.5, 0.0, 1.0]),
        ("everywhere", [1.0] * 5),
    ],
)
def test_a_place_is_full_inside_and_fades_over_its_border(text: str, expected: list[float]) -> None:
    place = parse_place("pin", text)
    assert place is not None and parse_place("pin", "3") is None
    points = torch.tensor([[0.5, 0.0, 0.0], [1.125, 0.0, 0.0], [1.25, 0.0, 0.0], [1.6, 0.0, 0.0], [0.4, 0.9, 0.0]])
    assert place_weight(place, points).tolist() == pytest.approx(expected)


PHOTOS = [Path("a/autumn.jpg"), Path("b/night.jpg"), Path("b/7.jpg"), Path("c/night.png")]


@pytest.mark.parametrize(
    ("text", "wish"),
    [
        ("3=autumn.jpg", RegionValue("3", "autumn.jpg")),
        ("IMG_0012:120,80=0", RegionValue("IMG_0012:120,80", "0")),
        ("a=b:mask.png=x.jpg", RegionValue("a=b:mask.png", "x.jpg")),
    ],
)
def test_a_wish_is_split_at_its_last_equals_sign(text: str, wish: RegionValue) -> None:
    assert parse_region_value("pin", text) == wish and parse_strength("region_strength", "sky=0.5") == ("sky", 0.5)


@pytest.mark.parametrize(
    ("text", "index"),
    [("autumn.jpg", 0), ("a/autumn.jpg", 0), ("autumn", 0), ("night.jpg", 1), ("1", 1), ("3", 3), ("night.png", 3)],
)
def test_references_are_found_by_path_name_number_and_stem(text: str, index: int) -> None:
    assert find_reference(text, PHOTOS) == index


@pytest.mark.parametrize(
    ("paths", "names"),
    [
        (["a/x.jpg", "b/y.jpg"], ("x.jpg", "y.jpg")),
        (["a/x.jpg", "b/x.jpg"], ("a/x.jpg", "b/x.jpg")),
        (["1/a/x.jpg", "2/a/x.jpg"], ("1/a/x.jpg", "2/a/x.jpg")),
        (["a/x.jpg", "a/x.jpg", "a/x.jpg"], ("x.jpg", "x.jpg (2)", "x.jpg (3)")),
    ],
)
def test_labels_are_short_and_different(paths: list[str], names: tuple[str, ...]) -> None:
    assert labels([Path(p) for p in paths]) == names and len(set(names)) == len(names)


@pytest.mark.parametrize(
    ("kind", "mistake"),
    [
        *((UsageError, partial(blend_strength, torch.zeros(1, 1), torch.zeros(1, 1), s)) for s in (-0.1, 1.1, math.nan)),
        *((UsageError, partial(allowed_references, 2, 2, pin=pin)) for pin in ({2: {0}}, {0: {2}})),
        *((UsageError, partial(allowed_references, 2, 2, forbid=ban)) for ban in ([(0, -1)], [(1, 0), (1, 1)])),
        (UsageError, partial(allowed_references, 2, 2, pin={1: {0}}, forbid=[(1, 0)])),
        *((ConfigError, partial(parse_strength, "region_strength", text)) for text in ("3=1.5", "3=nan", "3=much")),
        *((UsageError, partial(find_reference, text, PHOTOS)) for text in ("x", "night")),
    ],
)
def test_what_cannot_be_is_refused(kind: type[Exception], mistake: Callable[[], object]) -> None:
    with pytest.raises(kind):
        mistake()
