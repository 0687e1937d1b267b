import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fprf.errors import ConfigError
from fprf.style.matching import Similarity, attention, compared, point_shares, score_spread, unit


def plain_attention(q: torch.Tensor, k: torch.Tensor, temperature: float) -> torch.Tensor:
    """Paper, Eq. 5 and 6, row by row in float64."""
    out = []
    for row in q.double():
        r = torch.tensor([float((row * key).sum()) for key in k.double()], dtype=torch.float64) / temperature
        e = (r - r.max()).exp()
        out.append(e / e.sum())
    return torch.stack(out)


@pytest.mark.parametrize(("norm", "temperature"), [(30.0, 100.0), (100.0, 100.0), (100.0, 1.0), (265.0, 100.0), (1.0, 0.05)])
def test_attention_is_the_papers_within_the_float32_bound(norm: float, temperature: float) -> None:
    q, k = (norm * torch.nn.functional.normalize(torch.randn(n, 64), dim=1) for n in (40, 9))
    a = attention(q, k, temperature)
    largest = float((q.double() @ k.double().T).abs().max()) / temperature
    bound = 2 * 6e-8 * largest + 8 * 6e-8
    assert float((a.double() - plain_attention(q, k, temperature)).abs().max()) <= bound
    torch.testing.assert_close(a.sum(1), torch.ones(40), rtol=0.0, atol=5e-7)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 9), st.integers(1, 6), st.floats(1e-38, 1e6), st.floats(0, 7e4), st.integers(0, 99))
def test_attention_is_always_finite_and_sums_to_one(n: int, t: int, temperature: float, norm: float, seed: int) -> None:
    g = torch.Generator().manual_seed(seed)
    a = attention(torch.randn(n, 5, generator=g) * norm, torch.randn(t, 5, generator=g) * norm, temperature)
    assert bool(a.isfinite().all())
    torch.testing.assert_close(a.sum(1), torch.ones(n), rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("temperature", [0.0, -1.0, float("nan")])
def test_temperatures_that_are_not_above_zero_are_refused(temperature: float) -> None:
    with pytest.raises(ConfigError, match="temperature"):
        attention(torch.ones(1, 2), torch.ones(1, 2), temperature)


def test_zero_queries_and_keys_match_everything_alike() -> None:
    k = unit(torch.randn(4, 3), torch.zeros(3))
    torch.testing.assert_close(attention(torch.zeros(2, 3), k, 0.1), torch.full((2, 4), 0.25))
    torch.testing.assert_close(attention(torch.randn(2, 3), torch.zeros(4, 3), 0.1), torch.full((2, 4), 0.25))


def test_prior_multiplies_the_odds() -> None:
    q, k = torch.randn(5, 3), torch.randn(4, 3)
    prior = torch.tensor([1.0, 2.0, 0.5, 1.0])
    expected = attention(q, k, 1.0) * prior
    torch.testing.assert_close(attention(q, k, 1.0, prior), expected / expected.sum(1, keepdim=True))


def test_float32_holds_under_autocast() -> None:
    q, k = torch.randn(20, 32) * 10, torch.randn(6, 32) * 10
    with torch.autocast("cpu", dtype=torch.bfloat16):
        a = attention(q, k, 100.0)
    assert torch.equal(a, attention(q, k, 100.0))


def test_unit_gives_unit_rows_and_zero_at_the_centre() -> None:
    centre = torch.full((6,), 100.0)
    x = torch.cat([centre[None], centre + torch.randn(5, 6)])
    u = unit(x, centre)
    assert torch.equal(u[0], torch.zeros(6))
    torch.testing.assert_close(u[1:].norm(dim=1), torch.ones(5))
    # What rounding alone moved away from the centre has no direction either.
    assert torch.equal(unit(centre[None] * (1 + 1e-7), centre), torch.zeros(1, 6))


def test_spread_follows_the_scale_of_the_scores_and_ignores_common_offsets() -> None:
    q, k = torch.randn(7, 5), torch.randn(6, 5)
    spread = score_spread(q, k)
    assert score_spread(q * 100, k * 3) == pytest.approx(300 * spread, rel=1e-5)
    assert score_spread(q, k + torch.randn(5)) == pytest.approx(spread, rel=1e-5)
    r = (q.double() @ k.double().T).tolist()
    plain = (sum(sum((x - sum(row) / 6) ** 2 for x in row) for row in r) / 42) ** 0.5
    assert spread == pytest.approx(plain, rel=1e-6)


@pytest.mark.parametrize("shape", [(0, 3), (3, 0), (1, 3)])
def test_spread_without_anything_to_tell_apart_is_one(shape: tuple[int, int]) -> None:
    assert score_spread(torch.randn(shape[0], 4), torch.zeros(shape[1], 4)) == 1.0
    assert score_spread(torch.randn(3, 4), torch.randn(1, 4)) == 1.0


@pytest.mark.parametrize("temperature", [1e-38, 1e-30, 1e-3, 1.0, 100.0, 1e6])
def test_duplicate_keys_share_evenly_at_any_temperature(temperature: float) -> None:
    k = torch.randn(3, 8) * 50
    a = attention(torch.randn(20, 8) * 50, torch.cat([k, k]), temperature)
    assert bool(a.isfinite().all())
    torch.testing.assert_close(a[:, :3], a[:, 3:], rtol=0.0, atol=1e-6)
    torch.testing.assert_close(a.sum(1), torch.ones(20), rtol=0.0, atol=1e-6)


def test_one_key_takes_everything() -> None:
    for scale in (0.0, 1.0, 7e4):
        assert torch.equal(attention(torch.randn(5, 3) * scale, torch.randn(1, 3) * scale, 0.4), torch.ones(5, 1))


@pytest.mark.parametrize("similarity", ["cosine", "dot"])
def test_scores_of_compared_sides_are_cosines_or_differences_of_dot_products(similarity: Similarity) -> None:
    q, k = torch.randn(6, 4) + 3, torch.randn(5, 4) - 2
    a, b = compared(q, k, similarity, queries_centre=q.mean(0), keys_centre=k.mean(0))
    r = a @ b.T
    if similarity == "cosine":
        expected = torch.nn.functional.cosine_similarity((q - q.mean(0))[:, None], (k - k.mean(0))[None], dim=2)
        torch.testing.assert_close(r, expected, rtol=0.0, atol=1e-5)
    else:
        plain = q @ k.T
        torch.testing.assert_close(r - r[:, :1], plain - plain[:, :1], rtol=1e-4, atol=1e-4)


def plain_shares(
    x: torch.Tensor, keys: torch.Tensor, temperature: float, centre: torch.Tensor | None, prior: torch.Tensor, faint: float
) -> torch.Tensor:
    """Row by row in float64."""
    out = []
    for row in x.double():
        away = row if centre is None else row - centre.double()
        size = 1.0 if centre is None else float(away.norm())
        away = away / size if size > 1e-6 * float(0.0 if centre is None else centre.double().norm()) else 0 * away
        odds = (keys.double() @ away / temperature - float((keys.double() @ away / temperature).max())).exp() * prior.double()
        odds = odds / odds.sum()
        odds = torch.where(odds < faint * odds.max(), 0.0, odds)
        out.append(odds / odds.sum())
    return torch.stack(out) if out else x.double().new_zeros(0, len(keys))


@pytest.mark.parametrize("wide", [torch.float32, torch.float64])
@pytest.mark.parametrize("centred", [False, True])
@pytest.mark.parametrize("faint", [0.0, 0.2])
@pytest.mark.parametrize("count", [0, 1, 50])
@torch.no_grad()
def test_shares_of_points_are_those_of_a_loop(wide: torch.dtype, centred: bool, faint: float, count: int) -> None:
    draw = torch.Generator().manual_seed(count)
    x, keys = torch.randn(count, 8, generator=draw) * 3 + 5, torch.randn(6, 8, generator=draw)
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


def test_a_common_offset_of_keys_costs_no_digits() -> None:
    draw = torch.Generator().manual_seed(0)
    q, k = torch.randn(6, 8, generator=draw), torch.randn(5, 8, generator=draw) + 1e4
    a, b = compared(q, k, "dot", queries_centre=q.mean(0), keys_centre=k.mean(0))
    r, exact = a @ b.T, q.double() @ (k.double() - k.double().mean(0)).T
    assert float(((r - r[:, :1]).double() - (exact - exact[:, :1])).abs().max()) < 1e-4


def test_spread_within_rounding_of_the_largest_score_is_none() -> None:
    keys = torch.tensor([[1.0], [1.0 + 1e-9]], dtype=torch.float64)
    assert score_spread(torch.tensor([[1e6], [0.0]]), keys) == score_spread(torch.tensor([[-1e6]]), keys) == 1.0


def test_directions_begin_just_above_rounding_and_have_gradients_at_the_centre() -> None:
    centre = torch.full((4,), 100.0, dtype=torch.float64)
    near, apart = centre * (1 + 0.7e-6), centre * (1 + 1.5e-6)
    found = unit(torch.stack([near, apart]), centre)
    assert found[0].tolist() == [0.0] * 4 and float(found[1].norm()) == pytest.approx(1)
    x = torch.cat([centre[None], centre[None] + 1]).requires_grad_(True)
    unit(x, centre).sum().backward()
    assert x.grad is not None and bool(x.grad.isfinite().all())
