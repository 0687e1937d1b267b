"""The space that a scene's fields live in: from world metres to the unit cube [-1, 1]^3.

Kinds, chosen from the cameras and points by `bounds.find_space`, never asked for:

    box          a bounded object: an affine map; rays are cut at the box
    contraction  anything unbounded: recentred and scaled so that the part that matters lies in [-1, 1]^3,
                 then x -> (2 - 1/m) x / m where m = max |x_i| > 1, and halved; distances are spaced evenly
                 near, in disparity far
    ndc          forward-facing captures: normalised device coordinates of the mean camera (NeRF, appendix C)
    open         a scene cut into blocks: distances as in the contraction, points as they are (see `blocks.space`)

World coordinates are recentred in float64 before anything is float32: at 4.5e6 m float32 steps are 0.5 m.
Spacing maps s in [0, 1] to the ray parameter t. In the contraction g(t) = t/2 up to 1 and 1 - 1/(2t) beyond
is linear in s; the far half works with the complement 1/(2t), which keeps its relative accuracy at any
distance.
"""

from dataclasses import dataclass, fields
from functools import cached_property
from typing import Annotated, Literal

import torch
from torch import Tensor

from ..ops.proposal import Warp
from ..types import Rays

Kind = Literal["box", "contraction", "ndc", "open"]


def contract(x: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N 3"]:
    """R^3 to [-1, 1]^3 by the largest coordinate; the identity, halved, inside [-1, 1]^3. Finite for any
    finite x.
    """
    m = x.abs().amax(-1, keepdim=True).clamp_min(1)
    # x / m first: the product (2 - 1/m) x would overflow where x is near the largest float.
    return (1 - 0.5 / m) * (x / m)


def slab(
    origin: Annotated[Tensor, "... 3"], direction: Annotated[Tensor, "... 3"], low: Tensor, high: Tensor
) -> tuple[Annotated[Tensor, "..."], Annotated[Tensor, "..."]]:
    """Ray parameters at which rays enter and leave a box; the first is the larger one where they miss it."""
    # A direction along a face: any crossing so far away that it decides nothing.
    safe = torch.where(direction.abs() < 1e-9, torch.full_like(direction, 1e-9), direction)
    a = (low - origin) / safe
    b = (high - origin) / safe
    return torch.minimum(a, b).amax(-1), torch.maximum(a, b).amin(-1)


@dataclass(frozen=True)
class Space:
    """One scene's map to the unit cube; plain numbers, saved with the run."""

    kind: Kind
    centre: tuple[float, float, float]
    """World point that becomes the origin."""
    rotation: tuple[tuple[float, float, float], ...]
    """World to space axes, rows orthonormal."""
    scale: float
    """World units to space units (box, contraction)."""
    near: float
    """Nearest distance that is looked at: space units, or in NDC the world depth of the near plane."""
    far: float
    """Farthest distance, space units (unused in NDC)."""
    low: tuple[float, float, float] = (-1.0, -1.0, -1.0)
    """Corner of space coordinates that becomes (-1, -1, -1) (box, ndc)."""
    high: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Corner that becomes (1, 1, 1)."""
    focal: tuple[float, float] = (1.0, 1.0)
    """2 fx / W and 2 fy / H of the mean camera (ndc)."""

    def rays(self, origin: Annotated[Tensor, "R 3"], direction: Annotated[Tensor, "R 3"]) -> Rays:
        """World rays (float64, unit directions) as float32 rays of this space."""
        o, d = self._recentred(origin, direction)
        if self.kind == "ndc":
            # From the near plane (t = 0) to infinity (t = 1); a ray that looks backwards is bent to a grazing
            # one.
            dz = d[:, 2].clamp(max=-1e-6)
            slopes = d[:, :2] / dz[:, None]
            start = o + (-(self.near + o[:, 2]) / dz)[:, None] * torch.cat([d[:, :2], dz[:, None]], -1)
            fx, fy = self.focal
            x, y, z = start.unbind(-1)
            # NeRF, appendix C: the projection of the start, and its change along the ray.
            o = torch.stack([-fx * x / z, -fy * y / z, 1 + 2 * self.near / z], -1)
            d = torch.stack(
                [-fx * (slopes[:, 0] - x / z), -fy * (slopes[:, 1] - y / z), -2 * self.near / z], -1
            )
            near = torch.zeros_like(o[:, 0])
            far = torch.ones_like(o[:, 0])
        else:
            o = o * self.scale
            if self.kind == "box":
                near, far = slab(o, d, self._constant("low", o), self._constant("high", o))
                near = near.clamp_min(self.near)
                far = torch.maximum(far, near)  # a ray that misses the box gets an empty interval
            else:
                near = torch.full_like(o[:, 0], self.near)
                far = torch.full_like(o[:, 0], self.far)
        return Rays(o.float(), d.float(), direction.float(), near.float(), far.float())

    def locate(self, x: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N 3"]:
        """Points of the space to the unit cube; of an open one they stay as they are."""
        if self.kind == "open":
            return x
        if self.kind == "contraction":
            return contract(x)
        low = self._constant("low", x)
        high = self._constant("high", x)
        return (x - low) * (2 / (high - low)) - 1

    def distance(
        self, s: Annotated[Tensor, "R E"], near: Annotated[Tensor, "R"], far: Annotated[Tensor, "R"]
    ) -> Annotated[Tensor, "R E"]:
        """Ray parameters t of edges s in [0, 1]; increasing, with the ends on near and far."""
        n = near[:, None]
        f = far[:, None]
        if self.kind in ("box", "ndc"):
            return n + (f - n) * s
        g_near = torch.where(n < 1, n / 2, 1 - 0.5 / n)
        g_far = torch.where(f < 1, f / 2, 1 - 0.5 / f)
        c_near = torch.where(n < 1, 1 - n / 2, 0.5 / n)
        c_far = torch.where(f < 1, 1 - f / 2, 0.5 / f)
        # The far form starts from its far end: c_near + (c_far - c_near) s would cancel there.
        g = g_near + (g_far - g_near) * s
        c = c_far + (c_near - c_far) * (1 - s)
        # Both round: the clamp keeps them in order where they meet, since a negative step would be a negative
        # weight.
        return torch.where(g < 0.5, 2 * g, 0.5 / c.clamp(max=0.5))

    @cached_property
    def warp(self) -> Warp:
        """`distance` and `locate` as compiled loops take them."""
        curved = self.kind in ("contraction", "open")
        if curved:
            return Warp(curved, contracted=self.kind == "contraction")
        factor = []
        for low, high in zip(self.low, self.high, strict=True):
            factor.append(2 / (high - low))
        return Warp(
            curved, contracted=False, low=self.low, factor=(factor[0], factor[1], factor[2]), offset=1.0
        )

    def metric(
        self, origin: Annotated[Tensor, "R 3"], direction: Annotated[Tensor, "R 3"], t: Annotated[Tensor, "R"]
    ) -> Annotated[Tensor, "R"]:
        """World distance along unit world rays of the ray parameter t; infinite at NDC's far plane."""
        if self.kind != "ndc":
            return t / self.scale
        o, d = self._recentred(origin, direction)
        to_near = -(self.near + o[:, 2]) / d[:, 2]
        start = o[:, 2] + to_near * d[:, 2]
        # NDC z = 1 + 2 near / z rises from -1; t is the share of the way to the far plane, so z = z0 / (1 -
        # t).
        z = start / (1 - t.to(o.dtype)).clamp_min(1e-9)
        return (to_near + (z - start) / d[:, 2]).to(t.dtype)

    def parameter(
        self,
        origin: Annotated[Tensor, "R 3"],
        direction: Annotated[Tensor, "R 3"],
        distance: Annotated[Tensor, "R"],
    ) -> Annotated[Tensor, "R"]:
        """The ray parameter t at a world distance along unit world rays: the inverse of `metric`."""
        if self.kind != "ndc":
            return distance * self.scale
        o, d = self._recentred(origin, direction)
        z = (o[:, 2] + d[:, 2] * distance.to(o.dtype)).clamp(max=-self.near)
        return (1 + self.near / z).to(distance.dtype)

    def __getstate__(self) -> dict[str, object]:
        """The fields alone: a copy in another process makes its tensors itself."""
        found: dict[str, object] = {}
        for field in fields(self):
            found[field.name] = getattr(self, field.name)
        return found

    @cached_property
    def _tensors(self) -> dict[tuple[str, torch.dtype, torch.device], Tensor]:
        return {}

    def _constant(self, name: str, like: Tensor) -> Tensor:
        """A field as a tensor with the dtype and device of another one, copied once, not in each training
        step.
        """
        key = (name, like.dtype, like.device)
        if key not in self._tensors:
            with torch.inference_mode(False):
                self._tensors[key] = torch.tensor(getattr(self, name), dtype=like.dtype, device=like.device)
        return self._tensors[key]

    def _recentred(self, origin: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
        """World rays about the centre, in the space's axes, still in world units."""
        turn = self._constant("rotation", origin)
        return (origin - self._constant("centre", origin)) @ turn.T, direction @ turn.T
