"""Statistics, clusters, matching, stylizers and the guided filter on hostile features, against float64."""

import math

import torch
from torch import Tensor

from ..errors import FprfError
from ..ops.guided import upsample
from ..plugins.stylizers.config import AdainConfig, LocalAdainConfig, RegionAdainConfig, RegionOtConfig, StylizerConfig
from ..style.clusters import kmeans
from ..style.dictionary import whole_style
from ..style.matching import point_shares
from ..style.scene import SceneStyle, own_style
from ..style.statistics import covariance, empty, merge, moments
from ..testing import cases
from ..types import Want
from .check import Check, U, relative, scaled, unsound

__all__ = ["clusters", "guided", "matching", "statistics", "stylizers"]

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
        rows.append(_row("statistics", f"mean {ratio:g} deviations away", "two passes in float64", error, 1e-12))
        order = torch.randperm(len(x), generator=torch.Generator().manual_seed(2))
        parts = empty(8)
        for piece in torch.split(order, 777):
            parts = merge(parts, moments(x[piece], mass[piece]))
        error = max(relative(parts.mean, found.mean), scaled(parts.scatter, found.scatter))
        rows.append(_row("statistics", f"mean {ratio:g} deviations away", "the same in 52 parts, shuffled", error, 1e-12))
    flat = moments(torch.full((1000, 4), 1e4), torch.ones(1000))
    rows.append(_row("statistics", "constant channels", "variance 0", float(covariance(flat).diagonal().abs().max()), 0.0))
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
        x, keys = norm * _unit(512, 64, 3), norm * _unit(10, 64, 4)
        logits = (x.double() @ keys.double().T) / temperature
        found, truth = point_shares(x, keys, temperature), torch.softmax(logits, 1)
        law = 2 * U * float(logits.abs().max()) + 8 * U
        name = f"norms {norm:g}, temperature {temperature:g}"
        error = math.inf if unsound(found) else float((found.double() - truth).abs().max()) / law
        rows.append(_row("matching", name, "softmax in float64", error, 1.0, "2u max|logit| + 8u"))
        rows.append(_row("matching", name, "rows sum to 1", float((found.double().sum(1) - 1).abs().max()) / U, 16.0, "u"))
    one = point_shares(_unit(8, 64, 5), _unit(1, 64, 6), 1.0)
    rows.append(_row("matching", "one code", "1", float((one - 1).abs().max()), 0.0))
    twins = point_shares(_unit(8, 64, 5), _unit(1, 64, 6).repeat(2, 1), 1.0)
    rows.append(_row("matching", "the same code twice", "half each", float((twins - 0.5).abs().max()), 4 * U))
    return rows


def stylizers() -> list[Check]:
    """A scene in its own style comes back; no statistics make a number that is not finite."""
    kinds: dict[str, StylizerConfig] = {
        "adain": AdainConfig(),
        "region-adain": RegionAdainConfig(),
        "region-ot": RegionOtConfig(),
    }
    rows = []
    content, semantic = cases.normal(400, 8), cases.normal(400, 4)
    scene = _whole(cases.scene(4, 8, 4))
    for name, config in kinds.items():
        stylizer = config.build(dictionary=own_style(scene, 0.0), scene=scene)
        styled = stylizer(content, semantic if Want.SEMANTIC in stylizer.needs else None)
        rows.append(_row("stylizers", f"{name}, the scene's own style", "the features", scaled(styled, content), 1e-5))
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
        rows.append(_row("guided filter", f"{name}, features + 50", "the same without", scaled(lifted, plain), bound))
    tiny = upsample(features[:, :1, :1], picture[:5, :5], radius=30, eps=1e-3)
    rows.append(_row("guided filter", "5 x 5 pixels, radius 30", "finite", unsound(tiny), 0.0, "non-finite"))
    return rows


def _row(stage: str, name: str, reference: str, measured: float, bound: float, unit: str = "relative") -> Check:
    return Check(stage=stage, input=name, reference=reference, measured=measured, bound=bound, unit=unit)


def _draw(rows: int, columns: int) -> Tensor:
    return torch.randn(rows, columns, generator=torch.Generator().manual_seed(0))


def _unit(rows: int, columns: int, seed: int) -> Tensor:
    return torch.nn.functional.normalize(torch.randn(rows, columns, generator=torch.Generator().manual_seed(seed)), dim=1)


def _two_passes(x: Tensor, mass: Tensor) -> tuple[Tensor, Tensor]:
    x, mass = x.double(), mass.double()
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
        return usual._replace(covariance=scale * usual.covariance, region_covariance=scale * usual.region_covariance)

    return {
        "scene without variance": (times(0.0), usual),
        "style without variance": (usual, times(0.0)),
        "scene of deviation 1e-6": (times(1e-12), usual),
        "style of deviation 1e4": (usual, times(1e8)),
        "neither has any": (times(0.0), times(0.0)),
    }
