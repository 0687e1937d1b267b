import pytest
import torch

from fprf.errors import UsageError
from fprf.style.controls import blend_strength, edit_table


def test_the_ends_are_bitwise_and_the_same_object() -> None:
    content, styled = torch.randn(7, 3), torch.randn(7, 3)
    assert blend_strength(content, styled, 0.0) is content
    assert blend_strength(content, styled, 1.0) is styled


def test_a_style_that_is_not_finite_does_not_show_at_strength_zero() -> None:
    content = torch.randn(2, 3)
    assert torch.equal(blend_strength(content, torch.full((2, 3), float("nan")), 0.0), content)


@pytest.mark.parametrize("strength", [0.25, 0.5, 0.9])
def test_between_it_is_linear(strength: float) -> None:
    content, styled = torch.randn(7, 3), torch.randn(7, 3)
    expected = (1 - strength) * content.double() + strength * styled.double()
    torch.testing.assert_close(blend_strength(content, styled, strength).double(), expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("strength", [-0.1, 1.1, float("nan"), float("inf")])
def test_strength_has_a_range(strength: float) -> None:
    with pytest.raises(UsageError, match="strength"):
        blend_strength(torch.zeros(1, 1), torch.zeros(1, 1), strength)


TABLE = torch.tensor([[0.5, 0.3, 0.2], [1.0, 0.0, 0.0]])
REFERENCE = torch.tensor([0, 0, 1])


def test_no_wishes_leave_the_table() -> None:
    torch.testing.assert_close(edit_table(TABLE, REFERENCE), TABLE)


def test_a_pin_keeps_the_odds_within_its_reference() -> None:
    torch.testing.assert_close(edit_table(TABLE, REFERENCE, pin={0: 0})[0], torch.tensor([0.625, 0.375, 0.0]))
    # The matching gave reference 1 nothing at all here: it gets everything now.
    torch.testing.assert_close(edit_table(TABLE, REFERENCE, pin={1: 1})[1], torch.tensor([0.0, 0.0, 1.0]))


def test_forbidding_leaves_the_rest() -> None:
    edited = edit_table(TABLE, REFERENCE, forbid={(0, 1)})
    torch.testing.assert_close(edited[0], torch.tensor([0.625, 0.375, 0.0]))
    torch.testing.assert_close(edited[1], TABLE[1])


@pytest.mark.parametrize("wish", [{"pin": {2: 0}}, {"pin": {0: 2}}, {"forbid": {(0, -1)}}])
def test_unknown_numbers_are_named(wish: dict[str, object]) -> None:
    with pytest.raises(UsageError, match="regions go from 0 to 1, references from 0 to 1"):
        edit_table(TABLE, REFERENCE, **wish)


def test_a_region_left_with_nothing_is_named() -> None:
    with pytest.raises(UsageError, match="region 1"):
        edit_table(TABLE, REFERENCE, forbid={(1, 0), (1, 1)})
