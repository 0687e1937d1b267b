import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from fprf.errors import UsageError
from fprf.style.controls import allowed_references, blend_strength, keep_luminance, luma

COLOUR = st.tuples(
    *[st.sampled_from([0.0, 1e-7, 0.2, 0.5, 1 / 3, 0.999, 1.0]) | st.floats(0, 1, width=32, allow_subnormal=False)] * 3
)


def test_the_ends_are_bitwise_and_the_same_object() -> None:
    content, styled = torch.randn(7, 3), torch.randn(7, 3)
    assert blend_strength(content, styled, 0.0) is content
    assert blend_strength(content, styled, 1.0) is styled


def test_strengths_of_points_are_bitwise_at_their_ends_too() -> None:
    content, styled = torch.randn(3, 5), torch.randn(3, 5)
    mixed = blend_strength(content, styled, torch.tensor([[0.0], [1.0], [0.25]]))
    assert torch.equal(mixed[0], content[0]) and torch.equal(mixed[1], styled[1])
    torch.testing.assert_close(mixed[2], blend_strength(content, styled, 0.25)[2])


def test_a_style_that_is_not_finite_does_not_show_at_strength_zero() -> None:
    content = torch.randn(2, 3)
    assert torch.equal(blend_strength(content, torch.full((2, 3), float("nan")), 0.0), content)


@pytest.mark.parametrize("strength", [0.25, 0.5, 0.9])
def test_between_it_is_linear(strength: float) -> None:
    content, styled = torch.randn(7, 3), torch.randn(7, 3)
    expected = (1 - strength) * content.double() + strength * styled.double()
    for given_as in (strength, torch.full((7, 1), strength)):
        torch.testing.assert_close(blend_strength(content, styled, given_as).double(), expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("strength", [-0.1, 1.1, float("nan"), float("inf")])
def test_strength_has_a_range(strength: float) -> None:
    with pytest.raises(UsageError, match="strength"):
        blend_strength(torch.zeros(1, 1), torch.zeros(1, 1), strength)


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


def test_a_channel_at_the_luma_of_black_is_a_colour() -> None:
    """Its tint is 0 and so is its room: 0 / 0 must not reach the pixel."""
    draw = torch.rand(20_000, 3, generator=torch.Generator().manual_seed(0))
    r, b = draw[:, 0], draw[:, 2]
    weights = luma(torch.eye(3))[:, 0]
    styled = torch.stack([r, (weights[0] * r + weights[2] * b) / (1 - weights[1]), b], 1)
    exact = luma(styled)[:, 0] == styled[:, 1]
    assert int(exact.sum()) > 100
    found = keep_luminance(styled[exact], torch.zeros(int(exact.sum()), 3), 1.0)
    assert torch.allclose(found, torch.zeros_like(found), atol=1e-6)


def test_pins_exclude_the_others_and_forbidding_leaves_the_rest() -> None:
    allowed = allowed_references(4, 3, pin={0: {1}, 3: {0, 2}}, forbid=[(1, 2), (3, 0)])
    assert allowed.tolist() == [[False, True, False], [True, True, False], [True, True, True], [False, False, True]]


@pytest.mark.parametrize("wish", [{"pin": {2: {0}}}, {"pin": {0: {2}}}, {"forbid": [(0, -1)]}])
def test_unknown_numbers_are_named(wish: dict[str, object]) -> None:
    with pytest.raises(UsageError, match="regions go from 0 to 1, references from 0 to 1"):
        allowed_references(2, 2, **wish)  # type: ignore[arg-type]


@pytest.mark.parametrize("wish", [{"forbid": [(1, 0), (1, 1)]}, {"pin": {1: {0}}, "forbid": [(1, 0)]}])
def test_a_region_left_with_nothing_is_named(wish: dict[str, object]) -> None:
    with pytest.raises(UsageError, match="region 1"):
        allowed_references(2, 2, **wish)  # type: ignore[arg-type]
