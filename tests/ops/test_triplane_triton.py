"""The Triton form of the tri-planes against fp64: on a GPU where there is one, else through Triton's interpreter."""

import importlib
import importlib.util
import itertools
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence

import pytest
import torch
from pretend_cuda import CUDA, pretend_cuda
from test_triplane import WILD, U, points_of, table_of
from torch import Tensor

from fprf.ops import triplane_triton
from fprf.ops.triplane import lookup, lookup_reference, rows

pytestmark = pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="triton is not installed")
GPU = torch.cuda.is_available()
DEVICE = torch.device("cuda" if GPU else "cpu")


if not GPU and importlib.util.find_spec("triton") is not None:
    # Triton's own functions and ours are interpreted or not from the moment they are loaded: at collection, before any test
    # runs that has torch or transformers load Triton.
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TRITON_INTERPRET", "1")
        importlib.import_module("fprf.ops.triplane_triton_kernels")


@pytest.fixture(autouse=True)
def _form(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    if not GPU:
        monkeypatch.setenv("TRITON_INTERPRET", "1")
    yield


@pytest.mark.parametrize(("size", "channels"), [(2, 5), (182, 8)])
def test_no_coordinate_leaves_the_table(size: int, channels: int) -> None:
    """The table lies between sentinels: forward never reads them, backward never writes them. NaN is the lower border."""
    points = torch.tensor(list(itertools.product(WILD, repeat=3)), device=DEVICE)
    tame = points.nan_to_num(nan=-1.0).clamp(-1, 1)
    total, edge = rows((size,)), 2 * size
    padded = torch.full((total + 2 * edge, channels), float("nan"), device=DEVICE)
    table = padded[edge : edge + total]
    table.copy_(table_of((size,), channels))
    table.requires_grad_(True)
    found = lookup(points, table, (size,))
    assert found.isfinite().all() and torch.equal(found, lookup(tame, table, (size,)))
    (gradient,) = torch.autograd.grad(found.sum(), table)
    assert gradient.shape == table.shape and gradient.isfinite().all()
    assert padded[:edge].isnan().all() and padded[edge + total :].isnan().all()


def test_half_tables_are_for_those_who_do_not_learn() -> None:
    """What is stored in half is rounded, and nothing else: the arithmetic is that of the rounded table in float32."""
    resolutions, points = (16, 64), points_of(300).to(DEVICE)
    table = table_of(resolutions, 16).to(DEVICE)
    half = table.half()
    assert not triplane_triton.usable(points, half.clone().requires_grad_(True))
    assert triplane_triton.usable(points, half) and not triplane_triton.usable(points.half(), half)
    assert not triplane_triton.usable(points, table.bfloat16())
    found = lookup(points, half, resolutions)
    assert found.dtype == torch.float32
    assert torch.equal(found, lookup(points, half.float(), resolutions))
    exact = lookup(points, table, resolutions)
    assert 1e-5 * exact.norm() < (found - exact).norm() <= 5e-4 * exact.norm()


@pytest.fixture
def accelerator() -> Iterator[torch.device]:
    """A CUDA device: this machine's, or a pretended one whose kernels are interpreted."""
    if GPU:
        yield DEVICE
    else:
        with pretend_cuda(triton=True):
            yield CUDA


@pytest.mark.parametrize(
    ("resolutions", "channels", "count"), [((64, 256), 32, 67), ((5, 33, 2), 24, 130), ((182,), 8, 300), ((3, 7), 5, 2)]
)
def test_values_and_gradients_are_those_of_fp64(
    accelerator: torch.device, resolutions: tuple[int, ...], channels: int, count: int
) -> None:
    """Through the dispatch of a CUDA tensor. Points outside count as the border's, NaN as the lower one; nothing is added to
    nodes that no point touches.

    Coordinates are exact (multiples of 5/1024). A sample of values in [-1, 1] takes 6 roundings, a product of three 20, each
    gradient of a node less than 32 for each of the points that touch it, and its sum one for each of them.
    """
    drawn = torch.Generator().manual_seed(1)
    here = (points_of(count) * 256).round() * (1.25 / 256)
    here[0], here[1] = torch.tensor([float("nan"), 0.5, -0.25]), torch.tensor([float("inf"), -2.0, 1.0])
    tame = here.nan_to_num(nan=-1.0).clamp(-1, 1).double()
    table = table_of(resolutions, channels)
    weight = torch.randn(count, len(resolutions) * channels, generator=drawn)
    wide = table.double().requires_grad_(True)
    features = lookup_reference(tame, wide, resolutions)
    (exact,) = torch.autograd.grad((features * weight).sum(), wide)
    points, learned = here.to(accelerator), table.to(accelerator)
    assert points.is_cuda and triplane_triton.usable(points, learned)
    learned.requires_grad_(True)
    found = lookup(points, learned, resolutions)
    assert found.dtype == torch.float32 and "Lookup" in type(found.grad_fn).__name__
    gradient = torch.autograd.grad((found * weight.to(accelerator)).sum(), learned)[0].cpu()
    error = gradient.double() - exact
    assert ((found.detach().cpu().double() - features).abs() <= 20 * U).all()
    assert error.abs().amax() <= (32 + count) * U * count * weight.abs().amax()
    assert error.norm() <= 1e-6 * exact.norm() and not gradient[exact == 0].any()


def test_without_a_compiler_the_plain_form_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is tried once, and said once."""
    usable, tried = triplane_triton.usable, []

    def forward(points: Tensor, table: Tensor, resolutions: Sequence[int]) -> Tensor:
        tried.append(points.device)
        raise RuntimeError("Failed to find C compiler.")

    monkeypatch.setattr(triplane_triton, "interpreted", lambda: False)
    monkeypatch.setattr(triplane_triton, "forward", forward)
    triplane_triton._launches.cache_clear()
    try:
        with pretend_cuda():
            points, table = torch.zeros(3, 3).to(CUDA), torch.zeros(12, 8).to(CUDA)
            with pytest.warns(UserWarning, match=r"cuda:0 \(RuntimeError: Failed to find C compiler.\)"):
                assert not usable(points, table)
            assert not usable(points, table)
    finally:
        triplane_triton._launches.cache_clear()
    assert tried == [CUDA]


COMPILE = """
import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource
from fprf.ops import triplane_triton_kernels as kernels

def build(kernel, capability, **constants):
    names = kernel.arg_names
    numbers = {"count": "i64"} | dict.fromkeys(constants, "constexpr")
    kinds = {name: numbers.get(name, "*fp32") for name in names}
    source = ASTSource(fn=kernel, signature=kinds, constexprs=constants)
    target, options = GPUTarget("cuda", capability, 32), {"num_warps": 4, "enable_fp_fusion": True}
    return triton.compile(source, target=target, options=options).asm

shape = dict(SIZES=(64, 512), CHANNELS=24, LANES=32, BLOCK=64)
assert "ld.global" in build(kernels.forward, 90, **shape)["ptx"]
for capability in (80, 90):
    made = build(kernels.backward, capability, **shape)
    assert ("atom" in made["ptx"] or "red." in made["ptx"]) and made["cubin"]
"""


def test_kernels_compile_for_a_gpu() -> None:
    """To machine code, on any machine: the interpreter takes more than the compiler does."""
    packages = os.environ.get("PYTHONPATH", "")
    environment = {"PATH": "/usr/bin:/bin", "HOME": "/tmp", "NUMBA_DISABLE_JIT": "1", "PYTHONPATH": packages}
    done = subprocess.run([sys.executable, "-c", COMPILE], capture_output=True, text=True, env=environment, timeout=120)
    assert done.returncode == 0, done.stderr[-2000:]
