"""Adversarial inputs of rendering and styling operators, each compared with a float64 reference."""

import itertools
import math
from dataclasses import dataclass
from typing import Annotated

import torch
from torch import Tensor

from fprf.errors import FprfError
from fprf.ops.guided import upsample
from fprf.plugins.stylizers.config import (
    AdainConfig,
    LocalAdainConfig,
    RegionOtConfig,
    RegionToneConfig,
    StylizerConfig,
)
from fprf.rendering.stepfun import resample, transmittance_weights
from fprf.style.dictionary import whole_style
from fprf.style.matching import point_shares
from fprf.style.scene_style import SceneStyle, own_style
from fprf.style.statistics import covariance, empty, kmeans, merge, moments
from fprf.testing import cases
from fprf.types import Want

U = 2.0**-24
"""Unit round-off of float32."""


@dataclass(frozen=True, kw_only=True)
class Check:
    """Outcome of one input."""

    stage: str
    input: str
    reference: str
    measured: float
    bound: float
    """`measured` must be at most this; for `at_least`, at least."""
    unit: str = ""
    at_least: bool = False

    @property
    def passed(self) -> bool:
        """True where the bound holds; NaN holds none."""
        if math.isnan(self.measured):
            return False
        return self.measured >= self.bound if self.at_least else self.measured <= self.bound

    def json(self) -> dict[str, object]:
        """The row for a file; a measure that is not finite becomes text."""
        measured: object = (
            float(f"{self.measured:.4g}") if math.isfinite(self.measured) else str(self.measured)
        )
        return {
            "stage": self.stage,
            "input": self.input,
            "reference": self.reference,
            "bound": self.bound,
            "bound_is": "at least" if self.at_least else "at most",
            "measured": measured,
            "unit": self.unit,
            "verdict": "holds" if self.passed else "BROKEN",
        }


def relative(found: Tensor, truth: Tensor, floor: float = 0.0) -> float:
    """Largest relative error where the truth is above `floor`; infinite where something is not finite, 0 of
    nothing.
    """
    found = found.double()
    truth = truth.double()
    if not bool(found.isfinite().all()):
        return math.inf
    at = truth.abs() > floor
    error = ((found - truth).abs() / truth.abs())[at]
    return float(error.max()) if error.numel() else 0.0


def scaled(found: Tensor, truth: Tensor) -> float:
    """Largest error as a share of the largest true value."""
    found = found.double()
    truth = truth.double()
    if not bool(found.isfinite().all()):
        return math.inf
    return float((found - truth).abs().max() / truth.abs().max().clamp_min(torch.finfo(torch.float64).tiny))


def unsound(*tensors: Tensor) -> float:
    """Count of numbers that are not finite."""
    return float(sum(int((~t.isfinite()).sum()) for t in tensors))


GRID = (0.0, 1e-10, 1.0, 1e10, 1e30)
"""zip-NeRF's densities and lengths."""
FAINT = 1e-30
"""Weights below are not judged by relative error: float32 ends soon after."""


def exact_weights(density: Annotated[Tensor, "R S"], t: Annotated[Tensor, "R E"]) -> Annotated[Tensor, "R S"]:
    """w = exp(-sum of what lies before) (1 - exp(-tau)), in float64.

    Where a gradient is asked for, as a difference of exponentials: autograd of expm1 is wrong where the
    medium is opaque.
    """
    tau = density * (t[:, 1:] - t[:, :-1]).double()
    before = torch.nn.functional.pad(tau[:, :-1], (1, 0)).cumsum(-1)
    return (
        torch.exp(-before) - torch.exp(-(before + tau))
        if tau.requires_grad
        else torch.exp(-before) * -torch.expm1(-tau)
    )


def weights() -> list[Check]:
    """Every case, and gradients."""
    rows = []
    for name, (density, t) in _rays().items():
        truth = exact_weights(density.double(), t)
        tau = (density.double() * (t[:, 1:] - t[:, :-1]).double()).cumsum(-1)
        if len(density):
            rows.append(
                _ray_row(name, "float64", _law(transmittance_weights(density, t), truth, tau), 1.0, "4u(1+τ)")
            )
    density, t = _grid()
    density.requires_grad_(True)
    found = transmittance_weights(density, t)
    found.sum().backward()  # type: ignore[no-untyped-call]
    assert density.grad is not None
    bad = unsound(found.detach(), density.grad)
    rows.append(_ray_row("zip-NeRF's grid, values and gradients", "finite", bad, 0, "non-finite"))
    rows.append(_ray_row("fog before a wall, gradient", "float64", _gradient_error(), 1e-5, "of the largest"))
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
        rows.append(
            Check(
                stage="sampling",
                input=name,
                reference="float64",
                measured=error,
                bound=2e-5,
                unit="of [0, 1]",
            )
        )
        astray = float(((found < 0) | (found > 1)).sum() + (found.diff(dim=1) < 0).sum())
        rows.append(
            Check(
                stage="sampling",
                input=name,
                reference="sorted, inside",
                measured=astray,
                bound=0,
                unit="edges",
            )
        )
    return rows


def _ray_row(name: str, reference: str, measured: float, bound: float, unit: str) -> Check:
    return Check(
        stage="rendering", input=name, reference=reference, measured=measured, bound=bound, unit=unit
    )


def _law(found: Tensor, truth: Tensor, tau: Tensor) -> float:
    """Largest relative error in units of 4u(1 + optical depth so far)."""
    if unsound(found):
        return float("inf")
    at = truth > FAINT
    error = ((found.double() - truth).abs() / truth / (4 * U * (1 + tau)))[at]
    return float(error.max()) if error.numel() else 0.0


def _gradient_error() -> float:
    drawn = torch.Generator().manual_seed(4)
    t = torch.linspace(0, 4, 65).repeat(32, 1)
    density = 10 ** (8 * torch.rand(32, 64, generator=drawn) - 6)
    coefficient = torch.rand(32, 64, generator=drawn)
    found = density.clone().requires_grad_(True)
    (transmittance_weights(found, t) * coefficient).sum().backward()  # type: ignore[no-untyped-call]
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


_SCORES = ((30.0, 100.0), (100.0, 100.0), (100.0, 1.0), (260.0, 100.0), (1.0, 1e-3), (1.0, 1e6), (1.0, 1e-30))
"""Norms of both sides, and temperatures."""


def statistics() -> list[Check]:
    """Means and variances against two passes in float64, and in other orders and parts."""
    rows = []
    for ratio in (10.0, 1e3, 1e4):
        x = _draw(40_000, 8) + ratio
        mass = torch.rand(len(x), generator=torch.Generator().manual_seed(1))
        mean, variance = _two_passes(x, mass)
        found = moments(x, mass)
        error = max(relative(found.mean, mean), relative(covariance(found).diagonal(), variance))
        rows.append(
            _row("statistics", f"mean {ratio:g} deviations away", "two passes in float64", error, 1e-12)
        )
        order = torch.randperm(len(x), generator=torch.Generator().manual_seed(2))
        parts = empty(8)
        for piece in torch.split(order, 777):
            parts = merge(parts, moments(x[piece], mass[piece]))
        error = max(relative(parts.mean, found.mean), scaled(parts.scatter, found.scatter))
        rows.append(
            _row(
                "statistics",
                f"mean {ratio:g} deviations away",
                "the same in 52 parts, shuffled",
                error,
                1e-12,
            )
        )
    flat = moments(torch.full((1000, 4), 1e4), torch.ones(1000))
    rows.append(
        _row(
            "statistics",
            "constant channels",
            "variance 0",
            float(covariance(flat).diagonal().abs().max()),
            0.0,
        )
    )
    one = moments(_draw(1, 4), torch.ones(1))
    rows.append(_row("statistics", "one row", "variance 0", float(covariance(one).abs().max()), 0.0))
    return rows


def clusters() -> list[Check]:
    """K-means on degenerate features: clusters are non-empty, finite, and the means of their members."""
    inputs = {
        "fewer rows than clusters": _draw(3, 6),
        "all equal": torch.ones(200, 6),
        "three distinct rows": _draw(3, 6).repeat(80, 1),
        "zero vectors": torch.zeros(100, 6),
        "norm 3000, spread 0.3": 3000 + 0.3 * _draw(500, 6),
        "production size, 20480 x 64": _draw(20480, 64),
    }
    rows = []
    for name, x in inputs.items():
        found = kmeans(x, 10, seed=0)
        own = torch.stack([x[found.label == k].double().mean(0) for k in range(len(found.centres))])
        error = math.inf if unsound(own) else scaled(found.centres, own)
        rows.append(_row("clusters", name, "means of the members", error, 1e-6))
    spoilt = _draw(50, 6)
    spoilt[7, 3] = math.nan
    rows.append(_row("clusters", "a NaN", "refused by name", float(not _refused(spoilt)), 0.0))
    return rows


def matching() -> list[Check]:
    """Shares of style codes, for scores up to 1e5 temperatures apart."""
    rows = []
    for norm, temperature in _SCORES:
        x = norm * _unit(512, 64, 3)
        keys = norm * _unit(10, 64, 4)
        logits = (x.double() @ keys.double().T) / temperature
        found = point_shares(x, keys, temperature)
        truth = torch.softmax(logits, 1)
        law = 2 * U * float(logits.abs().max()) + 8 * U
        name = f"norms {norm:g}, temperature {temperature:g}"
        error = math.inf if unsound(found) else float((found.double() - truth).abs().max()) / law
        rows.append(_row("matching", name, "softmax in float64", error, 1.0, "2u max|logit| + 8u"))
        rows.append(
            _row(
                "matching",
                name,
                "rows sum to 1",
                float((found.double().sum(1) - 1).abs().max()) / U,
                16.0,
                "u",
            )
        )
    one = point_shares(_unit(8, 64, 5), _unit(1, 64, 6), 1.0)
    rows.append(_row("matching", "one code", "1", float((one - 1).abs().max()), 0.0))
    twins = point_shares(_unit(8, 64, 5), _unit(1, 64, 6).repeat(2, 1), 1.0)
    rows.append(_row("matching", "the same code twice", "half each", float((twins - 0.5).abs().max()), 4 * U))
    return rows


def stylizers() -> list[Check]:
    """A scene in its own style comes back; no statistics make a number that is not finite."""
    kinds: dict[str, StylizerConfig] = {
        "adain": AdainConfig(),
        "region-tone": RegionToneConfig(),
        "region-ot": RegionOtConfig(),
    }
    rows = []
    content = cases.normal(400, 8, seed=12)
    semantic = cases.normal(400, 4, seed=13)
    scene = _whole(cases.scene(4, 8, 4))
    for name, config in kinds.items():
        stylizer = config.build(dictionary=own_style(scene, 0.0), scene=scene)
        styled = stylizer(content, semantic if Want.SEMANTIC in stylizer.needs else None)
        rows.append(
            _row("stylizers", f"{name}, the scene's own style", "the features", scaled(styled, content), 1e-5)
        )
    for name, config in (kinds | {"local-adain": LocalAdainConfig()}).items():
        for what, (here, there) in _extremes().items():
            stylizer = config.build(dictionary=own_style(there, 0.0), scene=here)
            asks = Want.SEMANTIC in stylizer.needs
            bad = 0.0
            for size in (0.0, 1.0, 1e4):
                bad += unsound(stylizer(size * content, semantic if asks else None))
            rows.append(_row("stylizers", f"{name}, {what}", "finite", bad, 0.0, "non-finite"))
    return rows


def guided() -> list[Check]:
    """The guided filter against itself on features that float32 does not blur: small, about 0."""
    drawn = torch.Generator().manual_seed(7)
    picture = torch.rand(96, 128, 3, generator=drawn)
    features = torch.randn(4, 24, 32, generator=drawn)
    sky = torch.full((96, 128, 3), 0.7) + 1e-3 * picture
    grey = picture[..., :1].repeat(1, 1, 3)
    rows = []
    guides = {
        "natural, eps 1e-3": (picture, 1e-3, 1e-4),
        "flat sky, eps 1e-6": (sky, 1e-6, 1e-4),
        "grey, eps 1e-6": (grey, 1e-6, 1e-3),
    }
    for name, (guide, eps, bound) in guides.items():
        plain = upsample(features, guide, radius=8, eps=eps)
        rows.append(_row("guided filter", name, "finite", unsound(plain), 0.0, "non-finite"))
        lifted = upsample(features + 50, guide, radius=8, eps=eps) - 50
        rows.append(
            _row("guided filter", f"{name}, features + 50", "the same without", scaled(lifted, plain), bound)
        )
    tiny = upsample(features[:, :1, :1], picture[:5, :5], radius=30, eps=1e-3)
    rows.append(_row("guided filter", "5 x 5 pixels, radius 30", "finite", unsound(tiny), 0.0, "non-finite"))
    return rows


def _row(
    stage: str, name: str, reference: str, measured: float, bound: float, unit: str = "relative"
) -> Check:
    return Check(stage=stage, input=name, reference=reference, measured=measured, bound=bound, unit=unit)


def _draw(rows: int, columns: int) -> Tensor:
    return torch.randn(rows, columns, generator=torch.Generator().manual_seed(0))


def _unit(rows: int, columns: int, seed: int) -> Tensor:
    return torch.nn.functional.normalize(
        torch.randn(rows, columns, generator=torch.Generator().manual_seed(seed)), dim=1
    )


def _two_passes(x: Tensor, mass: Tensor) -> tuple[Tensor, Tensor]:
    x = x.double()
    mass = mass.double()
    share = mass / mass.sum()
    mean = share @ x
    return mean, share @ (x - mean).square()


def _refused(x: Tensor) -> bool:
    try:
        kmeans(x, 4, seed=0)
    except FprfError as error:
        return "\n" not in str(error)
    return False


def _whole(scene: SceneStyle) -> SceneStyle:
    """The scene with the mean and covariance that its regions have together."""
    mean, whole = whole_style(own_style(scene, 0.0))
    return scene._replace(mean=mean.float(), covariance=whole.float())


def _extremes() -> dict[str, tuple[SceneStyle, SceneStyle]]:
    """A scene and another as its style."""
    usual = cases.scene(4, 8, 4)

    def times(scale: float) -> SceneStyle:
        return usual._replace(
            covariance=scale * usual.covariance, region_covariance=scale * usual.region_covariance
        )

    return {
        "scene without variance": (times(0.0), usual),
        "style without variance": (usual, times(0.0)),
        "scene of deviation 1e-6": (times(1e-12), usual),
        "style of deviation 1e4": (usual, times(1e8)),
        "neither has any": (times(0.0), times(0.0)),
    }
