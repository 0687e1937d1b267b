"""Views in full precision with nothing skipped, and what skipping spares.

The exact result is the run's own image, sampled as it was trained, in float64 with nothing skipped: what our shortcuts are
judged by. How far it is from the photograph is the model's affair; that error is reported beside it.
"""

import copy
from dataclasses import replace
from typing import Annotated, NamedTuple, TypeVar

import torch
from torch import Tensor, nn

from ..config import RenderConfig
from ..ops import backend
from ..rendering.cameras import Cameras, pixel_grid, rays_through
from ..rendering.renderer import Parts, march, render_rays
from ..style.look import Restyle
from ..training.model import Facts, Model, background_of
from ..types import Rays, Want

__all__ = ["Counts", "Difference", "count", "difference", "exact", "plainly", "view_rays"]

M = TypeVar("M", bound=nn.Module)
CHUNK = 4096


class Counts(NamedTuple):
    """What a view was spared."""

    rays: int
    samples: int
    kept: int
    """Samples that met the content network."""
    empty: int
    """Rays that kept none."""

    @property
    def shares(self) -> dict[str, float]:
        """As shares, by name."""
        return {
            "kept_samples_share": self.kept / max(1, self.samples),
            "empty_rays_share": self.empty / max(1, self.rays),
            "kept_samples_per_ray": self.kept / max(1, self.rays),
        }


class Difference(NamedTuple):
    """Of two images in [0, 1]."""

    largest: float
    rms: float


def view_rays(model: Model, cameras: Cameras, view: int) -> Rays:
    """Rays of all pixels, on the model's device."""
    pixel = pixel_grid(cameras, view)
    rays = model.space.rays(*rays_through(cameras, torch.full((len(pixel),), view), pixel))
    return _to(rays, model.device)


@torch.inference_mode()
def exact(model: Model, facts: Facts, rays: Rays, restyle: Restyle | None = None) -> Annotated[Tensor, "R 3"]:
    """Colours in [0, 1] in float64, nothing skipped."""
    wide = _double(model)
    restyle = None if restyle is None else replace(restyle, stylizer=_double(restyle.stylizer))
    background = background_of(facts, rays.near.device)
    rgb = []
    for part in _chunks(Rays(*(x.double() for x in rays))):
        out = render_rays(part, wide.parts, want=Want.COLOUR, budget=0.0, background=background, restyle=restyle)
        assert out.rgb is not None
        rgb.append(out.rgb)
    return torch.cat(rgb).clamp(0, 1)


def plainly(
    model: Model, facts: Facts, rays: Rays, render: RenderConfig, look: Restyle | None = None
) -> Annotated[Tensor, "R 3"]:
    """Colours in [0, 1] without compiled kernels."""
    background = background_of(facts, rays.near.device)
    rgb = []
    with torch.inference_mode(), backend.plain():
        for part in _chunks(rays, render.chunk):
            out = render_rays(part, model.parts, want=Want.COLOUR, budget=render.budget, background=background, restyle=look)
            assert out.rgb is not None
            rgb.append(out.rgb)
    return torch.cat(rgb).clamp(0, 1)


@torch.inference_mode()
def count(parts: Parts, rays: Rays, budget: float) -> Counts:
    """What a budget spares."""
    samples = kept = empty = 0
    for part in _chunks(rays):
        marched = march(part, parts, budget=budget)
        samples, kept = samples + marched.weights.numel(), kept + len(marched.kept.ray)
        empty += len(part.near) - len(torch.unique(marched.kept.ray))
    return Counts(len(rays.near), samples, kept, empty)


def difference(found: Tensor, truth: Tensor) -> Difference:
    """Largest and root-mean-square difference."""
    away = found.double().flatten() - truth.double().flatten()
    return Difference(float(away.abs().max()), float(away.square().mean().sqrt()))


def _double(module: M) -> M:
    return copy.deepcopy(module).double()


def _to(rays: Rays, device: torch.device) -> Rays:
    return Rays(*(x.to(device) for x in rays))


def _chunks(rays: Rays, size: int = CHUNK) -> list[Rays]:
    return [Rays(*(x[at : at + size] for x in rays)) for at in range(0, len(rays.near), size)]
