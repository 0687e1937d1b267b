"""The frame in which regions and codes are matched: what it must not see, and what it mends."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fprf.style.matching import Keys, Matching, attention, match_keys, score_spread, unit, whitener

FRAMES = [Matching(0.3), Matching(0.3, whitening=0.5), Matching(0.3, whitening=1.0), Matching(0.3, "cosine", 0.5, 5)]


def side(count: int, dims: int, seed: int) -> Keys:
    g = torch.Generator().manual_seed(seed)
    stretch = torch.linspace(3.0, 0.3, dims, dtype=torch.float64)
    keys = torch.randn(count, dims, generator=g, dtype=torch.float64) * stretch
    return Keys(keys, torch.rand(count, generator=g, dtype=torch.float64) + 0.1)


def turned(dims: int, seed: int) -> torch.Tensor:
    g = torch.Generator().manual_seed(seed)
    return torch.linalg.qr(torch.randn(dims, dims, generator=g, dtype=torch.float64)).Q


def table(here: Keys, there: Keys, matching: Matching) -> torch.Tensor:
    return match_keys(here, there, matching, torch.ones(len(there.keys)))


def test_without_frame_it_is_attention_of_centred_cosines() -> None:
    here, there = side(5, 4, 0), side(7, 4, 1)
    queries, keys = (unit(s.keys, s.share @ s.keys / s.share.sum()) for s in (here, there))
    expected = attention(queries, keys, 0.3 * score_spread(queries, keys))
    torch.testing.assert_close(table(here, there, Matching(0.3)), expected)


@pytest.mark.parametrize("matching", FRAMES)
def test_where_a_side_lies_and_how_both_are_turned_decides_nothing(matching: Matching) -> None:
    here, there, rotation = side(6, 5, 2), side(9, 5, 3), turned(5, 4)
    plain = table(here, there, matching)
    moved = table(Keys(here.keys + 7, here.share), Keys(there.keys - 3, 5 * there.share), matching)
    both = table(Keys(here.keys @ rotation, here.share), Keys(there.keys @ rotation, there.share), matching)
    torch.testing.assert_close(moved, plain, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(both, plain, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("matching", FRAMES)
def test_codes_may_come_in_any_order(matching: Matching) -> None:
    here, there = side(4, 3, 5), side(8, 3, 6)
    order = torch.randperm(8, generator=torch.Generator().manual_seed(0))
    shuffled = table(here, Keys(there.keys[order], there.share[order]), matching)
    torch.testing.assert_close(shuffled, table(here, there, matching)[:, order], rtol=1e-9, atol=1e-12)


def test_whitening_takes_the_share_of_the_spread_that_it_is_told() -> None:
    keys = turned(6, 1)[:, :4] * torch.tensor([9.0, 3.0, 1.0, 1.0], dtype=torch.float64)
    keys = torch.cat([keys, -keys])  # centred
    every = Keys(keys, torch.ones(12, dtype=torch.float64))

    def spread(whitening: float) -> torch.Tensor:
        values = torch.linalg.svdvals(keys @ whitener(every, whitening))
        return values[0] / values[-1]

    assert torch.equal(whitener(every, 0.0), torch.eye(4, dtype=torch.float64))
    assert float(spread(0.0)) > float(spread(0.5)) > float(spread(1.0)) > 1
    half = whitener(every, 0.5)
    torch.testing.assert_close(half @ half, whitener(every, 1.0))
    assert torch.equal(whitener(Keys(torch.ones(3, 4), torch.ones(3)), 1.0), torch.eye(4, dtype=torch.float64))


def test_what_references_show_too_much_of_does_not_move_the_centre() -> None:
    """Three kinds in the scene; the references show the first almost alone."""
    kinds, share = torch.eye(3, dtype=torch.float64), torch.ones(3, dtype=torch.float64)
    here, there = Keys(kinds, share), Keys(kinds + 0.5, torch.tensor([0.9, 0.05, 0.05], dtype=torch.float64))
    once, settled = (table(here, there, Matching(0.5, recentred=times)) for times in (0, 5))
    even = table(here, Keys(kinds + 0.5, share), Matching(0.5))
    assert float((settled - even).abs().max()) < 0.2 * float((once - even).abs().max()), "as if they showed all alike"


def test_what_a_wide_direction_hides_is_found_again() -> None:
    """Trees and houses differ in one narrow direction; sky and ground spread the wide one. Style noise lies on the wide one."""
    wide, narrow = torch.eye(2, dtype=torch.float64) * torch.tensor([4.0, 1.0], dtype=torch.float64)
    kinds = torch.stack([3 * wide, -3 * wide, narrow, -narrow])
    noise = torch.stack([0 * wide, 0 * wide, -1.5 * wide, 1.5 * wide])
    share = torch.ones(4, dtype=torch.float64)
    here, there = Keys(kinds, share), Keys(kinds + noise, share)
    plain, white = (table(here, there, Matching(0.3, whitening=w)).diagonal()[2:].min() for w in (0.0, 1.0))
    assert float(white) > float(plain)


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 6), st.integers(1, 9), st.integers(1, 5), st.sampled_from([0.0, 1e-12, 1e9]), st.sampled_from(FRAMES))
def test_rows_are_shares_whatever_comes(k: int, t: int, dims: int, scale: float, matching: Matching) -> None:
    here, there = side(k, dims, k), side(t, dims, t + 9)
    found = table(Keys(here.keys * scale, here.share), Keys((there.keys * scale).float(), there.share.float()), matching)
    assert found.shape == (k, t) and found.dtype == torch.float64 and bool((found >= 0).all())
    torch.testing.assert_close(found.sum(1), torch.ones(k, dtype=torch.float64))


def test_dot_products_know_no_frame_and_weights_count() -> None:
    here, there = side(4, 3, 7), side(5, 3, 8)
    plain = table(here, there, Matching(0.3, "dot"))
    assert torch.equal(table(here, there, Matching(0.3, "dot", 1.0, 5)), plain)
    favoured = torch.tensor([5.0, 1.0, 1.0, 1.0, 1.0])
    for matching in (Matching(0.3, "dot"), FRAMES[1]):
        more, before = match_keys(here, there, matching, favoured), table(here, there, matching)
        torch.testing.assert_close(more[:, 0] / more[:, 1], 5 * before[:, 0] / before[:, 1])
