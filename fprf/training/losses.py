"""The training terms (paper, Eq. 3 and 4, and K-Planes' regularisers), and those of plug-ins.

A term of weight 0 is never computed.
"""

import math
from typing import Annotated

import torch
import torch.nn.functional as F
from torch import Tensor

from ..config import LossConfig
from ..errors import ConfigError, PluginError
from ..interfaces import LossTerm
from ..plugins.registry import nearest
from ..rendering.stepfun import distortion, interlevel, midpoints
from ..testing.outputs import check_term
from ..types import Batch, Rendered, Want
from .facts import Facts
from .model import Model

FADE = 0.01
"""Share of `loss.depth` that is left at the end: points say where things are, pixels what they look like in
detail.
"""
SHELL = 4.0
"""Sky lies at least so many space units away: times what views commonly see, or the scene's inner radius."""
NEARBY = 0.04
"""Share of its distance by which a ray's end may miss a point: what a reconstruction is uncertain by."""


def extra_term(config: LossConfig) -> LossTerm | None:
    """Build the term of `loss.extra`; None where there is none, or where its weight is 0."""
    if config.extra is not None and config.extra.weight > 0:
        return config.extra.build()
    return None


def check_penalties(config: LossConfig, model: Model) -> None:
    """Raise ConfigError where a weight is given to an unknown penalty, PluginError where a penalty has the
    name of a term.
    """
    # The two of the planes have fields of their own in the config, and need not be named.
    names = model.penalty_names
    for name, _ in config.penalties:
        if name not in names:
            known = sorted(names - {"variation", "proposal_variation"})
            raise ConfigError(
                f"loss.penalties: no part of this model has a penalty {name!r}{nearest(name, known)} "
                f"(penalties that can be named: {', '.join(known) or 'none'})"
            )
    for name in sorted(names & _weights(config).keys()):
        raise PluginError(
            f"a penalty of a field or a sampler is called {name!r}, the name of a loss term; rename it there"
        )


def wanted(config: LossConfig, batch: Batch, extra: LossTerm | None = None) -> Want:
    """Outputs of the renderer that terms of weight above 0 need."""
    if extra is None:
        want = Want.DENSITY
    else:
        want = Want.DENSITY | extra.needs
    if config.rgb > 0:
        want |= Want.COLOUR
    if config.content > 0 and batch.content is not None:
        want |= Want.CONTENT
    if config.semantic > 0 and batch.semantic is not None:
        want |= Want.SEMANTIC
    return want


def terms(
    config: LossConfig,
    facts: Facts,
    rendered: Rendered,
    batch: Batch,
    model: Model,
    *,
    step: int,
    ends: Annotated[Tensor, "R"] | None = None,
    extra: LossTerm | None = None,
    generator: torch.Generator | None = None,
) -> dict[str, Tensor]:
    """Each term by name, unweighted. Feature terms are in units of the targets' spread, so one weight fits
    any encoder.

    `ends` are the ray parameters at `batch.distance` (`Space.parameter`). Penalties run over every parameter
    of the planes, whatever the batch: they are computed every `penalty_every` steps. `extra` is the term of
    `extra_term`; it draws from the generator.
    """
    result: dict[str, Tensor] = {}
    # Reconstruction (paper, Eq. 3 and 4): what was rendered against pixels and their features.
    if rendered.rgb is not None and config.rgb > 0:
        result["rgb"] = F.mse_loss(rendered.rgb, batch.rgb)
    if config.content > 0 and rendered.content is not None and batch.content is not None:
        result["content"] = F.mse_loss(rendered.content, batch.content) / facts.of_field.content_scale**2
    if config.semantic > 0 and rendered.semantic is not None and batch.semantic is not None:
        result["semantic"] = F.l1_loss(rendered.semantic, batch.semantic) / facts.of_field.semantic_scale
    # Geometry: proposals bound the weights, weights gather (Mip-NeRF 360, Eq. 13 and 15), end at known
    # points, leave the sky.
    sampled = rendered.sampled
    weights = rendered.weights
    assert sampled is not None and weights is not None
    if config.interlevel > 0 and sampled.levels:
        parts = []
        for level in sampled.levels:
            parts.append(interlevel(sampled.s, weights, level.s, level.weights))
        result["interlevel"] = torch.stack(parts).sum()
    if config.distortion > 0:
        result["distortion"] = distortion(sampled.s, weights)
    if config.depth > 0 and ends is not None:
        result["depth"] = ending(sampled.t, weights, ends, ndc=facts.space.kind == "ndc")
    if config.sky > 0 and batch.sky is not None:
        if facts.space.kind in ("box", "ndc"):
            within = math.inf
        else:
            within = SHELL
        result["sky"] = emptiness(sampled.t, weights, batch.sky, within=within)
    if config.extra is not None and extra is not None:
        # A term of a plug-in: what it returns is checked each time, since it depends on the batch.
        result["extra"] = extra(rendered, batch, model.parts, step=step, generator=generator)
        check_term(config.extra, result["extra"], rendered.opacity)
    # Regularisers of all parameters cost as much as a batch, and need not follow every one.
    wanted_penalties = set()
    for name in model.penalty_names:
        if _penalty_weight(config, name) > 0:
            wanted_penalties.add(name)
    if step % config.penalty_every == 0 and wanted_penalties:
        for name, value in model.penalties().items():
            if name in wanted_penalties:
                result[name] = value
    return result


def ending(
    t: Annotated[Tensor, "R E"],
    weights: Annotated[Tensor, "R S"],
    ends: Annotated[Tensor, "R"],
    *,
    ndc: bool = False,
) -> Tensor:
    """Distance of rays from ending at their known ray parameters (NaN = unknown); 0 where none is known.

    (1 - weight within NEARBY of the distance)^2 + (weight before)^2, the mean over those rays: both within
    [0, 1].
    """
    known = torch.isfinite(ends)
    ends = torch.where(known, ends, 0.5)
    # In NDC 1 - t is in proportion to 1 / depth.
    if ndc:
        low = 1 - (1 - ends) / (1 - NEARBY)
    else:
        low = ends * (1 - NEARBY)
    if ndc:
        high = 1 - (1 - ends) / (1 + NEARBY)
    else:
        high = ends * (1 + NEARBY)
    start = t[:, :-1]
    stop = t[:, 1:]
    # Weight before the point would hide it; what lies behind it is not known.
    before = stop <= low[:, None]
    # An interval that reaches into the range counts: far from the camera intervals are wider than the range.
    there = ~before & (start < high[:, None])
    missed = (1 - (weights * there).sum(-1)).square() + (weights * before).sum(-1).square()
    return _mean_of(missed, known)


def emptiness(
    t: Annotated[Tensor, "R E"],
    weights: Annotated[Tensor, "R S"],
    sky: Annotated[Tensor, "R"],
    *,
    within: float,
) -> Tensor:
    """Opacity that rays into the sky meet before `within` (space units); 0 where there are none.

    Mean over those rays of (weight before)^2, in [0, 1]: the sky itself is learnt beyond the shell.
    """
    return _mean_of((weights * (midpoints(t) < within)).sum(-1).square(), sky)


def _mean_of(values: Annotated[Tensor, "R"], mask: Annotated[Tensor, "R"]) -> Tensor:
    """Mean over the rays of a mask, whose number the host need not wait for; 0 where it has none."""
    return torch.where(mask, values, 0.0).sum() / mask.sum().clamp_min(1)


def total(config: LossConfig, parts: dict[str, Tensor], share: float = 0.0) -> Tensor:
    """Weighted sum, when a share of the training is over."""
    weights = _weights(config)
    # Points lead while the geometry is found; details of it are left to the photographs.
    weights["depth"] *= FADE**share
    # A penalty that is computed in one step of so many weighs as many times more.
    every = config.penalty_every
    weighted = []
    for name, value in parts.items():
        if name in weights:
            weight = weights[name]
        else:
            weight = _penalty_weight(config, name) * every
        weighted.append(weight * value)
    return torch.stack(weighted).sum()


def _weights(config: LossConfig) -> dict[str, float]:
    """Weights of the terms other than penalties."""
    return {
        "rgb": config.rgb,
        "content": config.content,
        "semantic": config.semantic,
        "interlevel": config.interlevel,
        "distortion": config.distortion,
        "depth": config.depth,
        "sky": config.sky,
        "extra": config.extra.weight if config.extra is not None else 0.0,
    }


def _penalty_weight(config: LossConfig, name: str) -> float:
    own = {"variation": config.variation, "proposal_variation": config.proposal_variation}
    return (own | dict(config.penalties)).get(name, 1.0)
