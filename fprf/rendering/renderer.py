"""Volume rendering: rays to colour, features and depth. Stages that nobody asks for are skipped.

    sampler -> edges t -> density everywhere -> weights -> the heaviest samples of each ray
            -> content -> (stylizer) -> decoder -> composite

Letters: R rays, S samples of a ray between E = S + 1 edges t, M samples that are kept of all R rays (packed,
ray after ray), L latent, C content and D semantic channels. With densities s_i and steps d_i = t_i+1 - t_i
(paper, Eq. 2; NeRF, Eq. 3)

    w_i = T_i (1 - exp(-s_i d_i)),    T_i = exp(-sum_j<i s_j d_j),    value of a ray = sum_i w_i value_i + T_S background

Only kept samples meet the content network, the semantic field, the stylizer and the decoder; what is left out
weighs at most `budget` a ray, which bounds the error of colours in [0, 1]. In training on an accelerator
every sample is kept and what is left out has weight 0: the host would have to wait for their number in each
step.
"""

from typing import TYPE_CHECKING, Annotated, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from ..interfaces import Decoder, Parts
from ..ops import proposal
from ..types import Rays, Rendered, Sampled, View, Want
from .space import Space
from .stepfun import keep_heaviest, midpoints, scale_gradient, transmittance_weights

if TYPE_CHECKING:
    from ..style.look import Restyle


_NEAR_CAMERA = 4.0
"""Within this multiple of a ray's nearest distance gradients are scaled down in training."""


class PackedSamples(NamedTuple):
    """The samples of R rays that are kept, packed: M of them, ray after ray."""

    ray: Annotated[Tensor, "M"]
    """int64 index of the ray of each."""
    weight: Annotated[Tensor, "M"]
    point: Annotated[Tensor, "M 3"]
    """Places in the unit cube."""
    latent: Annotated[Tensor, "M L"]
    view: Annotated[Tensor, "M 3"]
    gradient_scale: Annotated[Tensor, "M"] | None = None
    """Factor of the gradients of their features in training; None = 1."""
    whole: bool = False
    """True where every sample of every ray is kept, M = R S."""


class March(NamedTuple):
    """Geometry of R rays: everything that a style does not touch."""

    sampled: Sampled
    weights: Annotated[Tensor, "R S"]
    depth: Annotated[Tensor, "R"]
    opacity: Annotated[Tensor, "R"]
    transmittance: Annotated[Tensor, "R"]
    """Transmittance of the whole ray: the share of the background that is seen. Density learns from it."""
    kept: PackedSamples


def march(
    rays: Rays,
    parts: Parts,
    *,
    budget: float,
    step: int | None = None,
    generator: torch.Generator | None = None,
) -> March:
    """Sample rays, weigh the samples, and keep the heaviest. `step` is given in training alone."""
    # Where to look along each ray: edges t [R E] of S = E - 1 steps, placed by the sampler.
    space = parts.space
    sampled = parts.sampler(_detached(rays), space=space, step=step, generator=generator)
    # A camera samples what is near it far more densely than any other camera does, and could explain its own
    # image by a veil there. Scaling gradients by the square of the distance makes every piece of space count
    # alike (Philip and Deschaintre 2023); beyond a few times the nearest distance that is no longer needed.
    # In a box, and in normalised device coordinates, no camera stands amid the samples.
    scaled = step is not None and space.kind in ("contraction", "open")
    # Densities at the middle of each step, in the unit cube, where the fields live.
    middle = midpoints(sampled.t)
    located = _located(rays, sampled.t, middle, space)
    sample = parts.field.density(located)
    density = sample.density.view(middle.shape)
    scale = None
    if scaled:
        scale = (middle / (_NEAR_CAMERA * rays.near[:, None])).square().clamp(max=1)
    if scale is not None:
        density = scale_gradient(density, scale)
    # Weights and transmittance of Eq. 2; what is only shown needs no gradient.
    weights = transmittance_weights(density, sampled.t)
    optical = (density * (sampled.t[:, 1:] - sampled.t[:, :-1])).sum(-1)
    transmittance = torch.exp(-optical)  # 1 - sum of weights would cancel where the ray is opaque
    with torch.no_grad():
        opacity = -torch.expm1(-optical)
        depth = (weights * middle).sum(-1) / weights.sum(-1).clamp_min(1e-10)
        keep = keep_heaviest(weights, budget)
    if step is not None and rays.origin.device.type != "cpu":
        # All samples, the light ones with weight 0: shapes that the host knows without waiting.
        ray = torch.arange(len(weights), device=weights.device)[:, None].expand(weights.shape).reshape(-1)
        heavy = torch.where(keep, weights, 0.0).view(-1)
        flat = None if scale is None else scale.view(-1)
        kept = PackedSamples(
            ray, heavy, located, sample.latent, rays.view.index_select(0, ray), flat, whole=True
        )
        return March(sampled, weights, depth, opacity, transmittance, kept)
    # Elsewhere the kept ones alone, gathered.
    index = keep.view(-1).nonzero()[:, 0]
    ray = index // max(1, middle.shape[1])
    kept = PackedSamples(
        ray,
        weights.view(-1).index_select(0, index),
        located.index_select(0, index),
        sample.latent.index_select(0, index),
        rays.view.index_select(0, ray),
        None if scale is None else scale.view(-1).index_select(0, index),
    )
    return March(sampled, weights, depth, opacity, transmittance, kept)


def _located(
    rays: Rays, t: Annotated[Tensor, "R E"], middle: Annotated[Tensor, "R S"], space: Space
) -> Annotated[Tensor, "R*S 3"]:
    """The middles of steps in the unit cube."""
    moving = rays.origin.requires_grad or rays.direction.requires_grad
    if proposal.usable(rays.origin, rays.direction, t, learns=moving):
        return proposal.place(rays.origin, rays.direction, t, space.warp)
    points = rays.origin[:, None] + rays.direction[:, None] * middle[..., None]
    return space.locate(points.view(-1, 3))


def _detached(rays: Rays) -> Rays:
    """Rays without gradients: neither the places of samples nor semantics shall move a camera's pose."""
    return Rays(*(x.detach() for x in rays))


def march_features(
    rays: Rays, parts: Parts, *, budget: float, semantic: bool = True
) -> tuple[March, Annotated[Tensor, "M C"], Annotated[Tensor, "M D"] | None]:
    """March rays, and evaluate content and, where they are asked for and exist, semantics at the kept
    samples.
    """
    marched = march(rays, parts, budget=budget)
    kept = marched.kept
    content = parts.field.content(kept.latent, kept.view)
    return marched, content, parts.semantic(kept.point) if semantic and parts.semantic is not None else None


def march_colours(rays: Rays, parts: Parts, *, budget: float) -> tuple[March, Annotated[Tensor, "M 3"]]:
    """March rays, and evaluate the colours of the kept samples as they are."""
    marched = march(rays, parts, budget=budget)
    kept = marched.kept
    return marched, parts.field.colour(kept.latent, kept.view, parts.decoder)


def shade(
    decoder: Decoder,
    content: Annotated[Tensor, "M C"],
    semantic: Annotated[Tensor, "M D"] | None,
    restyle: "Restyle | None",
    plain: Annotated[Tensor, "M 3"] | None = None,
) -> Annotated[Tensor, "M 3"]:
    """Colours of samples in a style (None = plain); `plain` are those without one, where they are known."""
    if restyle is None or restyle.idle:
        own: Tensor = decoder(content) if plain is None else plain
        return own
    return restyle.colour(decoder, content, semantic if Want.SEMANTIC in restyle.needs else None, plain)


def composite(
    kept: PackedSamples, values: Annotated[Tensor, "M C"], rays: int
) -> Annotated[Tensor, "rays C"]:
    """Weighted sum over the kept samples of each ray (paper, Eq. 2)."""
    if kept.whole and rays > 0:
        return (values * kept.weight[:, None]).view(rays, -1, values.shape[1]).sum(1)
    return values.new_zeros(rays, values.shape[1]).index_add(0, kept.ray, values * kept.weight[:, None])


def composite_mean(
    kept: PackedSamples, values: Annotated[Tensor, "M C"], rays: int
) -> Annotated[Tensor, "rays C"]:
    """Mean over the kept samples of each ray, by their weights; 0 where a ray meets nothing."""
    mass = composite(kept, torch.ones_like(kept.weight)[:, None], rays)
    return composite(kept, values, rays) / mass.clamp_min(1e-10)


class TrainingStep(NamedTuple):
    """Arguments of rendering in training."""

    step: int | None = None
    """None = what is rendered is only shown: samples are drawn as they are for views."""
    generator: torch.Generator | None = None
    """Of the step's draws."""
    semantic_rays: int | None = None
    """Semantics are rendered for so many of the first rays; None = all."""
    semantic_samples: int | None = None
    """From so many of the heaviest samples of each; None = all."""
    content_moves_density: bool = True
    """False = content features are composited with detached weights."""


RENDERED_ONLY = TrainingStep()
"""Nothing is trained."""


def render_rays(
    rays: Rays,
    parts: Parts,
    *,
    want: Want,
    budget: float,
    background: Annotated[Tensor, "3"] | None = None,
    restyle: "Restyle | None" = None,
    training: TrainingStep = RENDERED_ONLY,
) -> Rendered:
    """Render what is wanted.

    Semantics are rendered with detached weights (the semantic loss never moves density), from the heaviest
    samples of a ray, whose weights are scaled up to the ray's opacity.
    """
    # Geometry, which no style touches.
    marched = march(rays, parts, budget=budget, step=training.step, generator=training.generator)
    kept = marched.kept
    count = len(rays.near)
    rgb = content = semantic = None
    if want & (Want.COLOUR | Want.CONTENT):
        # Content features of the kept samples: composited as they are, or decoded to colours, after the
        # style.
        features = parts.field.content(kept.latent, kept.view)
        if kept.gradient_scale is not None:
            features = scale_gradient(features, kept.gradient_scale[:, None])
        if Want.CONTENT in want:
            if training.content_moves_density:
                fixed = kept
            else:
                fixed = kept._replace(weight=kept.weight.detach())
            content = composite(fixed, features, count)
        if Want.COLOUR in want:
            # Semantics are evaluated only where the style tells places apart by them.
            backdrop = 0.0 if background is None else marched.transmittance[:, None] * background
            styled = restyle is not None and not restyle.idle and Want.SEMANTIC in restyle.needs
            semantics = None
            if styled and parts.semantic is not None:
                semantics = parts.semantic(kept.point)
            rgb = composite(kept, shade(parts.decoder, features, semantics, restyle), count) + backdrop
    if Want.SEMANTIC in want and parts.semantic is not None:
        # Semantics follow the geometry and never move it (paper, semantic field).
        semantic = _semantics(
            marched,
            _detached(rays),
            parts,
            count if training.semantic_rays is None else training.semantic_rays,
            training.semantic_samples,
        )
    counts = {"rays": count, "samples": marched.weights.numel(), "kept": len(kept.ray)}
    return Rendered(
        marched.depth, marched.opacity, rgb, content, semantic, marched.weights, marched.sampled, counts
    )


def _semantics(
    marched: March, rays: Rays, parts: Parts, count: int, samples: int | None
) -> Annotated[Tensor, "count D"]:
    """Semantics of the first `count` rays, from their heaviest samples: most light comes from a few of
    them.
    """
    assert parts.semantic is not None
    weights = marched.weights[:count].detach()
    s = min(samples or weights.shape[1], weights.shape[1])
    heaviest, index = weights.topk(s, dim=-1, sorted=False)
    # What the other samples would add is given to these, so that nothing is dimmer for being cheaper.
    scale = marched.opacity[:count, None] / heaviest.sum(-1, keepdim=True).clamp_min(1e-10)
    t = midpoints(marched.sampled.t[:count]).gather(1, index)
    points = rays.origin[:count, None] + rays.direction[:count, None] * t[..., None]
    features: Tensor = parts.semantic(parts.space.locate(points.reshape(-1, 3)))
    return (features.view(count, s, features.shape[-1]) * (heaviest * scale)[..., None]).sum(1)


def enlarged(small: View, size: list[int]) -> View:
    """Resize a view to a width and height. Depths stay what they are: between near and far there is
    nothing.
    """
    target = size[::-1]
    rgb = F.interpolate(small.rgb.permute(2, 0, 1)[None], target, mode="bicubic")[0].permute(1, 2, 0)
    depth = F.interpolate(small.depth[None, None], target, mode="nearest-exact")[0, 0]
    opacity = F.interpolate(small.opacity[None, None], target, mode="bilinear")[0, 0]
    return View(rgb.clamp(0, 1).contiguous(), depth, opacity, small.kept)
