"""Views of Gaussians, and what views show of each of them in the mean."""

from dataclasses import replace
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ..ops.harmonics import HARMONIC, spherical_harmonics
from ..ops.rasterise.reference import project_reference
from ..ops.rasterise.rendering import Pinhole, Rasterised, lift, rasterise
from ..rendering.cameras import Cameras
from ..rendering.local_frame import extent_of
from .gaussians import Gaussians
from .pinholes import covering

_DRAWN_HARMONICS = 16
"""Harmonics a channel that are drawn: those of degree 3, as the rasteriser has no more."""
_CLIP_DISTANCE = 0.01
"""Distance from a camera, in world units, from which on a capture is drawn: gsplat's default near plane."""
_MIN_CLIP_SHARE = 1e-4
"""Least such distance as a share of the capture's extent; by eye, for captures in small units."""
_MAX_CLIP_SHARE = 2e-2
"""Largest such distance as a share of the capture's extent; by eye, for captures in large units."""
_MAX_MEAN_VIEWS = 32
"""Views that means are taken from, at most; by eye: as many as a capture is looked at from (`LookConfig`)."""
_UNSEEN_PIXELS = 1e-4
"""Weight, in pixels, of a view that does not show a Gaussian; by eye: next to nothing beside one that does."""


def draw(
    gaussians: Gaussians,
    camera: Pinhole,
    *,
    antialiased: bool = False,
    features: Annotated[Tensor, "N C"] | None = None,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Rasterised:
    """A view of Gaussians; harmonics above degree 3, which files may hold, are not drawn."""
    parts = (
        gaussians.means,
        gaussians.quaternions,
        gaussians.log_scales,
        gaussians.logits,
        gaussians.harmonics[:, :_DRAWN_HARMONICS],
    )
    behind = torch.tensor(background, device=gaussians.means.device)
    return rasterise(*parts, camera, features=features, background=behind, antialiased=antialiased)


def clip_distance(gaussians: Gaussians) -> float:
    """Nothing of a capture is drawn nearer to a camera than this, along z, in whatever units it is."""
    extent = extent_of(gaussians.means)[1]
    if extent > 0:
        return min(max(_CLIP_DISTANCE, _MIN_CLIP_SHARE * extent), _MAX_CLIP_SHARE * extent)
    return _CLIP_DISTANCE


class SeenMeans(NamedTuple):
    """Means over the views that show each Gaussian: what comes nearest to them where a renderer knows one
    colour a Gaussian and no compensation of opacities (Mip-Splatting), as in browsers and .splat files.
    """

    functions: Annotated[Tensor, "N K"]
    """Means of the functions of the harmonics, at most those of degree 3."""
    opacities: Annotated[Tensor, "N"]
    weights: Annotated[Tensor, "N"]
    """Of each Gaussian in the pixels of the views: those of the least weight show least."""

    def plain(self, gaussians: Gaussians) -> Gaussians:
        """The Gaussians with mean opacities."""
        return replace(gaussians, logits=torch.logit(self.opacities, 1e-6))

    def gaussians(self, gaussians: Gaussians) -> Gaussians:
        """The Gaussians with mean colours, which may leave [0, 1], and opacities."""
        mean = 0.5 + torch.einsum(
            "nk,nkc->nc", self.functions, gaussians.harmonics[:, : self.functions.shape[1]]
        )
        return self.plain(gaussians.recoloured((mean - 0.5)[:, None] / HARMONIC))


@torch.inference_mode()
def seen_means(gaussians: Gaussians, cameras: Cameras, *, antialiased: bool) -> SeenMeans:
    """Means of what views show of each Gaussian, by its weights in their pixels.

    The mean over all directions is another colour where photographs are from one side. What no view shows
    takes the mean over all of them; what is not finite keeps its constant harmonic.
    """
    bands = min(gaussians.degree, 3) + 1
    shape = (gaussians.means, gaussians.quaternions, gaussians.log_scales, gaussians.logits)
    functions = torch.zeros(len(gaussians), bands**2)
    opacities = torch.zeros(len(gaussians), 1)
    weights = torch.zeros(len(gaussians), 1)
    near = clip_distance(gaussians)
    # Sums over views, each by the Gaussian's weight in its pixels; what none shows weighs the same in all of
    # them.
    count = min(_MAX_MEAN_VIEWS, len(cameras))
    for view in torch.linspace(0, len(cameras) - 1, count).round().long().tolist():
        camera = covering(cameras, view, near)
        direction = torch.nn.functional.normalize(gaussians.means - cameras.pose[view, :, 3].float(), dim=1)
        pixels = torch.ones(camera.height, camera.width, 1)
        weight = _UNSEEN_PIXELS + lift(*shape, camera, pixels, antialiased=antialiased)
        functions += weight * spherical_harmonics(direction, bands)
        opacities += weight * project_reference(*shape, camera, antialiased=antialiased).opacity[:, None]
        weights += weight
    # A Gaussian without finite numbers has no weight either.
    constant = torch.zeros(bands**2)
    constant[0] = HARMONIC
    finite = functions.isfinite().all(1, keepdim=True)
    means = torch.where(finite, functions / weights, constant)
    return SeenMeans(means, (opacities / weights)[:, 0], weights[:, 0])
