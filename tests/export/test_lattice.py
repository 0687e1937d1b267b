import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fprf.export.lut import apply_lattice, fit_lattice, identity

FEW = settings(deadline=None, max_examples=15)
seeds = st.integers(0, 2**31)


def drawn(seed: int, *shape: int) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@FEW
@given(seed=seeds, size=st.integers(2, 9))
def test_a_table_is_applied_trilinearly(seed: int, size: int) -> None:
    """Exact for what is linear in each colour, and at the nodes for anything."""
    table, colour = drawn(seed, size, size, size, 3), drawn(seed + 1, 50, 3)
    nodes = identity(size)
    assert torch.allclose(apply_lattice(table, nodes.view(-1, 3)).view_as(table), table, atol=1e-12)
    assert torch.allclose(apply_lattice(nodes, colour), colour, atol=1e-12)
    product = nodes.prod(-1, keepdim=True).expand(-1, -1, -1, 3)
    if size == 2:
        assert torch.allclose(apply_lattice(product, colour), colour.prod(-1, keepdim=True).expand(-1, 3), atol=1e-12)
    assert torch.allclose(apply_lattice(nodes, 3 * colour - 1), (3 * colour - 1).clamp(0, 1), atol=1e-12)


@FEW
@given(seed=seeds, size=st.sampled_from([5, 9, 17]))
def test_no_change_is_the_identity(seed: int, size: int) -> None:
    colour = drawn(seed, 300, 3)
    assert torch.equal(fit_lattice(colour, colour, torch.ones(300), size), identity(size))
    assert torch.equal(fit_lattice(colour, 1 - colour, torch.zeros(300), size), identity(size))


def test_a_linear_map_is_found_where_there_are_colours_and_fades_where_there_are_none() -> None:
    colour = 0.2 + 0.3 * drawn(0, 20000, 3)
    matrix = torch.eye(3, dtype=torch.float64) + 0.3 * (drawn(1, 3, 3) - 0.5)
    target = (colour - 0.35) @ matrix.T + torch.tensor([0.4, 0.5, 0.3], dtype=torch.float64)
    table = fit_lattice(colour, target, torch.ones(20000), 17)
    left = (apply_lattice(table, colour) - target).square().mean().sqrt()
    assert float(left) < 0.05 * float((target - colour).square().mean().sqrt())
    moved = (table - identity(17)).norm(dim=-1)
    assert float(moved[16, 16, 16]) < 0.25 * float(moved.amax())
    assert float(table.amin()) >= 0 and float(table.amax()) <= 1


def test_a_single_colour_moves_its_surroundings_along() -> None:
    """What decays from a point of the lattice: monotonic along an axis, alike in all directions."""
    grey = torch.full((1, 3), 0.5, dtype=torch.float64)
    table = fit_lattice(grey, grey + 0.2, torch.ones(1), 9)
    moved = (table - identity(9))[..., 0]
    assert float(moved[4, 4, 4]) == pytest.approx(0.2, rel=0.05)
    assert bool((moved[4:, 4, 4].diff() < 0).all())
    inner = moved[1:-1, 1:-1, 1:-1]  # at the faces colours cannot leave the range
    assert torch.allclose(inner, inner.permute(2, 0, 1), atol=1e-6) and torch.allclose(inner, inner.flip(0), atol=1e-6)


def test_weights_decide_between_contradicting_pairs() -> None:
    grey = torch.full((2, 3), 0.5, dtype=torch.float64)
    target = torch.tensor([[0.3] * 3, [0.7] * 3], dtype=torch.float64)
    table = fit_lattice(grey, target, torch.tensor([3.0, 1.0]), 5)
    assert float(apply_lattice(table, grey[:1])[0, 0]) == pytest.approx(0.4, abs=0.01)


def test_finer_tables_agree_with_coarser_ones() -> None:
    """The smoothness is that of the colour cube, not of the lattice."""
    colour = 0.3 + 0.4 * drawn(0, 5000, 3)
    target = colour.square()
    coarse, fine = (fit_lattice(colour, target, torch.ones(5000), size) for size in (9, 33))
    probe = 0.3 + 0.4 * drawn(1, 500, 3)
    assert float((apply_lattice(coarse, probe) - apply_lattice(fine, probe)).abs().mean()) < 0.01


def test_it_minimises_what_it_says() -> None:
    """No neighbouring table has a smaller energy (float64, brute force over the formula)."""
    colour, move = drawn(0, 40, 3), 0.2 * (drawn(1, 40, 3) - 0.5)
    size, smooth, reach = 4, 1e-3, 0.25
    table = fit_lattice(colour, colour + move, torch.ones(40), size)

    def energy(table: torch.Tensor) -> float:
        d, h = table - identity(size), 1 / (size - 1)
        bend = sum(d.diff(dim=axis).square().sum() for axis in range(3)) * h
        data = (apply_lattice(table, colour) - colour - move).square().sum(-1).mean()
        return float(data + smooth * (bend + d.square().sum() * h**3 / reach**2))

    best = energy(table)
    inner = (table > 1e-3) & (table < 1 - 1e-3)  # elsewhere the range binds
    for seed in range(30):
        change = 1e-2 * (drawn(seed + 2, size, size, size, 3) - 0.5) * inner
        assert energy(table + change) > best - 2e-5, "pairs of one small cell count at their mean"
