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
from fprf.ops.dense import network, runs

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
