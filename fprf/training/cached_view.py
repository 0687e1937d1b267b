"""A view whose geometry and features are kept, so that a new style costs its own arithmetic alone.

What a style does not touch (positions, weights, content features, semantics) is computed once; a restyle matches, maps and
decodes the samples that the renderer kept. Its pictures are those of `render_view`. A view of 135 x 240 pixels takes about
90 MB: 4 bytes for each of 48 content and 32 semantic channels of some eight samples a pixel.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated

import torch
from torch import Tensor

from ..config import RenderConfig
from ..interfaces import Decoder
from ..memory import chunk_size, in_parts
from ..rendering.cameras import Cameras
from ..rendering.renderer import Kept, composite, march
from ..style.look import Restyle
from ..types import Rays, View, Want
from .model import Facts, Model, background_of
from .views import on_host, view_rays

__all__ = ["CachedView", "Part", "cache_view", "view_parts"]


@dataclass(frozen=True)
class Part:
    """A chunk of rays, row after row of a view; it knows no style."""

    kept: Kept
    content: Annotated[Tensor, "M C"]
    semantic: Annotated[Tensor, "M D"] | None
    behind: Annotated[Tensor, "R 3"] | float
    """Light of the background that reaches the eye."""
    rays: int
    depth: Annotated[Tensor, "R"]
    """World units, on the CPU."""
    opacity: Annotated[Tensor, "R"]
    """On the CPU."""
    samples: int
    """How many there were before the light ones were dropped."""
    tone: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """What colours are multiplied by at last."""

    @property
    def bytes(self) -> int:
        """Memory that it holds."""
        held = (*self.kept, self.content, self.semantic, self.depth, self.opacity)
        return sum(t.numel() * t.element_size() for t in held if isinstance(t, Tensor))

    @torch.inference_mode()
    def colour(self, decoder: Decoder, restyle: Restyle | None) -> Annotated[Tensor, "R 3"]:
        """Colours of its pixels in a style, or as they are, in [0, 1]; on the CPU."""
        if restyle is None or restyle.idle:
            points: Tensor = decoder(self.content)
        else:
            points = restyle.colour(decoder, self.content, self.semantic if Want.SEMANTIC in restyle.needs else None)
        rgb = composite(self.kept, points, self.rays) + self.behind
        return (rgb if self.tone == (1.0, 1.0, 1.0) else rgb * rgb.new_tensor(self.tone)).clamp(0, 1).cpu()

    @torch.inference_mode()
    def mean(self, values: Annotated[Tensor, "M X"]) -> Annotated[Tensor, "R X"]:
        """What each pixel sees of values at the samples, scaled to what it sees at all; 0 where that is nothing."""
        mass = composite(self.kept, torch.ones_like(self.kept.weight)[:, None], self.rays)
        return (composite(self.kept, values, self.rays) / mass.clamp_min(1e-10)).cpu()


@dataclass(frozen=True)
class CachedView:
    """One view of one model."""

    decoder: Decoder
    parts: tuple[Part, ...]
    size: tuple[int, int]
    """Height, width."""

    @property
    def depth(self) -> Annotated[Tensor, "H W"]:
        """World units."""
        return torch.cat([part.depth for part in self.parts]).view(self.size)

    @property
    def opacity(self) -> Annotated[Tensor, "H W"]:
        """How much of each ray is met, in [0, 1]."""
        return torch.cat([part.opacity for part in self.parts]).view(self.size)

    @property
    def kept(self) -> float:
        """Share of the samples that met the content network."""
        return sum(len(part.kept.ray) for part in self.parts) / max(1, sum(part.samples for part in self.parts))

    @property
    def bytes(self) -> int:
        """Memory that it holds."""
        return sum(part.bytes for part in self.parts)

    @torch.inference_mode()
    def restyled(self, restyle: Restyle | None = None) -> View:
        """The view in a style, or as it is."""
        rgb = torch.cat([part.colour(self.decoder, restyle) for part in self.parts])
        return View(rgb.view(*self.size, 3), self.depth, self.opacity, self.kept)


def cache_view(model: Model, facts: Facts, cameras: Cameras, view: int, config: RenderConfig) -> CachedView:
    """Render everything but a style, in chunks of rays (see `memory.chunk_size`)."""
    width, height = (int(v) for v in cameras.size[view])
    return CachedView(model.decoder, tuple(view_parts(model, facts, cameras, view, config)), (height, width))


@torch.inference_mode()
def view_parts(model: Model, facts: Facts, cameras: Cameras, view: int, config: RenderConfig) -> Iterator[Part]:
    """The same chunk by chunk, for those who may stop half-way or keep none."""
    rays, origin, direction = view_rays(model, cameras, view)
    background = background_of(facts, rays.origin.device)

    def part(here: slice) -> Part:
        chunk = Rays(*(x[here] for x in rays))
        marched = march(chunk, model.parts, budget=config.budget)
        kept = marched.kept
        content = model.field.content(kept.latent, kept.view)
        semantic = model.semantic(kept.point) if model.semantic is not None else None
        behind = 0.0 if background is None else marched.transmittance[:, None] * background
        # Points and latents have done their part.
        bare = kept._replace(point=kept.point[:, :0].clone(), latent=kept.latent[:, :0].clone(), view=kept.view[:, :0].clone())
        metric = model.space.metric(origin[here], direction[here], marched.depth.to(origin.device))
        depth, opacity = on_host(metric.to(chunk.near.device), marched.opacity)
        samples, tone = marched.weights.numel(), config.tone or (1.0, 1.0, 1.0)
        return Part(bare, content, semantic, behind, len(chunk.near), depth, opacity, samples, tone)

    yield from in_parts(len(rays.near), chunk_size(config.chunk, rays.near.device), part)
