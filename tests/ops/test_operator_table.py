"""Mathematical functions of ops, style and rendering: no rows, one, an odd number, as many as in production; float32
against float64 in values and gradients; nothing written to its inputs.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from operator_cases import CASES, Case
from torch import Tensor


def cast(made: list[Tensor], dtype: torch.dtype) -> list[Tensor]:
    return [x.to(dtype) if x.is_floating_point() else x for x in made]


def outputs(found: object) -> list[Tensor]:
    if isinstance(found, Tensor):
        return [found]
    assert isinstance(found, tuple)
    return [x for each in found for x in outputs(each)]


def check_close(case: Case, found: Tensor, exact: Tensor) -> None:
    assert found.shape == exact.shape
    if not exact.numel():
        return
    assert bool(torch.isfinite(found).all()) or not bool(torch.isfinite(exact).all())
    if not exact.is_floating_point():
        assert float((found != exact).double().mean()) <= case.slack
        return
    apart = (found.double() - exact).abs()
    off = ~(apart <= case.tolerance * exact.abs().amax().clamp_min(1e-30))
    assert float(off.double().mean()) <= case.slack, f"{float(apart.max()):.3g}"


ROWS = [pytest.param(case, n, id=f"{case.name}-{n}") for case in CASES for n in case.sizes]


@pytest.mark.parametrize(("case", "n"), ROWS)
def test_values_are_those_of_float64_and_inputs_stay(case: Case, n: int) -> None:
    given = cast(list(case.make(n)), torch.float32)
    before = [x.clone() for x in given]
    found = outputs(case.call(*given))
    exact = outputs(case.call(*cast(before, torch.float64)))
    assert all(torch.equal(a, b) for a, b in zip(given, before, strict=True))
    for one, other in zip(found, exact, strict=True):
        check_close(case, one, other)


@pytest.mark.parametrize(("case", "n"), [row for row in ROWS if row.values[0].slopes])
def test_gradients_are_those_of_float64(case: Case, n: int) -> None:
    """Elementwise, relative L2, cosine and signed bias."""
    made = cast(list(case.make(n)), torch.float32)
    slopes = []
    for dtype in (torch.float32, torch.float64):
        given = cast(made, dtype)
        for k in case.slopes:
            given[k] = given[k].detach().requires_grad_(True)
        out = [x for x in outputs(case.call(*given)) if x.requires_grad]
        draws = [torch.rand(x.shape, generator=torch.Generator().manual_seed(k)) - 0.3 for k, x in enumerate(out)]
        torch.autograd.backward([(x * w.to(dtype)).sum() for x, w in zip(out, draws, strict=True)])
        slopes.append([given[k].grad for k in case.slopes])
    for a, b in zip(*slopes, strict=True):
        assert a is not None and b is not None and a.shape == b.shape
        assert bool(torch.isfinite(a).all())
        if not b.numel() or float(b.norm()) == 0:
            assert float(a.norm()) == 0
            continue
        apart, size = a.double() - b, b.norm()
        assert float(apart.abs().max()) <= 1e-3 * float(b.abs().max())
        assert float(apart.norm()) <= 1e-4 * float(size)
        assert float((a.double() * b).sum() / (a.double().norm() * size)) >= 1 - 1e-7
        assert abs(float(apart.mean())) <= 1e-4 * float(b.abs().mean())


NETWORKS = ("dense.network", "dense.network, plain")
"""What somebody who asks for autocast wants to be lowered."""


@pytest.mark.parametrize("case", [pytest.param(case, id=case.name) for case in CASES if case.name not in NETWORKS])
def test_autocast_does_not_lower_the_precision(case: Case) -> None:
    given = cast(list(case.make(37)), torch.float32)
    usual = outputs(case.call(*given))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = outputs(case.call(*given))
    exact = outputs(case.call(*cast(given, torch.float64)))
    for one, plain, other in zip(found, usual, exact, strict=True):
        assert one.dtype == plain.dtype
        check_close(case, one, other)


HERE = Path(__file__).parent
KERNELS = ("dense", "guided", "rasterise", "triplane")


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_no_index_leaves_its_array(tmp_path: Path) -> None:
    files = [str(HERE / f"test_{name}.py") for name in KERNELS]
    settings = {"NUMBA_BOUNDSCHECK": "1", "NUMBA_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *files]
    done = subprocess.run(command, env=os.environ | settings, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-3000:]
    assert any(tmp_path.rglob("*.nbc")), "compiled anew, with the checks"
