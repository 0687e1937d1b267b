"""Contracts of samplers, fields and layouts of blocks."""

# A plug-in is asked whether it is of an abstract kind.
# mypy: disable-error-code="type-abstract"

import torch
from torch import nn

from ..blocks import routing
from ..blocks.config import LayoutConfig
from ..fields.config import ContentFieldConfig, SemanticFieldConfig
from ..interfaces import BlockLayout, ContentField, Sampler, SemanticField
from ..plugins.decoders.decoders import MlpDecoder
from ..plugins.samplers.config import SamplerConfig
from ..types import Rays, Sampled
from . import cases
from .configs import built
from .outputs import follows, penalties, pointwise, require, same, shares, tensor, trainable


def check_sampler(config: SamplerConfig) -> None:
    """Sorted edges between near and far, the same without a generator and with one of the same seed."""
    sampler, name = built(config, Sampler, lambda: config.build(seed=0))

    def sample(rays: Rays, seed: int | None) -> Sampled:
        generator = None
        if seed is not None:
            generator = torch.Generator().manual_seed(seed)
        found: Sampled = sampler(
            rays, space=cases.space(), step=None if seed is None else 10, generator=generator
        )
        return found

    # Views sample without a generator, training with one; a chunk may hold any number of rays.
    for count in (6, 1, 0):
        rays = cases.rays(count)
        for seed in (None, 3):
            sampled = sample(rays, seed)
            again = sample(rays, seed)
            require(
                sampled.t.shape[0] == count and sampled.t.shape[1] >= 2,
                f"{name}: t must be [R E], E = samples + 1",
            )
            tensor(sampled.s, tuple(sampled.t.shape), f"{name}: s")
            tensor(sampled.t, tuple(sampled.s.shape), f"{name}: t")
            same(
                again.t, sampled.t, 0.0, f"{name}: must be a function of the rays, the step and the generator"
            )
            # Weights are of the steps between edges: one that is out of order would be negative.
            for edges, low, high in (
                (sampled.s, torch.zeros(count), torch.ones(count)),
                (sampled.t, rays.near, rays.far),
            ):
                require(bool((edges.diff(dim=1) >= 0).all()), f"{name}: edges must be sorted")
                slack = 1e-4 * (high - low)[:, None]
                inside = (edges >= low[:, None] - slack) & (edges <= high[:, None] + slack)
                require(bool(inside.all()), f"{name}: edges must lie between near and far")
            for level in sampled.levels:
                tensor(
                    level.weights,
                    (count, level.s.shape[1] - 1),
                    f"{name}: weights of a proposal level",
                    low=0.0,
                )
    sampler.double()
    penalties(sampler, name)
    rays = Rays(*(x.double() for x in cases.rays(6)))
    for seed in (None, 3):
        follows(lambda seed=seed: sample(rays, seed).t, rays.near, f"{name}: t")  # type: ignore[misc]


def check_content_field(config: ContentFieldConfig) -> None:
    """Density at least 0, content of so many channels, a function of its seed, trainable in every
    parameter.
    """
    field, name = built(config, ContentField, lambda: config.build(channels=7, seed=0))
    points = cases.points(13)
    view = nn.functional.normalize(cases.normal(13, 3, seed=14), dim=1)
    # Density everywhere, content only of some points, by their latents: the parts that the renderer asks for.
    sample = field.density(points)
    tensor(sample.density, (13,), f"{name}: density", low=0.0)
    content = field.content(sample.latent, view)
    tensor(content, (13, 7), f"{name}: content")
    for some in (slice(4, 9), slice(0, 0)):
        part = field.content(sample.latent[some], view[some])
        same(part, content[some], 1e-4, f"{name}: content: a point must not depend on the others")
    pointwise(lambda some: field.density(some).density, points, name)
    trainable(field, sample.density.sum() + content.square().sum(), name)
    field.double()
    penalties(field, name)
    points = points.double()
    view = view.double()
    latent = field.density(points).latent
    follows(lambda: field.density(points).density, points, f"{name}: density")
    follows(lambda: field.content(latent, view), points, f"{name}: content")
    decoder = MlpDecoder(7, 5).double()
    with torch.no_grad():
        shown = field.colour(latent, view, decoder)
        same(
            shown, decoder(field.content(latent, view)), 1e-9, f"{name}: colour must be the content, decoded"
        )


def check_semantic_field(config: SemanticFieldConfig) -> None:
    """Features of so many channels, a function of its seed, trainable in every parameter."""
    field, name = built(config, SemanticField, lambda: config.build(channels=5, seed=0))
    points = cases.points(13)
    features = field(points)
    tensor(features, (13, 5), name)
    pointwise(lambda some: field(some), points, name)
    trainable(field, features.square().sum(), name)
    field.double()
    penalties(field, name)
    points = points.double()
    follows(lambda: field(points), points, name)


def check_layout(config: LayoutConfig) -> None:
    """Cells with room in them and one border, from any site, and weights of them that sum to 1 everywhere."""
    layout, name = built(config, BlockLayout, config.build)
    # A capture with a reconstruction, few views without one, and a single view.
    for site in (cases.site(40, 200), cases.site(3, 0), cases.site(1, 0)):
        cells = layout.cut(site)
        again = layout.cut(site)
        require(len(cells) > 0, f"{name}: at least one block is needed")
        for cell, other in zip(cells, again, strict=True):
            shapes = set()
            for each in (cell.low, cell.high, cell.border):
                shapes.add(tuple(each.shape))
            require(shapes == {(3,)}, f"{name}: low, high and border must be [3], found {shapes}")
            require(
                bool((cell.low < cell.high).all()),
                f"{name}: a cell's lowest corner must lie below its highest",
            )
            require(torch.equal(cell.border, cells[0].border), f"{name}: all cells must have the same border")
            turned = not torch.equal(cell.frame, torch.eye(3, dtype=torch.float64))
            require(not turned, f"{name}: cells must be boxes along the axes of the site")
            same = torch.equal(cell.low, other.low) and torch.equal(cell.high, other.high)
            require(same, f"{name}: must be deterministic")
        require(
            bool((cells[0].border > 0).all()) or len(cells) == 1,
            f"{name}: blocks need a border above 0 to blend in",
        )
        # Blocks and surroundings together must explain every place, also far outside.
        weight = routing.shares(4 * cases.points(64), cells).float()
        shares(weight, (64, len(cells) + 1), f"{name}: weights of cells and surroundings")
