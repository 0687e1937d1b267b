"""Inputs for the contracts: small, seeded, of every letter in `fprf.types`."""

from pathlib import Path
from typing import Annotated

import torch
from torch import Tensor

from ..datamanagers.scene import ParsedScene
from ..fields.config import PlanesConfig, SemanticPlanesConfig
from ..interfaces import Decoder, Parts
from ..io.images import write_image
from ..plugins.samplers.config import UniformConfig
from ..rendering.cameras import Cameras
from ..rendering.space import Space
from ..style.dictionary import StyleDictionary
from ..style.scene_style import SceneStyle
from ..types import Batch, Rays, Site


def uniform(*shape: int, seed: int) -> Tensor:
    """Uniform draws in [0, 1]. Every call in this package has a seed of its own, so that swapped arguments
    are seen.
    """
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed))


def normal(*shape: int, seed: int) -> Tensor:
    """Mean 0, deviation 1; seeds as in `uniform`."""
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def points(count: int) -> Annotated[Tensor, "N 3"]:
    """Points in the unit cube, among them its centre and two of its corners."""
    inner = 2 * uniform(count - 3, 3, seed=1) - 1
    return torch.cat([inner, torch.zeros(1, 3), torch.ones(1, 3), -torch.ones(1, 3)])


def rays(count: int) -> Rays:
    """Rays from outside the unit cube through it."""
    direction = torch.nn.functional.normalize(normal(count, 3, seed=2), dim=1)
    near = torch.full((count,), 0.5)
    far = torch.full((count,), 3.5)
    return Rays(origin=-2 * direction, direction=direction, view=direction, near=near, far=far)


def site(views: int, points: int) -> Site:
    """Cameras along a winding path, and points around them."""
    way = torch.linspace(-3, 3, views, dtype=torch.float64)
    position = torch.stack([way, 0.3 * torch.sin(2 * way), torch.zeros_like(way)], 1)
    spread = normal(points, 3, seed=16).double() * torch.tensor([3.0, 1.0, 0.3], dtype=torch.float64)
    return Site(
        position=position,
        rays=torch.full((views,), 640 * 480),
        points=spread,
        unit=10.0,
        seen=spread.repeat(2, 1) if points else None,
    )


def space() -> Space:
    """The unit cube as it is, for `rays`."""
    eye = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    return Space("box", centre=(0.0, 0.0, 0.0), rotation=eye, scale=1.0, near=0.5, far=3.5)


def capture(folder: Path) -> ParsedScene:
    """Five pictures of noise of several sizes, written to a folder; the second is held out."""
    sizes = torch.tensor([[24, 16], [30, 20], [18, 26], [24, 16], [12, 10]])
    paths = []
    for view in range(len(sizes)):
        paths.append(folder / f"{view}.png")
    for view, (width, height) in enumerate(sizes.tolist()):
        write_image(paths[view], (255 * uniform(height, width, 3, seed=30 + view)).byte().numpy())
    cameras = Cameras(
        pose=torch.eye(4, dtype=torch.float64)[:3].repeat(len(sizes), 1, 1),
        focal=torch.full((len(sizes), 2), 20.0, dtype=torch.float64),
        centre=sizes / 2.0,
        size=sizes,
        distortion=torch.zeros(len(sizes), 6, dtype=torch.float64),
        lens=torch.zeros(len(sizes), dtype=torch.int64),
    )
    train = torch.tensor([0, 2, 3, 4])
    test = torch.tensor([1])
    return ParsedScene(name="noise", paths=tuple(paths), cameras=cameras, train=train, test=test, alpha=False)


def parts() -> Parts:
    """Small networks in the unit cube: 7 content and 5 semantic channels."""
    field = PlanesConfig(resolutions=(4, 8), channels=2, hidden=8).build(channels=7, seed=0)
    semantic = SemanticPlanesConfig(resolutions=(4, 8), channels=2, hidden=8).build(channels=5, seed=0)
    return Parts(space(), UniformConfig(samples=8).build(seed=0), field, semantic, _Sigmoid())


def batch(count: int) -> Batch:
    """Targets of `rays` for `parts`; semantics of the first half."""
    view = torch.zeros(count, dtype=torch.int64)
    pixel = torch.full((count, 2), 0.5)
    return Batch(
        view, pixel, uniform(count, 3, seed=17), normal(count, 7, seed=3), normal(count // 2, 5, seed=4)
    )


class _Sigmoid(Decoder):
    """Three channels as colours."""

    def forward(self, content: Tensor) -> Tensor:
        return content[:, :3].sigmoid()


def dictionary(codes: int, channels: int, dims: int) -> StyleDictionary:
    """Style codes of one reference."""
    return StyleDictionary(
        keys=normal(codes, dims, seed=5),
        mean=normal(codes, channels, seed=6),
        covariance=_covariances(codes, channels, seed=7),
        share=torch.full((codes,), 1 / codes),
        reference=torch.zeros(codes, dtype=torch.int64),
        weight=torch.ones(codes),
        names=("reference",),
    )


def scene(regions: int, channels: int, dims: int) -> SceneStyle:
    """A scene of equally large regions."""
    covariances = _covariances(regions + 1, channels, seed=8)
    return SceneStyle(
        mean=normal(channels, seed=9),
        covariance=covariances[-1],
        keys=normal(regions, dims, seed=10),
        region_mean=normal(regions, channels, seed=11),
        region_covariance=covariances[:-1],
        share=torch.full((regions,), 1 / regions),
        semantic_mean=torch.zeros(dims),
        contacts=torch.full((regions, regions), 1 / regions**2),
    )


def _covariances(count: int, channels: int, seed: int) -> Annotated[Tensor, "N C C"]:
    factor = normal(count, channels, channels, seed=seed)
    return factor @ factor.mT / channels + 0.1 * torch.eye(channels)
