"""A view whose geometry and features are kept, so that a new style costs its own arithmetic alone.

What a style does not touch (positions, weights, content features, semantics) is computed once; a restyle matches, maps and
decodes the samples that the renderer kept. Its pictures are those of `render_view`. A view of 135 x 240 pixels takes about
90 MB: 4 bytes for each of 48 content and 32 semantic channels of some eight samples a pixel.
"""

from dataclasses import dataclass
from typing import Annotated

import torch
from torch import Tensor

from ..config import RenderConfig
from ..interfaces import Decoder
from ..rendering.cameras import Cameras
from ..rendering.renderer import Kept, Restyle, composite, march
from ..types import Rays, Want
from .model import Facts, Model, background_of
from .views import View, view_rays

__all__ = ["CachedView", "cache_view"]


@dataclass(frozen=True)
class _Part:
    """A chunk of rays."""

    kept: Kept
    content: Annotated[Tensor, "M C"]
    semantic: Annotated[Tensor, "M D"] | None
    behind: Annotated[Tensor, "R 3"] | float
    """Light of the background that reaches the eye."""
    rays: int


@dataclass(frozen=True)
class CachedView:
    """One view of one model; it knows no style."""

    decoder: Decoder
    parts: tuple[_Part, ...]
    depth: Annotated[Tensor, "H W"]
    opacity: Annotated[Tensor, "H W"]
    kept: float
    """Share of the samples that met the content network."""

    @property
    def bytes(self) -> int:
        """Memory that it holds."""
        tensors = [t for p in self.parts for t in (*p.kept, p.content, p.semantic) if isinstance(t, Tensor)]
        return sum(t.numel() * t.element_size() for t in tensors)

    @torch.inference_mode()
    def restyled(self, restyle: Restyle | None = None) -> View:
        """The view in a style, or as it is."""
        rgb = [composite(p.kept, self._colour(p, restyle), p.rays) + p.behind for p in self.parts]
        image = torch.cat(rgb).cpu().view(*self.depth.shape, 3).clamp(0, 1)
        return View(image, self.depth, self.opacity, self.kept)

    def _colour(self, part: _Part, restyle: Restyle | None) -> Tensor:
        if restyle is None or restyle.idle:
            plain: Tensor = self.decoder(part.content)
            return plain
        return restyle.colour(self.decoder, part.content, part.semantic if Want.SEMANTIC in restyle.needs else None)


@torch.inference_mode()
def cache_view(model: Model, facts: Facts, cameras: Cameras, view: int, config: RenderConfig) -> CachedView:
    """Render everything but a style, in chunks of `config.chunk` rays."""
    rays, origin, direction = view_rays(model, cameras, view)
    background = background_of(facts, rays.origin.device)
    parts, depth, opacity, samples = [], [], [], 0
    for start in range(0, len(rays.near), config.chunk):
        chunk = Rays(*(x[start : start + config.chunk] for x in rays))
        marched = march(chunk, model.parts, budget=config.budget)
        kept = marched.kept
        content = model.field.content(kept.latent, kept.view)
        semantic = model.semantic(kept.point) if model.semantic is not None else None
        behind = 0.0 if background is None else marched.through[:, None] * background
        # Points and latents have done their part.
        bare = kept._replace(point=kept.point[:, :0].clone(), latent=kept.latent[:, :0].clone(), view=kept.view[:, :0].clone())
        parts.append(_Part(bare, content, semantic, behind, len(chunk.near)))
        depth.append(marched.depth.cpu())
        opacity.append(marched.opacity.cpu())
        samples += marched.weights.numel()
    width, height = (int(v) for v in cameras.size[view])
    metric = model.space.metric(origin, direction, torch.cat(depth))
    share = sum(len(part.kept.ray) for part in parts) / max(1, samples)
    return CachedView(model.decoder, tuple(parts), metric.view(height, width), torch.cat(opacity).view(height, width), share)
