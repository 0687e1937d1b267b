"""Tri-plane lookup and its slopes in points: fused and plain forms against fp64; gradients:
`test_operator_table.py`.
"""

import importlib.util
import itertools
import sys
from collections.abc import Callable, Sequence
from importlib.machinery import ModuleSpec
from types import ModuleType

import numba
import pytest
import torch
from pretend_cuda import CUDA, pretend_cuda
from torch import Tensor

from fprf.ops import triplane
from fprf.ops.triplane import lookup, lookup_reference, rows, triton_usable, usable, variation

Form = Callable[[Tensor, Tensor, Sequence[int]], Tensor]
U = 2.0**-24
"""Unit round-off of float32."""


def table_of(resolutions: Sequence[int], channels: int, seed: int = 0, smooth: bool = False) -> Tensor:
    draw = torch.Generator().manual_seed(seed)
    low, high = (0.999, 1.001) if smooth else (-1.0, 1.0)
    return torch.empty(rows(resolutions), channels).uniform_(low, high, generator=draw)


def points_of(count: int, seed: int = 0) -> Tensor:
    return torch.empty(count, 3).uniform_(-1, 1, generator=torch.Generator().manual_seed(seed))


@pytest.fixture(params=["cpu", pytest.param("cuda:0", marks=pytest.mark.gpu)])
def device(request: pytest.FixtureRequest) -> torch.device:
    """Where tables are: numba's kernels take them, or Triton's."""
    if request.param != "cpu" and not torch.cuda.is_available():
        pytest.skip("torch sees no CUDA device")
    return torch.device(request.param)


@pytest.mark.parametrize(
    ("resolutions", "channels"), [((64, 181), 8), ((182,), 16), ((5, 33, 2), 24), ((1024,), 8), ((7, 182), 5)]
)
@pytest.mark.parametrize("smooth", [False, True])
def test_both_forms_stay_within_the_bound(
    resolutions: tuple[int, ...], channels: int, smooth: bool, device: torch.device
) -> None:
    table = table_of(resolutions, channels, smooth=smooth).to(device)
    points = (points_of(30) * 256).round().to(device) / 256
    assert (
        triton_usable(points, table)
        if device.type == "cuda"
        else usable(points, table) == (channels % 8 == 0)
    )
    value = lookup_reference(points.double(), table.double(), resolutions)
    for form in (lookup, lookup_reference):
        found = form(points, table, resolutions)
        assert found.dtype == torch.float32 and found.shape == (30, len(resolutions) * channels)
        assert ((found.double() - value).abs() <= 32 * U).all()


WILD = (float("nan"), float("inf"), -float("inf"), 1e30, -1e30, 1.0 + 2e-7, -1.0 - 2e-7, 1.0, -1.0, 0.3)


@pytest.mark.parametrize("channels", [5, 8, 16])
@pytest.mark.parametrize("size", [2, 3, 182])
def test_no_coordinate_leaves_the_table(channels: int, size: int, device: torch.device) -> None:
    """The table lies between sentinels: forward never reads them, backward never writes them. NaN is the
    lower border.
    """
    points = torch.tensor(list(itertools.product(WILD, repeat=3)), device=device)
    total = rows((size,))
    padded = torch.full((total + 2 * size * size, channels), float("nan"), device=device)
    table = padded[size * size : size * size + total]
    table.copy_(table_of((size,), channels))
    table.requires_grad_(True)
    tame = points.nan_to_num(nan=-1.0).clamp(-1, 1)
    for form in (lookup, lookup_reference):
        found = form(points, table, (size,))
        assert found.isfinite().all()
        assert torch.equal(found, form(tame, table, (size,)))
        (gradient,) = torch.autograd.grad(found.sum(), table)
        assert gradient.shape == table.shape and gradient.isfinite().all()
    assert padded[: size * size].isnan().all() and padded[size * size + total :].isnan().all()


@pytest.mark.parametrize("resolutions", [(2,), (3, 5)])
def test_the_plain_form_differentiates(resolutions: tuple[int, ...]) -> None:
    table = table_of(resolutions, 2).double().requires_grad_(True)
    points = (0.37 * points_in_cells(6, 9)).double().requires_grad_(True)
    assert torch.autograd.gradcheck(lambda p, t: lookup(p, t, resolutions), (points, table))
    assert torch.autograd.gradcheck(lambda t: variation(t, resolutions), (table,))


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="one thread only: nothing to compare")
def test_one_thread_and_two_give_the_same_bits() -> None:
    resolutions = (16, 64, 182)
    table = table_of(resolutions, 24).requires_grad_(True)
    points = points_of(4001)
    results = []
    for count in (1, 2, 2):
        numba.set_num_threads(count)
        found = lookup(points, table, resolutions)
        (gradient,) = torch.autograd.grad(found.square().sum(), table)
        results.append((found, gradient))
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_held_gradients_are_added_by_kernels_and_cleared() -> None:
    resolutions = (257, 5)
    table = table_of(resolutions, 8).requires_grad_()
    points = points_in_cells(500, 257)
    held = triplane.held(table)
    assert held is not None and triplane.held(table_of((5,), 8)) is None
    wide = table.detach().double().requires_grad_()
    exact = lookup_reference(points.double(), wide, resolutions).square().sum()
    (exact + 3 * triplane.variation_reference(wide, resolutions)).backward()  # type: ignore[no-untyped-call]
    assert wide.grad is not None
    for _ in range(2):
        found = lookup(points, table, resolutions, held).square().sum()
        (found + 3 * variation(table, resolutions, held)).backward()  # type: ignore[no-untyped-call]
        assert table.grad is not None and table.grad is held.gradient()
        # Of a few points and four neighbours each number has a few terms.
        assert (table.grad.double() - wide.grad).norm() <= 16 * U * wide.grad.norm()
        # Plain forms add to the same memory.
        lookup_reference(points, table, resolutions).square().sum().backward()  # type: ignore[no-untyped-call]
        assert table.grad is held.gradient()
        held.clear()
        assert table.grad is None and not held.gradient().any()
        held.clear()


def points_in_cells(count: int, resolution: int, seed: int = 0) -> Tensor:
    """Inside of cells, at a quarter, half or three quarters of them: exact in float32 where cells are a power
    of two.
    """
    draw = torch.Generator().manual_seed(seed)
    cell = torch.randint(resolution - 1, (count, 3), generator=draw)
    share = torch.randint(1, 4, (count, 3), generator=draw) / 4
    return (cell + share) * (2 / (resolution - 1)) - 1


def slopes(form: Form, points: Tensor, table: Tensor, resolutions: tuple[int, ...], grad: Tensor) -> Tensor:
    """Gradient of the points for one of the features."""
    given = points.clone().requires_grad_()
    return torch.autograd.grad(form(given, table, resolutions), given, grad)[0]


@pytest.mark.parametrize(
    ("resolutions", "channels", "count"), [((9,), 8, 1), ((65,), 16, 500), ((17, 9), 24, 97), ((5, 3), 40, 0)]
)
def test_slopes_of_points_are_those_of_the_plain_form(
    resolutions: tuple[int, ...], channels: int, count: int, device: torch.device
) -> None:
    points = points_in_cells(count, resolutions[0]).to(device)
    table = table_of(resolutions, channels).to(device)
    grad = torch.randn(count, len(resolutions) * channels, generator=torch.Generator().manual_seed(3)).to(
        device
    )
    exact = slopes(lookup_reference, points.double(), table.double(), resolutions, grad.double())
    found = slopes(lookup, points, table, resolutions, grad)
    assert usable(points, table) or triton_usable(points, table)
    assert found.dtype == torch.float32 and found.shape == (count, 3)
    # At quarters of a cell; what is left are the roundings of sums over channels and scales.
    assert (found.double() - exact).norm() <= 1e-5 * exact.norm()


@pytest.mark.parametrize("place", [1.5, -1.5, float("nan"), float("inf"), 1e30])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_outside_the_border_holds(place: float, axis: int) -> None:
    """No slope along the axis that a point has left, and those of the border along the others."""
    table = table_of((5,), 8)
    point = torch.tensor([[0.25, -0.375, 0.125]])
    point[0, axis] = place
    inside = point.clone()
    inside[0, axis] = 1.0 if place > 0 else -1.0
    grad = torch.randn(1, 8, generator=torch.Generator().manual_seed(2))
    wanted = slopes(lookup_reference, inside, table, (5,), grad)
    wanted[0, axis] = 0
    for form in (lookup, lookup_reference):
        assert torch.allclose(slopes(form, point, table, (5,), grad), wanted, atol=1e-5)


def test_where_triton_cannot_compile_the_plain_form_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is tried once, and said once."""
    tried = []

    def forward(points: Tensor, table: Tensor, resolutions: Sequence[int]) -> Tensor:
        tried.append(points.device)
        raise RuntimeError("no C compiler\nwas found")

    kernels = ModuleType("triplane_triton")
    kernels.forward = forward  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "fprf.ops.triplane_triton", kernels)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: ModuleSpec(name, None))
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    triplane._compiles.cache_clear()
    try:
        with pretend_cuda():
            points = torch.zeros(3, 3).to(CUDA)
            table = torch.zeros(12, 8).to(CUDA)
            with pytest.warns(
                UserWarning, match=r"cuda:0 \(RuntimeError: no C compiler\): tri-planes run in plain torch"
            ):
                assert not triton_usable(points, table)
            assert not triton_usable(points, table) and tried == [CUDA]
    finally:
        triplane._compiles.cache_clear()
