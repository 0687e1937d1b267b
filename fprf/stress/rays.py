"""Rendering weights and resampling on hostile rays, against float64."""

import itertools
from collections.abc import Callable
from typing import Annotated

import torch
from torch import Tensor

from ..ops import march
from ..rendering.stepfun import resample, transmittance_weights
from .check import Check, U, scaled, unsound

__all__ = ["sampling", "weights"]

GRID = (0.0, 1e-10, 1.0, 1e10, 1e30)
"""zip-NeRF's densities and lengths."""
FAINT = 1e-30
"""Weights below are not judged by relative error: float32 ends soon after."""


def exact_weights(density: Annotated[Tensor, "R S"], t: Annotated[Tensor, "R E"]) -> Annotated[Tensor, "R S"]:
    """w = exp(-sum of what lies before) (1 - exp(-tau)), in float64.

    Where a gradient is asked for, as a difference of exponentials: autograd of expm1 is wrong where the medium is opaque.
    """
    tau = density * (t[:, 1:] - t[:, :-1]).double()
    before = torch.nn.functional.pad(tau[:, :-1], (1, 0)).cumsum(-1)
    return torch.exp(-before) - torch.exp(-(before + tau)) if tau.requires_grad else torch.exp(-before) * -torch.expm1(-tau)


def weights() -> list[Check]:
    """Every case through the plain and the compiled form."""
    forms: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
        "plain": transmittance_weights,
        "compiled": lambda density, t: march.weigh(density, t, 0.0).weights,
    }
    rows = []
    for name, (density, t) in _rays().items():
        truth = exact_weights(density.double(), t)
        tau = (density.double() * (t[:, 1:] - t[:, :-1]).double()).cumsum(-1)
        for form, function in forms.items():
            if form == "compiled" and not march.fit(density, t):
                continue
            found = function(density, t)
            rows.append(_row(f"{name}, {form}", "float64", _law(found, truth, tau), 1.0, "4u(1+τ)"))
    grid_density, grid_t = _grid()
    for form, function in forms.items():
        density = grid_density.clone().requires_grad_(True)
        found = function(density, grid_t)
        found.sum().backward()  # type: ignore[no-untyped-call]
        assert density.grad is not None
        bad = unsound(found.detach(), density.grad)
        rows.append(_row(f"zip-NeRF's grid, values and gradients, {form}", "finite", bad, 0, "non-finite"))
        rows.append(_row(f"fog before a wall, gradient, {form}", "float64", _gradient_error(function), 1e-5, "of the largest"))
    return rows


def sampling() -> list[Check]:
    """Edges of the resampled distribution."""
    rows = []
    for name, w in _distributions().items():
        s = torch.linspace(0, 1, w.shape[1] + 1).repeat(len(w), 1)
        found = resample(s, w, 48, padding=1e-3, generator=None)
        truth = resample(s.double(), w.double(), 48, padding=1e-3, generator=None)
        away = (found.double() - truth).abs().max()
        error = float(away) if bool(found.isfinite().all()) else float("inf")
        rows.append(Check(stage="sampling", input=name, reference="float64", measured=error, bound=2e-5, unit="of [0, 1]"))
        astray = float(((found < 0) | (found > 1)).sum() + (found.diff(dim=1) < 0).sum())
        rows.append(Check(stage="sampling", input=name, reference="sorted, inside", measured=astray, bound=0, unit="edges"))
    return rows


def _row(name: str, reference: str, measured: float, bound: float, unit: str) -> Check:
    return Check(stage="rendering", input=name, reference=reference, measured=measured, bound=bound, unit=unit)


def _law(found: Tensor, truth: Tensor, tau: Tensor) -> float:
    """Largest relative error in units of 4u(1 + optical depth so far)."""
    if unsound(found):
        return float("inf")
    at = truth > FAINT
    error = ((found.double() - truth).abs() / truth / (4 * U * (1 + tau)))[at]
    return float(error.max()) if error.numel() else 0.0


def _gradient_error(function: Callable[[Tensor, Tensor], Tensor]) -> float:
    drawn = torch.Generator().manual_seed(4)
    t = torch.linspace(0, 4, 65).repeat(32, 1)
    density = 10 ** (8 * torch.rand(32, 64, generator=drawn) - 6)
    coefficient = torch.rand(32, 64, generator=drawn)
    found = density.clone().requires_grad_(True)
    (function(found, t) * coefficient).sum().backward()  # type: ignore[no-untyped-call]
    truth = density.double().requires_grad_(True)
    (exact_weights(truth, t) * coefficient).sum().backward()  # type: ignore[no-untyped-call]
    assert found.grad is not None and truth.grad is not None
    return scaled(found.grad, truth.grad)


def _rays() -> dict[str, tuple[Tensor, Tensor]]:
    drawn = torch.Generator().manual_seed(0)

    def even(rays: int, samples: int) -> Tensor:
        return torch.linspace(0, 1, samples + 1).repeat(rays, 1)

    def fog(depth: float, rays: int = 64, samples: int = 256) -> tuple[Tensor, Tensor]:
        return depth * samples * (0.5 + torch.rand(rays, samples, generator=drawn)), even(rays, samples)

    spread = 10 ** (10 * torch.rand(64, 256, generator=drawn) - 8)
    wall = torch.cat([torch.full((64, 128), 1e-6), torch.full((64, 8), 50.0), torch.zeros(64, 120)], 1)
    return {
        "fog of 1e-9 a step, N = 256": fog(1e-9),
        "fog of 1e-6 a step, N = 256": fog(1e-6),
        "fog of 1e-3 a step, N = 256": fog(1e-3),
        "depths 1e-8 to 1e2 a step, N = 256": (spread * 256, even(64, 256)),
        "a wall of 8 steps of 50 in fog": (wall * 256, even(64, 256)),
        "one sample": fog(0.5, samples=1),
        "no rays": (torch.zeros(0, 16), even(0, 16)),
        "N = 65536, fog of 1e-6": fog(1e-6, rays=1, samples=65536),
        "4096 rays of 48 samples": fog(1e-2, rays=4096, samples=48),
        "densities of 1e-38": (torch.full((4, 32), 1e-38), 1e10 * even(4, 32)),
    }


def _grid() -> tuple[Tensor, Tensor]:
    pairs = list(itertools.product(GRID, repeat=4))
    density = torch.tensor([[a, b] for a, b, _, _ in pairs])
    lengths = torch.tensor([[c, d] for _, _, c, d in pairs])
    return density, torch.nn.functional.pad(lengths.cumsum(-1), (1, 0))


def _distributions() -> dict[str, Tensor]:
    drawn = torch.Generator().manual_seed(1)
    spike = torch.zeros(16, 128)
    spike[torch.arange(16), torch.arange(16) * 8] = 1.0
    last = torch.zeros(4, 64)
    last[:, -1] = 1e-3
    return {
        "weights all 0": torch.zeros(8, 64),
        "one spike": spike,
        "the last bin alone": last,
        "weights of 1e-38": torch.full((8, 64), 1e-38),
        "random, N = 256": torch.rand(64, 256, generator=drawn) / 128,
        "one bin": torch.ones(4, 1),
        "N = 65536": torch.rand(1, 65536, generator=drawn) / 32768,
    }
