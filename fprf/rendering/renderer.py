"""Rays to colour, features and depth. Every stage that nobody asks for, or whose weight is too small to be seen, is skipped.

    sampler -> edges -> density everywhere -> weights -> the heaviest samples of each ray
            -> content -> (stylizer) -> decoder -> composite

Only the kept samples meet the content network, the semantic field, the stylizer and the decoder; what is left out weighs at
most `budget` a ray, which bounds the colour error (colours lie in [0, 1]).
"""

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ..interfaces import ContentField, Decoder, Sampler, SemanticField, Stylizer
from ..style.controls import blend_strength
from ..types import Rays, Rendered, Sampled, Want
from .space import Space
from .stepfun import keep_heaviest, midpoints, scale_gradient, transmittance_weights

__all__ = ["VEIL", "Kept", "Parts", "Restyle", "march", "render_rays"]


VEIL = 4.0
"""Within so many times the nearest distance of a ray, gradients are weighed down in training."""


class Parts(NamedTuple):
    """What a scene is rendered with."""

    space: Space
    sampler: Sampler
    field: ContentField
    semantic: SemanticField | None
    decoder: Decoder


@dataclass(frozen=True)
class Restyle:
    """A stylizer and how strongly it acts, 0 to 1; at 0 it is never called."""

    stylizer: Stylizer
    strength: float = 1.0


class Kept(NamedTuple):
    """The samples of R rays that matter, flattened: M of them, ray after ray."""

    ray: Annotated[Tensor, "M"]
    """int64 index of the ray of each."""
    weight: Annotated[Tensor, "M"]
    point: Annotated[Tensor, "M 3"]
    """In the unit cube."""
    latent: Annotated[Tensor, "M L"]
    view: Annotated[Tensor, "M 3"]
    fair: Annotated[Tensor, "M"] | None = None
    """What gradients of their features are multiplied by in training; None = nothing."""


class March(NamedTuple):
    """Geometry of R rays: everything that a style does not touch."""

    sampled: Sampled
    weights: Annotated[Tensor, "R S"]
    depth: Annotated[Tensor, "R"]
    opacity: Annotated[Tensor, "R"]
    through: Annotated[Tensor, "R"]
    """Share of the light from behind that reaches the eye. Density learns from it: a background is seen, or it is not."""
    kept: Kept


def march(
    rays: Rays, parts: Parts, *, budget: float, step: int | None = None, generator: torch.Generator | None = None
) -> March:
    """Sample, weigh, and keep what matters."""
    space = parts.space
    sampled = parts.sampler(rays, locate=space.locate, distance=space.distance, step=step, generator=generator)
    middle = midpoints(sampled.t)
    points = rays.origin[:, None] + rays.direction[:, None] * middle[..., None]
    located = space.locate(points.view(-1, 3))
    sample = parts.field.density(located)
    density = sample.density.view(middle.shape)
    fair = None
    if step is not None and space.kind == "contraction":
        # A camera samples what is near it far more densely than any other camera does, and could explain its own image
        # by a veil there. Weighing gradients by the square of the distance makes every piece of space count alike
        # (Philip and Deschaintre 2023); beyond a few times the nearest distance that is no longer needed.
        fair = (middle / (VEIL * rays.near[:, None])).square().clamp(max=1)
        density = scale_gradient(density, fair)
    weights = transmittance_weights(density, sampled.t)
    optical = (density * (sampled.t[:, 1:] - sampled.t[:, :-1])).sum(-1)
    # 1 - sum of weights would cancel where the ray is opaque.
    through = torch.exp(-optical)
    with torch.no_grad():
        opacity = -torch.expm1(-optical)
        depth = (weights * middle).sum(-1) / weights.sum(-1).clamp_min(1e-10)
        index = keep_heaviest(weights, budget).view(-1).nonzero()[:, 0]
        ray = index // middle.shape[1]
    kept = Kept(
        ray,
        weights.view(-1).index_select(0, index),
        located.index_select(0, index),
        sample.latent.index_select(0, index),
        rays.view.index_select(0, ray),
        None if fair is None else fair.view(-1).index_select(0, index),
    )
    return March(sampled, weights, depth, opacity, through, kept)


def composite(kept: Kept, values: Annotated[Tensor, "M C"], rays: int) -> Annotated[Tensor, "rays C"]:
    """Weighted sum over the kept samples of each ray (paper, Eq. 2)."""
    return values.new_zeros(rays, values.shape[1]).index_add(0, kept.ray, values * kept.weight[:, None])


def render_rays(
    rays: Rays,
    parts: Parts,
    *,
    want: Want,
    budget: float,
    background: Annotated[Tensor, "3"] | None = None,
    restyle: Restyle | None = None,
    step: int | None = None,
    generator: torch.Generator | None = None,
    semantic_rays: int | None = None,
    semantic_samples: int | None = None,
    content_moves_density: bool = True,
) -> Rendered:
    """Render what is wanted. `step` is given in training alone.

    Semantics are rendered with detached weights (the semantic loss never moves density), for the first `semantic_rays` rays
    from their `semantic_samples` heaviest samples, whose weights are scaled up to the ray's opacity. Content features are
    composited with detached weights too unless they may move density.
    """
    marched = march(rays, parts, budget=budget, step=step, generator=generator)
    kept, count = marched.kept, len(rays.near)
    rgb = content = semantic = None
    if want & (Want.COLOUR | Want.CONTENT):
        features = parts.field.content(kept.latent, kept.view)
        if kept.fair is not None:
            features = scale_gradient(features, kept.fair[:, None])
        if Want.CONTENT in want:
            still = kept if content_moves_density else kept._replace(weight=kept.weight.detach())
            content = composite(still, features, count)
        if Want.COLOUR in want:
            if restyle is not None and restyle.strength > 0:
                features = _restyled(features, kept, parts, restyle)
            rgb = composite(kept, parts.decoder(features), count)
            if background is not None:
                rgb = rgb + marched.through[:, None] * background
    if Want.SEMANTIC in want and parts.semantic is not None:
        semantic = _semantics(marched, rays, parts, count if semantic_rays is None else semantic_rays, semantic_samples)
    counts = {"rays": count, "samples": marched.weights.numel(), "kept": len(kept.ray)}
    return Rendered(marched.depth, marched.opacity, rgb, content, semantic, marched.weights, marched.sampled, counts)


def _restyled(features: Tensor, kept: Kept, parts: Parts, restyle: Restyle) -> Tensor:
    semantic = None
    if Want.SEMANTIC in restyle.stylizer.needs and parts.semantic is not None:
        semantic = parts.semantic(kept.point)
    return blend_strength(features, restyle.stylizer(features, semantic), restyle.strength)


def _semantics(marched: March, rays: Rays, parts: Parts, count: int, samples: int | None) -> Tensor:
    assert parts.semantic is not None
    weights = marched.weights[:count].detach()
    s = min(samples or weights.shape[1], weights.shape[1])
    heaviest, index = weights.topk(s, dim=-1, sorted=False)
    scale = marched.opacity[:count, None] / heaviest.sum(-1, keepdim=True).clamp_min(1e-10)
    t = midpoints(marched.sampled.t[:count]).gather(1, index)
    points = rays.origin[:count, None] + rays.direction[:count, None] * t[..., None]
    features: Tensor = parts.semantic(parts.space.locate(points.reshape(-1, 3)))
    return (features.view(count, s, features.shape[-1]) * (heaviest * scale)[..., None]).sum(1)
