import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fprf.style.statistics import limit_gain, monge, symmetric_root


def covariance(c: int, *, rank: int | None = None, decay: float = 2.0, scale: float = 1.0, seed: int = 0) -> torch.Tensor:
    g = torch.Generator().manual_seed(seed)
    q, _ = torch.linalg.qr(torch.randn(c, c, generator=g, dtype=torch.float64))
    value = torch.logspace(0, -decay, c, dtype=torch.float64)
    value[c if rank is None else rank :] = 0
    return scale * (q * value) @ q.T


def with_ridge(c: torch.Tensor) -> torch.Tensor:
    return c + 1e-4 * c.diagonal().mean() * torch.eye(len(c), dtype=c.dtype)


@settings(max_examples=15, deadline=None)
@given(st.integers(1, 24), st.integers(0, 24), st.integers(0, 24), st.sampled_from([1e-4, 1.0, 1e4]), st.integers(0, 99))
def test_the_map_carries_one_covariance_to_the_other_at_any_rank(c: int, ra: int, rb: int, scale: float, seed: int) -> None:
    content = covariance(c, rank=min(ra, c), decay=4.0, seed=seed)
    style = covariance(c, rank=min(rb, c), decay=3.0, scale=scale, seed=seed + 1)
    t = monge(content, style, gain=1e300)
    assert bool(t.isfinite().all())
    assert torch.equal(t, t.mT)
    assert float(torch.linalg.eigvalsh(t)[0]) >= -1e-9 * float(t.abs().max())
    if ra and rb:
        reached, aim = t @ with_ridge(content) @ t, with_ridge(style)
        assert float((reached - aim).abs().max() / aim.abs().max()) < 1e-8


@pytest.mark.parametrize(("c", "rank"), [(1, 1), (7, 0), (7, 1), (64, 3), (128, 128)])
def test_equal_covariances_give_the_identity(c: int, rank: int) -> None:
    a = covariance(c, rank=rank, decay=8.0)
    torch.testing.assert_close(monge(a, a, gain=1.0 + 1e-6), torch.eye(c).double(), rtol=0.0, atol=1e-9)


def test_gain_is_capped_where_the_scene_is_flat() -> None:
    flat, lively = torch.zeros(5, 5), torch.eye(5)
    torch.testing.assert_close(monge(flat, lively, gain=8.0), 8.0 * torch.eye(5).double(), rtol=1e-9, atol=1e-9)
    assert float(monge(lively, flat, gain=8.0).abs().max()) < 1e-6


def test_batches_equal_single_maps() -> None:
    a, b = (torch.stack([covariance(6, seed=s + i) for i in range(3)]) for s in (0, 10))
    both = monge(a, b, gain=8.0)
    for k in range(3):
        torch.testing.assert_close(both[k], monge(a[k], b[k], gain=8.0), rtol=1e-9, atol=1e-11)


def test_the_cap_is_for_what_is_above_it() -> None:
    t = torch.diag(torch.tensor([10.0, 3.0, 0.5, 0.0], dtype=torch.float64))
    found = limit_gain(t, 3.0)
    torch.testing.assert_close(found, torch.diag(torch.tensor([3.0, 3.0, 0.5, 0.0], dtype=torch.float64)))
    below = torch.diag(torch.tensor([3.0, 1.0, -1e-9], dtype=torch.float64))
    assert torch.equal(limit_gain(below, 3.0), below), "bit for bit where nothing is above"


def test_an_eigenvalue_that_rounding_made_negative_is_none() -> None:
    root = symmetric_root(torch.diag(torch.tensor([4.0, 1.0, -1e-12], dtype=torch.float64)))
    torch.testing.assert_close(root, torch.diag(torch.tensor([2.0, 1.0, 0.0], dtype=torch.float64)))
