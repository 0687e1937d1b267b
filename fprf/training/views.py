"""Whole images from a trained model, and views whose geometry and features are kept."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated

import torch
from torch import Tensor

from ..config import RenderConfig
from ..interfaces import Decoder, SceneView, Values
from ..memory import chunk_size, in_parts
from ..ops.precision import float64_device
from ..rendering.cameras import Cameras, PixelRays, grid_rays, rays_through
from ..rendering.renderer import PackedSamples, composite, composite_mean, enlarged, march, march_features, render_rays, shade
from ..style.look import Restyle
from ..types import Rays, Rendered, View, Want
from .camera_optimizers import moving, rotated
from .model import Facts, Model, background_of


def view_rays(
    model: Model, cameras: Cameras, view: int, pixel: Annotated[Tensor, "R 2"] | None = None
) -> tuple[Rays, Annotated[Tensor, "R 3"], Annotated[Tensor, "R 3"]]:
    """Rays through some pixels of a view, or all, on the model's device; their origins and directions in the world.

    The latter are float64: on the CPU where the device has none.
    """
    device = model.device
    wide = float64_device(device)
    if pixel is None:
        origin, direction = grid_rays(cameras, view, wide)
    else:
        origin, direction = (x.to(wide) for x in rays_through(cameras, torch.full((len(pixel),), view), pixel))
    return Rays(*(x.to(device) for x in model.space.rays(origin, direction))), origin, direction


def on_host(*tensors: Tensor) -> list[Tensor]:
    """Copy tensors of one dtype to the CPU, from an accelerator in a single copy, since the host waits for each."""
    if all(each.device.type == "cpu" for each in tensors):
        return list(tensors)
    flat = torch.cat([each.reshape(-1) for each in tensors]).cpu()
    parts = torch.split_with_sizes(flat, [each.numel() for each in tensors])
    return [part.view(each.shape) for part, each in zip(parts, tensors, strict=True)]


@torch.inference_mode()
def render_view(
    model: Model,
    facts: Facts,
    cameras: Cameras,
    view: int,
    config: RenderConfig,
    restyle: Restyle | None = None,
    factor: Annotated[Tensor, "3"] | None = None,
) -> View:
    """Colour and depth of one view, in chunks of rays (see `memory.chunk_size`) and in one copy to the host.

    Below `config.resolution` 1 fewer rays are rendered, and what lies between is interpolated.

    Colours are multiplied by `factor`, if one is given: how a camera took them (`tones`); else by the config's tone.
    """
    if factor is None and config.tone is not None:
        factor = torch.tensor(config.tone)
    if config.resolution < 1:
        small = cameras.select(torch.tensor([view])).scaled(1 / config.resolution)
        shown = enlarged(_rendered(model, facts, small, 0, config, restyle, factor), cameras.size[view].tolist())
    else:
        shown = _rendered(model, facts, cameras, view, config, restyle, factor)
    rgb, depth, opacity = on_host(shown.rgb, shown.depth, shown.opacity)
    return View(rgb, depth, opacity, shown.kept)


def _rendered(
    model: Model,
    facts: Facts,
    cameras: Cameras,
    view: int,
    config: RenderConfig,
    restyle: Restyle | None,
    factor: Annotated[Tensor, "3"] | None,
) -> View:
    """All pixels of a view, still on the model's device."""
    rays, origin, direction = view_rays(model, cameras, view)
    background = background_of(facts, rays.origin.device)
    rgb, depth, opacity, kept, samples = [], [], [], 0, 0

    def render(here: slice) -> Rendered:
        part = Rays(*(x[here] for x in rays))
        return render_rays(part, model.parts, want=Want.COLOUR, budget=config.budget, background=background, restyle=restyle)

    for out in in_parts(len(rays.near), chunk_size(config.chunk, rays.near.device), render):
        assert out.rgb is not None
        rgb.append(out.rgb)
        depth.append(out.depth)
        opacity.append(out.opacity)
        kept, samples = kept + out.counts["kept"], samples + out.counts["samples"]
    # As the camera took it, and depths along the world's ray, whatever space the field lives in.
    width, height = (int(v) for v in cameras.size[view])
    colour = torch.cat(rgb)
    colour = (colour if factor is None else colour * factor.to(colour.device)).clamp(0, 1)
    metric = model.space.metric(origin, direction, torch.cat(depth).to(origin.device)).to(colour.device)
    shape = (height, width)
    return View(colour.view(*shape, 3), metric.view(shape), torch.cat(opacity).view(shape), kept / max(1, samples))


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

    Pixels that see nothing get 0. `values` is given features without channels where the scene has no semantics or
    `semantic` is false. Neither content nor colour is computed.
    """
    rays, _, _ = view_rays(model, cameras, view, pixel)

    def paint(here: slice) -> tuple[Tensor, Tensor]:
        chunk = Rays(*(x[here] for x in rays))
        marched = march(chunk, model.parts, budget=config.budget)
        kept, field = marched.kept, model.semantic if semantic else None
        painted = values(kept.point[:, :0] if field is None else field(kept.point), None)
        return composite_mean(kept, painted, len(chunk.near)), marched.opacity

    painted, opacity = zip(*in_parts(len(rays.near), chunk_size(config.chunk, rays.near.device), paint), strict=True)
    shown, seen = on_host(torch.cat(painted), torch.cat(opacity))
    return shown, seen


@dataclass(frozen=True)
class Part:
    """A chunk of rays, row after row of a view; it knows no style."""

    kept: PackedSamples
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
    """Number of samples before the light ones were dropped."""
    tone: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Factor of the final colours."""

    @property
    def bytes(self) -> int:
        """Memory that it holds."""
        held = (*self.kept, self.content, self.semantic, self.depth, self.opacity)
        return sum(t.numel() * t.element_size() for t in held if isinstance(t, Tensor))

    @torch.inference_mode()
    def colour(self, decoder: Decoder, restyle: Restyle | None) -> Annotated[Tensor, "R 3"]:
        """Colours of its pixels in a style, or as they are, in [0, 1]; on the CPU."""
        rgb = composite(self.kept, shade(decoder, self.content, self.semantic, restyle), self.rays) + self.behind
        return (rgb if self.tone == (1.0, 1.0, 1.0) else rgb * rgb.new_tensor(self.tone)).clamp(0, 1).cpu()

    @torch.inference_mode()
    def mean(self, values: Annotated[Tensor, "M X"]) -> Annotated[Tensor, "R X"]:
        """Mean of values over the samples that each pixel sees; 0 where it sees nothing."""
        return composite_mean(self.kept, values, self.rays).cpu()


@dataclass(frozen=True)
class CachedView(SceneView):
    """One view of one model, with its geometry and features."""

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
        """Opacity of each ray, in [0, 1]."""
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
        rgb = torch.cat([part.colour(self.decoder, restyle) for part in self.parts])
        return View(rgb.view(*self.size, 3), self.depth, self.opacity, self.kept)

    @torch.inference_mode()
    def match(self, restyle: Restyle) -> Annotated[Tensor, "N T"]:
        shares = [
            part.mean(restyle.match(part.content[:, :0] if part.semantic is None else part.semantic)) for part in self.parts
        ]
        return torch.cat(shares)


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
        marched, content, semantic = march_features(chunk, model.parts, budget=config.budget)
        kept = marched.kept
        behind = 0.0 if background is None else marched.transmittance[:, None] * background
        # Points and latents have done their part.
        bare = kept._replace(point=kept.point[:, :0].clone(), latent=kept.latent[:, :0].clone(), view=kept.view[:, :0].clone())
        metric = model.space.metric(origin[here], direction[here], marched.depth.to(origin.device))
        depth, opacity = on_host(metric.to(chunk.near.device), marched.opacity)
        samples, tone = marched.weights.numel(), config.tone or (1.0, 1.0, 1.0)
        return Part(bare, content, semantic, behind, len(chunk.near), depth, opacity, samples, tone)

    yield from in_parts(len(rays.near), chunk_size(config.chunk, rays.near.device), part)


FIT_STEPS = 120
"""Steps of Adam that fit the pose of a view."""
_FIT_RAYS, _FIT_RATE = 512, 2e-3
"""Pixels of such a step; radians, and distances that views commonly see, of the first one, falling along a cosine to none."""


def fit_pose(
    model: Model,
    facts: Facts,
    cameras: Cameras,
    view: int,
    truth: Annotated[Tensor, "H W 3"],
    where: Annotated[Tensor, "H W"] | None,
    *,
    reach: float,
    budget: float,
) -> Annotated[Tensor, "6"]:
    """Turn and shift (world units), float64, that bring the render of a view nearest to its image, `where` that counts.

    Where training refines poses the scene moves with the training views, and a held-out view stays where the capture says: its
    pose is fitted to its own image (BARF, section 4), six numbers a view. The scene is not changed.
    """
    device, tones = model.device, model.tones
    through, background = PixelRays(cameras.select(torch.tensor([view]))), background_of(facts, device)
    factor = torch.ones(3) if tones is None else tones(torch.tensor([view]))[0].detach().cpu()
    pixels, generator = truth.reshape(-1, 3), torch.Generator().manual_seed(view)
    used = None if where is None or not bool(where.any()) else where.reshape(-1).nonzero()[:, 0]
    move = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.Adam([move], lr=_FIT_RATE, betas=(0.9, 0.95))
    for step in range(FIT_STEPS):
        optimizer.param_groups[0]["lr"] = 0.5 * _FIT_RATE * (1 + math.cos(math.pi * step / FIT_STEPS))
        at = torch.randint(len(pixels) if used is None else len(used), (_FIT_RAYS,), generator=generator)
        at = at if used is None else used[at]
        pixel = torch.stack([at % truth.shape[1], at // truth.shape[1]], -1) + 0.5
        origin, direction = through(torch.zeros_like(at), pixel)
        turned = rotated(direction, move[:3].expand_as(direction))
        rays = moving(model.space.rays(origin + reach * move[3:], turned))
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
