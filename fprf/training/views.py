"""Whole images from a trained model, and views whose geometry and features are kept."""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Annotated

import torch
from torch import Tensor

from ..config import RenderConfig
from ..interfaces import Decoder
from ..memory import chunk_size, in_parts
from ..ops.backend import float64_device
from ..rendering.cameras import Cameras, PixelRays, grid_rays, rays_through
from ..rendering.renderer import (
    PackedSamples,
    composite,
    composite_mean,
    enlarged,
    march,
    march_colours,
    march_features,
    render_rays,
    shade,
)
from ..scenes import SceneView, Values
from ..style.look import Restyle
from ..types import Rays, View, Want
from .camera_optimizers import rays_of_moving_cameras, rotated
from .facts import Facts
from .model import Model, background_of
from .run import Photograph


def view_rays(
    model: Model, cameras: Cameras, view: int, pixel: Annotated[Tensor, "R 2"] | None = None
) -> tuple[Rays, Annotated[Tensor, "R 3"], Annotated[Tensor, "R 3"]]:
    """Rays through some pixels of a view, or all, on the model's device; their origins and directions in the
    world.

    The latter are float64: on the CPU where the device has none.
    """
    device = model.device
    wide = float64_device(device)
    if pixel is None:
        origin, direction = grid_rays(cameras, view, wide)
    else:
        through = rays_through(cameras, torch.full((len(pixel),), view), pixel)
        origin, direction = (x.to(wide) for x in through)
    return Rays(*(x.to(device) for x in model.space.rays(origin, direction))), origin, direction


@dataclass(frozen=True)
class ViewChunk:
    """A chunk of rays, row after row of a view, on the device of its model; it knows no style."""

    kept: PackedSamples
    content: Annotated[Tensor, "M C"]
    semantic: Annotated[Tensor, "M D"] | None
    behind: Annotated[Tensor, "R 3"] | float
    """Light of the background that reaches the eye."""
    rays: int
    depth: Annotated[Tensor, "R"]
    """World units."""
    opacity: Annotated[Tensor, "R"]
    samples: int
    """Number of samples before the light ones were dropped."""
    tone: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Factor of the final colours."""
    plain: Annotated[Tensor, "M 3"] | None = None
    """Colours of the samples as they are, where they are known; without content where no style is asked for."""

    @property
    def bytes(self) -> int:
        """Memory that it holds."""
        held = (*self.kept, self.content, self.semantic, self.depth, self.opacity, self.plain)
        return sum(t.numel() * t.element_size() for t in held if isinstance(t, Tensor))

    @torch.inference_mode()
    def colour(self, decoder: Decoder, restyle: Restyle | None) -> Annotated[Tensor, "R 3"]:
        """Colours of its pixels in a style, or as they are, in [0, 1]."""
        values = shade(decoder, self.content, self.semantic, restyle, self.plain)
        rgb = composite(self.kept, values, self.rays) + self.behind
        return (rgb if self.tone == (1.0, 1.0, 1.0) else rgb * rgb.new_tensor(self.tone)).clamp(0, 1)

    @torch.inference_mode()
    def mean(self, values: Annotated[Tensor, "M X"]) -> Annotated[Tensor, "R X"]:
        """Mean of values over the samples that each pixel sees; 0 where it sees nothing."""
        return composite_mean(self.kept, values, self.rays)


@torch.inference_mode()
def view_chunks(
    model: Model,
    facts: Facts,
    cameras: Cameras,
    view: int,
    config: RenderConfig,
    *,
    semantic: bool = True,
    plain: bool = False,
) -> Iterator[ViewChunk]:
    """Geometry and features of a view, chunk by chunk of its rays (see `memory.chunk_size`), for any style.

    For those who may stop half-way or keep none. Without `semantic` the semantic field is not evaluated;
    `plain` is for no style: colours as they are, and no features.
    """
    rays, origin, direction = view_rays(model, cameras, view)
    background = background_of(facts, rays.origin.device)

    def rendered(here: slice) -> ViewChunk:
        chunk = Rays(*(x[here] for x in rays))
        colours = None
        semantics = None
        if plain:
            marched, colours = march_colours(chunk, model.parts, budget=config.budget)
            content = colours[:, :0]
        else:
            marched, content, semantics = march_features(
                chunk, model.parts, budget=config.budget, semantic=semantic
            )
        kept = marched.kept
        behind = 0.0 if background is None else marched.transmittance[:, None] * background
        # Points and latents have done their part, and would be most of what is held.
        bare = kept._replace(
            point=kept.point[:, :0].clone(), latent=kept.latent[:, :0].clone(), view=kept.view[:, :0].clone()
        )
        # Depths along the world's ray, whatever space the field lives in.
        metric = model.space.metric(origin[here], direction[here], marched.depth.to(origin.device)).to(
            chunk.near.device
        )
        samples = marched.weights.numel()
        tone = config.tone or (1.0, 1.0, 1.0)
        return ViewChunk(
            bare, content, semantics, behind, len(chunk.near), metric, marched.opacity, samples, tone, colours
        )

    yield from in_parts(len(rays.near), chunk_size(config.chunk, rays.near.device), rendered)


@torch.inference_mode()
def _view_of(
    chunks: Iterable[ViewChunk], decoder: Decoder, restyle: Restyle | None, size: tuple[int, int]
) -> View:
    """The chunks of a view of (height, width) pixels in a style, still on their device."""
    rgb = []
    depth = []
    opacity = []
    kept = 0
    samples = 0
    for chunk in chunks:
        rgb.append(chunk.colour(decoder, restyle))
        depth.append(chunk.depth)
        opacity.append(chunk.opacity)
        kept = kept + len(chunk.kept.ray)
        samples = samples + chunk.samples
    share = kept / max(1, samples)
    return View(
        torch.cat(rgb).view(*size, 3), torch.cat(depth).view(size), torch.cat(opacity).view(size), share
    )


def _on_host(view: View) -> View:
    """A view on the CPU, copied from an accelerator in one piece, since the host waits for each copy."""
    if view.rgb.device.type == "cpu":
        return view
    parts = []
    for each in (view.rgb, view.depth, view.opacity):
        parts.append(each.reshape(-1))
    flat = torch.cat(parts).cpu()
    rgb, depth, opacity = torch.split_with_sizes(
        flat, [view.rgb.numel(), view.depth.numel(), view.opacity.numel()]
    )
    return View(rgb.view_as(view.rgb), depth.view_as(view.depth), opacity.view_as(view.opacity), view.kept)


def render_view(
    model: Model,
    facts: Facts,
    cameras: Cameras,
    view: int,
    config: RenderConfig,
    restyle: Restyle | None = None,
) -> View:
    """Colour and depth of one view in a style, or as captured, in chunks of rays and in one copy to the host.

    Below `config.resolution` 1 fewer rays are rendered, and what lies between is interpolated.
    """
    whole = cameras.size[view].tolist()
    if config.resolution < 1:
        cameras = cameras.select(torch.tensor([view])).scaled(1 / config.resolution)
        view = 0
    width, height = cameras.size[view].tolist()
    # Semantics are evaluated only where the style tells places apart by them.
    plain = restyle is None or restyle.idle
    semantic = restyle is not None and not plain and Want.SEMANTIC in restyle.needs
    chunks = view_chunks(model, facts, cameras, view, config, semantic=semantic, plain=plain)
    shown = _view_of(chunks, model.decoder, restyle, (height, width))
    return _on_host(enlarged(shown, whole) if config.resolution < 1 else shown)


@dataclass(frozen=True)
class CachedView(SceneView):
    """One view of one model, with its geometry and features."""

    decoder: Decoder
    chunks: tuple[ViewChunk, ...]
    size: tuple[int, int]
    """Height, width."""

    def restyled(self, restyle: Restyle | None = None) -> View:
        return _on_host(_view_of(self.chunks, self.decoder, restyle, self.size))

    @torch.inference_mode()
    def paint(self, values: Values) -> Annotated[Tensor, "N X"]:
        # Where the scene has no semantics all points are alike: features without channels.
        semantics = []
        for chunk in self.chunks:
            semantics.append(chunk.content[:, :0] if chunk.semantic is None else chunk.semantic)
        parts = []
        for chunk, at in zip(self.chunks, semantics, strict=True):
            parts.append(chunk.mean(values(at, None)).cpu())
        return torch.cat(parts)

    @property
    def bytes(self) -> int:
        return sum(chunk.bytes for chunk in self.chunks)


def cache_view(model: Model, facts: Facts, cameras: Cameras, view: int, config: RenderConfig) -> CachedView:
    """Render everything but a style (see `view_chunks`), and the colours as they are, which styles mix in."""
    width, height = cameras.size[view].tolist()
    chunks = []
    for chunk in view_chunks(model, facts, cameras, view, config):
        with torch.inference_mode():
            chunks.append(replace(chunk, plain=model.decoder(chunk.content)))
    return CachedView(model.decoder, tuple(chunks), (height, width))


@torch.inference_mode()
def paint_pixels(
    model: Model,
    cameras: Cameras,
    view: int,
    pixel: Annotated[Tensor, "R 2"],
    config: RenderConfig,
    values: Values,
    *,
    semantic: bool = True,
) -> tuple[Annotated[Tensor, "R X"], Annotated[Tensor, "R"]]:
    """Means over what each pixel sees of anything that follows from semantics, and the opacity; on the CPU.

    Pixels that see nothing get 0. `values` is given features without channels where the scene has no
    semantics or `semantic` is false. Neither content nor colour is computed.
    """
    # Geometry and semantics alone; content, the widest network, is not needed.
    rays, _, _ = view_rays(model, cameras, view, pixel)

    def paint(here: slice) -> tuple[Tensor, Tensor]:
        chunk = Rays(*(x[here] for x in rays))
        marched = march(chunk, model.parts, budget=config.budget)
        kept = marched.kept
        field = model.semantic if semantic else None
        painted = values(kept.point[:, :0] if field is None else field(kept.point), None)
        return composite_mean(kept, painted, len(chunk.near)), marched.opacity

    painted, opacity = zip(
        *in_parts(len(rays.near), chunk_size(config.chunk, rays.near.device), paint), strict=True
    )
    return torch.cat(painted).cpu(), torch.cat(opacity).cpu()


FIT_STEPS = 120
"""Steps of Adam that fit the pose of a view."""
_FIT_RAYS = 512
"""Pixels of such a step; by eye."""
_FIRST_FIT_RATE = 2e-3
"""Radians, and distances that views commonly see, of the first step; it falls along a cosine to none."""


def fit_pose(
    model: Model,
    facts: Facts,
    cameras: Cameras,
    view: int,
    photograph: Photograph,
    *,
    reach: float,
    budget: float,
) -> Annotated[Tensor, "6"]:
    """Turn and shift (world units), float64, that bring the render of a view nearest to its photograph, where
    that counts.

    Where training refines poses the scene moves with the training views, and a held-out view stays where the
    capture says: its pose is fitted to its own image (BARF, section 4), six numbers a view. The scene is not
    changed.
    """
    truth, where = photograph
    device = model.device
    tones = model.tones
    through = PixelRays(cameras.select(torch.tensor([view])))
    background = background_of(facts, device)
    # Photographs are compared as the view took them: a held-out view by what its exposure says.
    if tones is None:
        factor = torch.ones(3)
    else:
        factor = tones(torch.tensor([view]))[0].detach().cpu()
    pixels = truth.reshape(-1, 3)
    generator = torch.Generator().manual_seed(view)
    used = None
    if not (where is None or not bool(where.any())):
        used = where.reshape(-1).nonzero()[:, 0]
    move = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.Adam([move], lr=_FIRST_FIT_RATE, betas=(0.9, 0.95))
    # A few random pixels a step are enough for six numbers.
    for step in range(FIT_STEPS):
        optimizer.param_groups[0]["lr"] = 0.5 * _FIRST_FIT_RATE * (1 + math.cos(math.pi * step / FIT_STEPS))
        at = torch.randint(len(pixels) if used is None else len(used), (_FIT_RAYS,), generator=generator)
        at = at if used is None else used[at]
        pixel = torch.stack([at % truth.shape[1], at // truth.shape[1]], -1) + 0.5
        origin, direction = through(torch.zeros_like(at), pixel)
        # Only the move has a gradient: samples are placed as if the pose were fixed (see
        # `rays_of_moving_cameras`).
        turned = rotated(direction, move[:3].expand_as(direction))
        rays = rays_of_moving_cameras(model.space.rays(origin + reach * move[3:], turned))
        rays = Rays(*(x.to(device) for x in rays))
        rendered = render_rays(rays, model.parts, want=Want.COLOUR, budget=budget, background=background)
        assert rendered.rgb is not None
        loss = (rendered.rgb.cpu() * factor - pixels[at]).square().mean()
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        # Where no ray meets anything there is no slope.
        if move.grad is not None and bool(move.grad.isfinite().all()):
            optimizer.step()
    return move.detach() * torch.tensor([1.0, 1, 1, reach, reach, reach], dtype=torch.float64)
