"""Small networks and vector exponentials: the compiled forms against fp64 at the documented bounds."""

import itertools
from collections.abc import Sequence

import numba
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from torch import Tensor

from fprf.ops import backend
from fprf.ops.dense import network, runs, usable_in_training

QUICK = settings(max_examples=25, deadline=None)
U = 2.0**-24
"""Unit round-off of float32."""


def draw(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def layers_of(
    sizes: Sequence[int], seed: int = 0, biased: bool = True
) -> tuple[list[Tensor], list[Tensor | None]]:
    weights = [draw(o, i, seed=seed + k) / i**0.5 for k, (i, o) in enumerate(itertools.pairwise(sizes))]
    biases = [draw(o, seed=seed + 50 + k) if biased else None for k, o in enumerate(sizes[1:])]
    return weights, biases


def oracle(
    x: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor | None],
    shared: Tensor | None = None,
    row: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Values in fp64 and a bound of the error: (I + 3) u of each layer's magnitudes, carried through the next
    ones.
    """
    value = x.double() if shared is None else torch.cat([x, shared[row]], 1).double()
    error = torch.zeros_like(value)
    for k, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        value = value.relu() if k > 0 else value
        size = value.abs() @ weight.double().abs().T
        error = error @ weight.double().abs().T
        value = value @ weight.double().T
        if bias is not None:
            value = value + bias.double()
            size = size + bias.double().abs()
        error = error + (weight.shape[1] + 3) * U * size
    return value, error


def check(found: Tensor, value: Tensor, bound: Tensor) -> None:
    assert found.dtype == torch.float32 and found.shape == value.shape
    assert ((found.double() - value).abs() <= bound + 1e-30).all()


@QUICK
@given(
    st.lists(st.integers(1, 70), min_size=2, max_size=4),
    st.integers(1, 60),
    st.booleans(),
    st.integers(0, 99),
)
@example([64, 200, 17], 101, True, 0)
@example([80, 64, 48], 101, True, 0)
@example([1, 1, 1, 1], 101, True, 0)
def test_both_forms_stay_within_the_bound(sizes: list[int], count: int, biased: bool, seed: int) -> None:
    weights, biases = layers_of(sizes, seed, biased)
    x = draw(count, sizes[0], seed=seed + 7)
    value, bound = oracle(x, weights, biases)
    with torch.no_grad():
        for form in (network, backend.plain()(network)):
            check(form(x, weights, biases), value, bound)


@torch.no_grad()
@pytest.mark.parametrize("hidden", [16, 21])
def test_some_inputs_are_shared_by_several_points(hidden: int) -> None:
    weights, biases = layers_of((15, hidden, 5))
    x = draw(130, 12)
    shared = draw(9, 3, seed=3)
    row = torch.randint(9, (130,), generator=torch.Generator().manual_seed(1))
    value, bound = oracle(x, weights, biases, shared, row)
    for form in (network, backend.plain()(network)):
        check(form(x, weights, biases, shared=shared, row=row), value, bound)


@torch.no_grad()
@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="one thread only: nothing to compare")
def test_one_thread_and_two_give_the_same_bits() -> None:
    weights, biases = layers_of((24, 40, 7))
    x = draw(5000, 24)
    results = []
    for count in (1, 2):
        numba.set_num_threads(count)
        results.append(network(x, weights, biases))
    assert torch.equal(*results)


@QUICK
@given(st.lists(st.sampled_from([0.0, 1.0, -0.0, float("nan")]), max_size=30))
def test_runs_of_equal_rows(values: list[float]) -> None:
    """-0 equals 0, and a NaN equals nothing. Where nothing is compiled each row stands for itself."""
    x = torch.tensor([[v, 2.0] for v in values]).view(-1, 2)
    first, run = runs(x)
    assert run.shape == (len(x),) and len(first) == (int(run[-1]) + 1 if len(x) else 0)
    assert all(torch.equal(each, torch.arange(len(x))) for each in runs(x.double()))
    assert torch.equal(x[first][run].nan_to_num(7.0), x.nan_to_num(7.0))
    assert all(not torch.equal(x[a - 1], x[a]) for a in first.tolist() if a > 0)


@pytest.mark.parametrize(
    ("sizes", "shared", "count", "biased"),
    [
        ((80, 64, 48), 16, 2001, False),
        ((48, 128, 3), 0, 500, True),
        ((12, 21, 5), 3, 101, True),
        ((64, 32), 0, 7, True),
    ],
)
def test_what_learns_has_the_gradients_of_float64(
    sizes: tuple[int, ...], shared: int, count: int, biased: bool
) -> None:
    """Of inputs, of what points share, of weights and of biases, in both forms."""
    weights, biases = layers_of(sizes, biased=biased)
    x = draw(count, sizes[0] - shared)
    side = draw(9, shared, seed=3)
    row = torch.arange(count) * 9 // count
    grad = draw(count, sizes[-1], seed=4)

    def learnt(dtype: torch.dtype) -> list[Tensor]:
        leaves = [
            t.to(dtype).requires_grad_() for t in (x, side, *weights, *(b for b in biases if b is not None))
        ]
        maps = leaves[2 : 2 + len(weights)]
        shifts = leaves[2 + len(weights) :] if biased else [None] * len(weights)
        given = {"shared": leaves[1], "row": row} if shared else {}
        found = network(leaves[0], maps, shifts, **given)
        wanted = leaves if shared else [leaves[0], *leaves[2:]]
        return [found.detach(), *torch.autograd.grad(found, wanted, grad.to(dtype))]

    exact = learnt(torch.float64)
    assert usable_in_training(x, *weights)
    for form in (learnt, backend.plain()(learnt)):
        for found, value in zip(form(torch.float32), exact, strict=True):
            assert found.dtype == torch.float32
            # A sum of n terms errs by n u of their magnitudes at most, by its root commonly; gates of ReLU
            # that round to the other side are few.
            assert (found.double() - value).norm() <= 2 * (count + sizes[0]) ** 0.5 * U * len(
                sizes
            ) * value.norm()


def test_only_what_learns_gets_gradients() -> None:
    weights, biases = layers_of((16, 32, 3))
    x = draw(40, 16).requires_grad_()
    network(x, weights, biases).sum().backward()
    assert x.grad is not None and all(w.grad is None for w in weights)
    still = draw(40, 16)
    weights[1].requires_grad_()
    network(still, weights, biases).sum().backward()
    assert weights[1].grad is not None and weights[0].grad is None
