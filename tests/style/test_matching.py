"""Attention of points and of regions to codes: the formulas of the paper, and what they must not see."""

from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fprf.style.matching import attention, match_keys, point_shares, whitener


def plain_shares(
    x: torch.Tensor,
    keys: torch.Tensor,
    temperature: float,
    centre: torch.Tensor | None = None,
    prior: torch.Tensor | None = None,
    faint: float = 0.0,
) -> torch.Tensor:
    """Paper, Eq. 5 and 6, row by row in float64."""
    out = []
    for row in x.double():
        away = row if centre is None else row - centre.double()
        if centre is not None:
            size = float(away.norm())
            away = away / size if size > 1e-6 * float(centre.double().norm()) else 0 * away
        r = torch.stack([(away * key).sum() for key in keys.double()]) / temperature
        odds = (r - r.max()).exp() * (1.0 if prior is None else prior.double())
        odds = odds / odds.sum()
        odds = torch.where(odds < faint * odds.max(), 0.0, odds)
        out.append(odds / odds.sum())
    return torch.stack(out) if out else x.double().new_zeros(0, len(keys))


@pytest.mark.parametrize(
    ("norm", "temperature"), [(30.0, 100.0), (100.0, 100.0), (100.0, 1.0), (265.0, 100.0), (1.0, 0.05)]
)
def test_attention_is_the_papers_within_the_float32_bound(norm: float, temperature: float) -> None:
    q, k = (norm * torch.nn.functional.normalize(torch.randn(n, 64), dim=1) for n in (40, 9))
    a = attention(q, k, temperature)
    largest = float((q.double() @ k.double().T).abs().max()) / temperature
    bound = 2 * 6e-8 * largest + 8 * 6e-8
    assert float((a.double() - plain_shares(q, k, temperature)).abs().max()) <= bound
    torch.testing.assert_close(a.sum(1), torch.ones(40), rtol=0.0, atol=5e-7)


@pytest.mark.parametrize("wide", [torch.float32, torch.float64])
@pytest.mark.parametrize("centred", [False, True])
@pytest.mark.parametrize("faint", [0.0, 0.2])
@pytest.mark.parametrize("count", [0, 1, 50])
@torch.no_grad()
def test_shares_of_points_are_those_of_a_loop(
    wide: torch.dtype, centred: bool, faint: float, count: int
) -> None:
    draw = torch.Generator().manual_seed(count)
    x = torch.randn(count, 8, generator=draw) * 3 + 5
    keys = torch.randn(6, 8, generator=draw)
    centre = torch.full((8,), 5.0) if centred else None
    if centre is not None and count > 1:
        x[0] = centre
        x[1] = centre * (1 + 2e-7)  # rounding alone: no direction
    prior = torch.rand(6, generator=draw) + 0.2
    at = None if centre is None else centre.to(wide)
    found = point_shares(x.to(wide), keys.to(wide), 0.7, centre=at, prior=prior.to(wide), faint=faint)
    exact = plain_shares(x, keys, 0.7, centre, prior, faint)
    assert found.dtype == wide and found.shape == (count, 6)
    # A share at the edge of being faint may fall either way.
    off = ((found.double() - exact).abs() > (4 * 12 * 6e-8 * 60 if wide == torch.float32 else 1e-12)).any(1)
    assert float(off.double().sum()) <= (1 if faint else 0)
    if faint and count == 50:
        assert bool((found == 0).any()), "else nothing was faint"


Side = tuple[torch.Tensor, torch.Tensor]
"""Keys and their shares."""
FRAMES: list[dict[str, Any]] = [
    {},
    {"whitening": 0.5},
    {"whitening": 1.0},
    {"whitening": 0.5, "recentred": 5},
]


def side(count: int, dims: int, seed: int) -> Side:
    g = torch.Generator().manual_seed(seed)
    stretch = torch.linspace(3.0, 0.3, dims, dtype=torch.float64)
    keys = torch.randn(count, dims, generator=g, dtype=torch.float64) * stretch
    return keys, torch.rand(count, generator=g, dtype=torch.float64) + 0.1


def turned(dims: int, seed: int) -> torch.Tensor:
    g = torch.Generator().manual_seed(seed)
    return torch.linalg.qr(torch.randn(dims, dims, generator=g, dtype=torch.float64)).Q


def table(here: Side, there: Side, temperature: float = 0.3, **frame: Any) -> torch.Tensor:
    return match_keys(*here, *there, torch.ones(len(there[0])), temperature=temperature, **frame)


@pytest.mark.parametrize("frame", FRAMES)
def test_where_a_side_lies_and_how_both_are_turned_decides_nothing(frame: dict[str, Any]) -> None:
    (here, share) = side(6, 5, 2)
    (there, weight) = side(9, 5, 3)
    rotation = turned(5, 4)
    plain = table((here, share), (there, weight), **frame)
    moved = table((here + 7, share), (there - 3, 5 * weight), **frame)
    both = table((here @ rotation, share), (there @ rotation, weight), **frame)
    torch.testing.assert_close(moved, plain, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(both, plain, rtol=1e-9, atol=1e-9)


def test_whitening_takes_the_share_of_the_spread_that_it_is_told() -> None:
    keys = turned(6, 1)[:, :4] * torch.tensor([9.0, 3.0, 1.0, 1.0], dtype=torch.float64)
    keys = torch.cat([keys, -keys])  # centred
    every = keys, torch.ones(12, dtype=torch.float64)

    def spread(whitening: float) -> torch.Tensor:
        values = torch.linalg.svdvals(keys @ whitener(*every, whitening))
        return values[0] / values[-1]

    assert torch.equal(whitener(*every, 0.0), torch.eye(4, dtype=torch.float64))
    assert float(spread(0.0)) > float(spread(0.5)) > float(spread(1.0)) > 1
    half = whitener(*every, 0.5)
    torch.testing.assert_close(half @ half, whitener(*every, 1.0))
    assert torch.equal(whitener(torch.ones(3, 4), torch.ones(3), 1.0), torch.eye(4, dtype=torch.float64))


def test_what_references_show_too_much_of_does_not_move_the_centre() -> None:
    """Three kinds in the scene; the references show the first almost alone."""
    kinds = torch.eye(3, dtype=torch.float64)
    share = torch.ones(3, dtype=torch.float64)
    here = (kinds, share)
    there = (kinds + 0.5, torch.tensor([0.9, 0.05, 0.05], dtype=torch.float64))
    once, settled = (table(here, there, 0.5, recentred=times) for times in (0, 5))
    even = table(here, (kinds + 0.5, share), 0.5)
    assert float((settled - even).abs().max()) < 0.2 * float((once - even).abs().max()), (
        "as if they showed all alike"
    )


@settings(max_examples=40, deadline=None)
@given(
    st.integers(1, 6),
    st.integers(1, 9),
    st.integers(1, 5),
    st.sampled_from([0.0, 1e-12, 1e9]),
    st.sampled_from(FRAMES),
)
def test_rows_are_shares_whatever_comes(
    k: int, t: int, dims: int, scale: float, frame: dict[str, Any]
) -> None:
    (here, share) = side(k, dims, k)
    (there, weight) = side(t, dims, t + 9)
    found = table((here * scale, share), ((there * scale).float(), weight.float()), **frame)
    assert found.shape == (k, t) and found.dtype == torch.float64 and bool((found >= 0).all())
    torch.testing.assert_close(found.sum(1), torch.ones(k, dtype=torch.float64))


def test_weights_of_codes_multiply_their_odds() -> None:
    here = side(4, 3, 7)
    there = side(5, 3, 8)
    favoured = torch.tensor([5.0, 1.0, 1.0, 1.0, 1.0])
    for frame in FRAMES[:2]:
        more = match_keys(*here, *there, favoured, temperature=0.3, **frame)
        before = table(here, there, **frame)
        torch.testing.assert_close(more[:, 0] / more[:, 1], 5 * before[:, 0] / before[:, 1])
