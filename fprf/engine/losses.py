"""The training terms (paper, Eq. 3 and 4, and K-Planes' regularisers). A term of weight 0 is never computed."""

import torch
import torch.nn.functional as F
from torch import Tensor

from ..config import LossConfig
from ..rendering.stepfun import distortion, interlevel
from ..types import Batch, Rendered, Want
from .model import Facts, Model

__all__ = ["terms", "total", "wanted"]


def wanted(config: LossConfig, batch: Batch) -> Want:
    """What must be rendered for the terms that count."""
    want = Want.DENSITY
    if config.rgb > 0:
        want |= Want.COLOUR
    if config.content > 0 and batch.content is not None:
        want |= Want.CONTENT
    if config.semantic > 0 and batch.semantic is not None:
        want |= Want.SEMANTIC
    return want


def terms(config: LossConfig, facts: Facts, rendered: Rendered, batch: Batch, model: Model, *, step: int) -> dict[str, Tensor]:
    """Each term by name, unweighted. Feature terms are in units of the targets' spread, so one weight fits any encoder.

    Penalties walk over every parameter of the planes, whatever the batch: they come every `penalty_every` steps.
    """
    result: dict[str, Tensor] = {}
    if rendered.rgb is not None and config.rgb > 0:
        result["rgb"] = F.mse_loss(rendered.rgb, batch.rgb)
        if rendered.unaided is not None:
            # Else the scene's own part of a decoder would do the frozen part's work, and a new style would have nothing.
            result["unaided"] = F.mse_loss(rendered.unaided, batch.rgb)
    if rendered.content is not None and batch.content is not None:
        result["content"] = F.mse_loss(rendered.content, batch.content) / facts.content_scale**2
    if rendered.semantic is not None and batch.semantic is not None:
        result["semantic"] = F.l1_loss(rendered.semantic, batch.semantic) / facts.semantic_scale
    sampled, weights = rendered.sampled, rendered.weights
    assert sampled is not None and weights is not None
    if config.interlevel > 0 and sampled.levels:
        parts = [interlevel(sampled.s, weights, level.s, level.weights) for level in sampled.levels]
        result["interlevel"] = torch.stack(parts).sum()
    if config.distortion > 0:
        result["distortion"] = distortion(sampled.s, weights)
    due = step % config.penalty_every == 0 and (config.variation > 0 or config.proposal_variation > 0)
    penalties = model.penalties() if due else {}
    for name, weight in (("variation", config.variation), ("proposal_variation", config.proposal_variation)):
        if weight > 0 and name in penalties:
            result[name] = penalties[name]
    return result


def total(config: LossConfig, parts: dict[str, Tensor]) -> Tensor:
    """Weighted sum."""
    # Both colours of a decoder with a part of the scene's own share one weight: the regularisers keep theirs.
    colour = config.rgb / 2 if "unaided" in parts else config.rgb
    weights = {
        "rgb": colour,
        "unaided": colour,
        "content": config.content,
        "semantic": config.semantic,
        "interlevel": config.interlevel,
        "distortion": config.distortion,
        "variation": config.variation * config.penalty_every,
        "proposal_variation": config.proposal_variation * config.penalty_every,
    }
    return torch.stack([weights[name] * value for name, value in parts.items()]).sum()
