"""Mathematical functions of ops, style and rendering: no rows, one, an odd number, as many as in production;
float32 against float64 in values and gradients; nothing written to its inputs, nor beside its arrays.

A case makes its inputs in float64 from a number of rows; a function that works on one matrix has a number of
rows that is its side.
"""

import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from fprf.ops import backend, dense, guided, triplane
from fprf.rendering import cameras, lens, space, splines, stepfun
from fprf.rendering.lens import lens_reach
from fprf.style import dictionary, light, look, matching, scene_style, statistics

Made = Sequence[Tensor]
EYE = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


class Case(NamedTuple):
    """A function, inputs of n rows, and what is promised."""

    name: str
    make: Callable[[int], Made]
    call: Callable[..., object]
    tolerance: float = 1e-5
    """Of the largest value, float32 against float64."""
    slopes: tuple[int, ...] = ()
    """Inputs that have a gradient."""
    sizes: tuple[int, ...] = (0, 1, 37, 20_000)
    slack: float = 0.0
    """Share of the rows that may differ more: those that a threshold parts."""


def _draw(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(
        shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed + 7919 * sum(shape))
    )


def _unit(*shape: int, seed: int = 1) -> Tensor:
    return torch.rand(
        shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed + 7919 * sum(shape))
    )


def _edges(rays: int, steps: int, seed: int = 2) -> Tensor:
    """From 0 to 1, every step at least a tenth of the mean one."""
    steps_ = 0.1 + _unit(rays, steps, seed=seed)
    return torch.nn.functional.pad(steps_.cumsum(-1) / steps_.sum(-1, keepdim=True), (1, 0))


def _covariances(count: int, channels: int) -> Tensor:
    root = _draw(count, channels, channels)
    return root @ root.mT + 0.5 * torch.eye(channels, dtype=torch.float64)


def _planes(points: int) -> Made:
    return 2 * _unit(points, 3) - 1, 0.5 * _draw(triplane.rows((8, 16)), 16), 0.1 * _draw(32)


def _lenses(count: int) -> Made:
    bent = torch.tensor([0.1, -0.02, 0.003, -0.0004, 0.001, -0.002], dtype=torch.float64)
    return (bent.expand(count, 6).clone(), torch.arange(count) % 2, 0.6 * _draw(count, 2).clamp(-1, 1))


def _cameras(count: int) -> Made:
    rotation = splines.rotations(_quaternions(4))
    pose = torch.cat([rotation, _draw(4, 3, 1)], -1)
    return pose, torch.arange(count) % 4, 40 * _unit(count, 2)


def _through(pose: Tensor, view: Tensor, pixel: Tensor) -> object:
    return cameras.rays_through(_captured(pose), view, pixel.double())


def _captured(pose: Tensor) -> cameras.Cameras:
    return cameras.Cameras(
        pose=pose.double(),
        focal=torch.full((len(pose), 2), 30.0, dtype=torch.float64),
        centre=torch.full((len(pose), 2), 20.0, dtype=torch.float64),
        size=torch.full((len(pose), 2), 40),
        distortion=torch.zeros(len(pose), 6, dtype=torch.float64),
        lens=torch.zeros(len(pose), dtype=torch.int64),
    )


def _projected(pose: Tensor, view: Tensor, pixel: Tensor) -> object:
    origin, direction = cameras.rays_through(_captured(pose), view, pixel.double())
    return cameras.project(_captured(pose), view, origin + 3 * direction)


def _quaternions(count: int, seed: int = 3) -> Tensor:
    q = _draw(count, 4, seed=seed)
    q = q / q.norm(dim=-1, keepdim=True)
    return torch.where(q[:, :1] < 0, -q, q)


def _network(x: Tensor, *parts: Tensor) -> Tensor:
    return dense.network(x, parts[0::2], parts[1::2])


def _layers(points: int) -> Made:
    return _draw(points, 16), 0.3 * _draw(32, 16), _draw(32), 0.3 * _draw(5, 32), _draw(5)


def _spelt_out(x: Tensor) -> Tensor:
    first, run = dense.runs(x)
    return x[first][run]


def _shares(rows: int, kinds: int) -> Tensor:
    return torch.softmax(3 * _draw(rows, kinds), -1)


def _open(kind: space.Kind) -> space.Space:
    return space.Space(kind, (0.1, -0.2, 0.3), EYE, 1.5, 0.05, 50.0)


def _located(x: Tensor) -> Tensor:
    return space.contract(x)


def _moments(x: Tensor, w: Tensor) -> object:
    found = statistics.moments(x, w)
    return (*found, statistics.covariance(found), *statistics.merge(found, found))


def _code(t: int) -> Made:
    return _draw(t, 6), _covariances(t, 6), _unit(t) + 0.1


CASES = [
    Case("dense.network", _layers, _network, slopes=(0, 1, 2, 3, 4)),
    Case("dense.network, plain", _layers, backend.plain()(_network), slopes=(0, 1, 2, 3)),
    Case("dense.runs", lambda n: ((_unit(n, 2) * 2).floor(),), _spelt_out),
    Case("guided.coefficients", lambda n: (_draw(5, max(1, n // 3), n), _unit(n, n, 3)),
         lambda f, g: guided.coefficients(f, g, radius=2, eps=1e-3, stride=2), sizes=(1, 37, 96), tolerance=1e-4),
    Case("guided.upsample", lambda n: (_draw(5, max(1, n // 3), n), _unit(n, n, 3)),
         lambda f, g: guided.upsample(f, g, radius=2, eps=1e-3, stride=2), sizes=(1, 37, 96), tolerance=1e-4),
    Case("guided.apply", lambda n: (_draw(4, 5, 6, 4), 37 * _unit(n, 2), _unit(n, 3)),
         lambda c, p, rgb: guided.apply(c, p, rgb, (37, 37))),
    Case("space.distance", lambda n: (_edges(n, 21), _unit(n) + 0.05, 9 * _unit(n) + 2), _open("contraction").distance),
    Case("scene_style.mixed_maps", lambda n: (_draw(n, 16), _shares(n, 3), _draw(3, 16, 16), _draw(3, 16)),
         scene_style.mixed_maps, slopes=(0, 2, 3)),
    Case("triplane.lookup", _planes, lambda p, t, w: triplane.lookup(p, t, (8, 16)), slopes=(1,)),
    Case("triplane.lookup_reference", _planes, lambda p, t, w: triplane.lookup_reference(p, t, (8, 16)), slopes=(1,)),
    Case("triplane.variation", lambda n: (_draw(triplane.rows((n,)), 8),), lambda t: triplane.variation(t, (_side(t),)),
         slopes=(0,), sizes=(2, 3, 37, 128)),
    Case("matching.match_keys", lambda n: (_draw(n, 6), _unit(n) + 0.1, _draw(5, 6), _unit(5) + 0.1),
         lambda k, s, l, r: matching.match_keys(k, s, l, r, torch.ones(5), temperature=1.0), sizes=(1, 37, 500)),
    Case("matching.whitener", lambda n: (_draw(n, 6), _unit(n) + 0.1), lambda k, s: matching.whitener(k, s, 0.5),
         sizes=(1, 37, 500)),
    Case("statistics.kmeans", lambda n: (_draw(n, 4) + 20 * (_unit(n, 1) * 3).floor(),),
         lambda x: statistics.kmeans(x, 3, seed=0)),
    Case("light.luma", lambda n: (_unit(n, 3),), light.luma, slopes=(0,)),
    Case("look.keep_luminance", lambda n: (_unit(n, 3), _unit(n, 3, seed=5), _unit(n, 1)), look.keep_luminance),
    Case("dictionary.blend_codes", lambda n: (*_code(n), _draw(6), _covariances(1, 6)[0]),
         lambda m, c, b, w, v: dictionary.blend_codes(m, c, w, v, b.clamp(0, 1)), sizes=(0, 1, 37, 500)),
    Case("matching.unit", lambda n: (_draw(n, 8), _draw(8)), matching.unit, slopes=(0,)),
    Case("matching.share_mean", lambda n: (_draw(n, 8), _unit(n) + 0.1), matching.share_mean, sizes=(1, 37, 20_000)),
    Case("matching.scores", lambda n: (_draw(n, 8), _draw(7, 8)), matching.scores, slopes=(0, 1)),
    Case("matching.score_spread", lambda n: (_draw(n, 8), _draw(7, 8)),
         lambda q, k: torch.tensor(matching.score_spread(q, k), dtype=torch.float64)),
    Case("matching.attention", lambda n: (_draw(n, 8), _draw(7, 8), _unit(7) + 0.1),
         lambda q, k, p: matching.attention(q, k, 0.7, p), slopes=(0, 1)),
    Case("matching.point_shares", lambda n: (_draw(n, 8), _draw(7, 8), _draw(8, seed=6)),
         lambda q, k, c: matching.point_shares(q, k, 0.7, centre=c)),
    Case("statistics.moments", lambda n: (_draw(n, 6) + 100, _unit(n)), _moments),
    Case("statistics.group_moments", lambda n: (_draw(n, 6), _shares(n, 3)), statistics.group_moments),
    Case("statistics.mix", _code, statistics.mix, sizes=(1, 37, 500)),
    Case("statistics.deviation", lambda n: (_draw(n, 6), _unit(n, 6)), statistics.deviation),
    Case("statistics.symmetric_root", lambda n: (_covariances(n, 6),), statistics.symmetric_root, sizes=(0, 1, 37, 500)),
    Case("statistics.monge", lambda n: (_covariances(n, 6), _covariances(n, 6) + 1),
         lambda c, s: statistics.monge(c, s, gain=8.0), sizes=(0, 1, 37, 500), tolerance=1e-4),
    Case("cameras.rays_through", _cameras, _through),
    Case("cameras.project", _cameras, _projected),
    Case("lens.bend", _lenses,
         lambda d, kind, p: lens.bend(d, kind, lens_reach(d, kind), torch.nn.functional.pad(p, (0, 1), value=1.0))),
    Case("lens.unbend", _lenses, lambda d, kind, p: lens.unbend(d, kind, lens_reach(d, kind), p), tolerance=1e-4),
    Case("space.contract", lambda n: (3 * _draw(n, 3),), _located, slopes=(0,)),
    Case("splines.quaternions", lambda n: (splines.rotations(_quaternions(n)),), splines.quaternions, tolerance=1e-3),
    Case("splines.rotations", lambda n: (_quaternions(n),), splines.rotations),
    Case("splines.slerp", lambda n: (_quaternions(n), _quaternions(n, 4), _unit(n)), splines.slerp, tolerance=1e-4),
    Case("splines.catmull_rom", lambda n: (_draw(6, 3), torch.arange(n) % 5, _unit(n)), splines.catmull_rom),
    Case("stepfun.transmittance_weights", lambda n: (4 * _unit(n, 20), 3 * _edges(n, 20)), stepfun.transmittance_weights,
         slopes=(0,)),
    Case("stepfun.scale_gradient", lambda n: (_draw(n, 3), _unit(n, 1)), stepfun.scale_gradient),
    Case("stepfun.midpoints", lambda n: (_edges(n, 20),), stepfun.midpoints, slopes=(0,)),
    Case("stepfun.resample", lambda n: (_edges(n, 20), _unit(n, 20) + 0.1),
         lambda s, w: stepfun.resample(s, w, 16, padding=1e-3, generator=None)),
    Case("stepfun.interlevel", lambda n: (_edges(n, 12), _unit(n, 12), _edges(n, 20, 5), _unit(n, 20)), stepfun.interlevel,
         slopes=(3,), tolerance=1e-4),
    Case("stepfun.distortion", lambda n: (_edges(n, 20), _unit(n, 20)), stepfun.distortion, slopes=(1,)),
    Case("stepfun.keep_heaviest", lambda n: (_unit(n, 20) / 20,), lambda w: stepfun.keep_heaviest(w, 0.05), slack=1e-3),
]  # fmt: skip


def _side(table: Tensor) -> int:
    return round((len(table) / 3) ** 0.5)


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
        draws = [
            torch.rand(x.shape, generator=torch.Generator().manual_seed(k)) - 0.3 for k, x in enumerate(out)
        ]
        torch.autograd.backward([(x * w.to(dtype)).sum() for x, w in zip(out, draws, strict=True)])
        slopes.append([given[k].grad for k in case.slopes])
    for a, b in zip(*slopes, strict=True):
        assert a is not None and b is not None and a.shape == b.shape
        assert bool(torch.isfinite(a).all())
        if not b.numel() or float(b.norm()) == 0:
            assert float(a.norm()) == 0
            continue
        apart = a.double() - b
        size = b.norm()
        assert float(apart.abs().max()) <= 1e-3 * float(b.abs().max())
        assert float(apart.norm()) <= 1e-4 * float(size)
        assert float((a.double() * b).sum() / (a.double().norm() * size)) >= 1 - 1e-7
        assert abs(float(apart.mean())) <= 1e-4 * float(b.abs().mean())


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
