"""The renderer against a loop over rays and samples, and its promises: error budget, strength 0, what moves
density.
"""

import itertools
import math
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn

from fprf.fields.config import PlanesConfig, SemanticPlanesConfig
from fprf.interfaces import ContentField, Decoder, Parts, SemanticField, Stylizer
from fprf.plugins.samplers.config import ProposalConfig, UniformConfig
from fprf.rendering.renderer import TrainingStep, march, render_rays
from fprf.rendering.space import Kind, Space
from fprf.rendering.stepfun import midpoints
from fprf.style.look import Restyle
from fprf.types import FieldSample, Rays, Rendered, Want

EYE = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
C = 5
D = 3


class Squash(Decoder):
    """The first three channels through a sigmoid."""

    def forward(self, content: Tensor) -> Tensor:
        return torch.sigmoid(content[:, :3])


class Uniform(ContentField):
    """One density everywhere, or one for each of the samples; one content everywhere."""

    def __init__(self, density: float | Tensor, content: float = 0.0) -> None:
        super().__init__()
        self.value = nn.Parameter(torch.as_tensor(density))
        self.feature = content

    def density(self, points: Tensor) -> FieldSample:
        return FieldSample(self.value.expand(len(points)), points)

    def content(self, latent: Tensor, view: Tensor) -> Tensor:
        return latent.new_full((len(latent), C), self.feature)

    def penalties(self) -> dict[str, Tensor]:
        return {}


class Ones(SemanticField):
    """Semantics of 1 everywhere: a render of them is the opacity."""

    def forward(self, points: Tensor) -> Tensor:
        return points.new_ones(len(points), D)

    def penalties(self) -> dict[str, Tensor]:
        return {}


class Shift(Stylizer):
    """Adds 1, and the semantics' sum where it reads them. Remembers what it was given."""

    def __init__(self, reads: bool = False) -> None:
        super().__init__()
        self.reads = reads
        self.points: list[int] = []

    @property
    def needs(self) -> Want:
        return Want.CONTENT | Want.SEMANTIC if self.reads else Want.CONTENT

    def forward(self, content: Tensor, semantic: Tensor | None) -> Tensor:
        assert (semantic is not None) == self.reads
        self.points.append(len(content))
        return content + 1 + (0 if semantic is None else semantic.sum(-1, keepdim=True))

    def match(self, semantic: Tensor) -> Tensor:
        return semantic.new_ones(len(semantic), 1)


class Never(nn.Module):
    """Stands where nothing may be computed."""

    def __getattr__(self, name: str) -> Any:
        if name in ("density", "content", "needs"):
            raise AssertionError(f"{name} must not be asked for")
        return super().__getattr__(name)

    def forward(self, *given: Tensor) -> Tensor:
        raise AssertionError("must not be called")


def space_of(kind: Kind) -> Space:
    return Space(kind, (0.0, 0.0, 0.0), EYE, 1.0, 0.05, 1e3, focal=(1.5, 1.5))


def parts_of(
    kind: Kind = "contraction", seed: int = 0, thickness: float = 3.0, proposal: bool = False
) -> Parts:
    sampler = (
        ProposalConfig(samples=(12,), final=9, resolutions=(6,)) if proposal else UniformConfig(samples=17)
    )
    field = PlanesConfig(resolutions=(4, 9), channels=8, hidden=16).build(channels=C, seed=seed)
    with torch.no_grad():
        for name, weight in field.named_parameters():
            if "to_density" in name or "table" in name:
                weight.mul_(thickness)
    semantic = SemanticPlanesConfig(resolutions=(4,), channels=8, hidden=16).build(channels=D, seed=seed + 1)
    return Parts(space_of(kind), sampler.build(seed=seed), field, semantic, Squash())


def rays_of(kind: Kind, count: int, seed: int = 0) -> Rays:
    draw = torch.Generator().manual_seed(seed)
    origin = torch.randn(count, 3, dtype=torch.float64, generator=draw) * 0.3
    direction = torch.randn(count, 3, dtype=torch.float64, generator=draw)
    if kind == "ndc":
        direction = direction * 0.2 - torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    return space_of(kind).rays(origin, direction / direction.norm(dim=-1, keepdim=True))


ALL = Want.DENSITY | Want.COLOUR | Want.CONTENT | Want.SEMANTIC


def composite_oracle(
    rays: Rays, parts: Parts, rendered: Rendered, restyle: Restyle | None
) -> list[dict[str, Any]]:
    """One ray and one sample at a time, fp64 but for what the fields themselves say."""
    assert rendered.sampled is not None and parts.semantic is not None
    result = []
    for r in range(len(rays.near)):
        t = rendered.sampled.t[r].tolist()
        middle = [(near + far) / 2 for near, far in itertools.pairwise(t)]
        points = parts.space.locate(torch.stack([rays.origin[r] + rays.direction[r] * m for m in middle]))
        sample = parts.field.density(points)
        semantic = parts.semantic(points)
        content = parts.field.content(sample.latent, rays.view[r].expand(len(points), 3))
        styled = content
        if restyle is not None:
            given = semantic if Want.SEMANTIC in restyle.stylizer.needs else None
            styled = content + restyle.strength * (restyle.stylizer(content, given) - content)
        values = {"rgb": parts.decoder(styled), "content": content, "semantic": semantic}
        sums = {name: torch.zeros(value.shape[1], dtype=torch.float64) for name, value in values.items()}
        before = depth = total = 0.0
        for k, m in enumerate(middle):
            tau = float(sample.density[k]) * (t[k + 1] - t[k])
            weight = math.exp(-before) * -math.expm1(-tau)
            before += tau
            for name, value in values.items():
                sums[name] += weight * value[k].double()
            depth = depth + weight * m
            total = total + weight
        result.append(
            sums | {"depth": depth / total, "opacity": -math.expm1(-before), "through": math.exp(-before)}
        )
    return result


@torch.no_grad()
@pytest.mark.parametrize(
    ("kind", "proposal", "restyle"),
    [
        ("contraction", True, Restyle(Shift(reads=True), 0.4)),
        ("box", False, None),
        ("ndc", False, Restyle(Shift(), 1.0)),
    ],
)
def test_a_render_is_the_loop_over_rays_and_samples(
    kind: Kind, proposal: bool, restyle: Restyle | None
) -> None:
    parts = parts_of(kind, proposal=proposal)
    rays = rays_of(kind, 5)
    background = torch.tensor([0.9, 0.1, 0.4])
    found = render_rays(rays, parts, want=ALL, budget=0.0, restyle=restyle, background=background)
    assert found.rgb is not None and found.content is not None and found.semantic is not None
    for r, wanted in enumerate(composite_oracle(rays, parts, found, restyle)):
        # Positions are float32: densities differ by their slope times that, colours by as much.
        colour = wanted["rgb"] + wanted["through"] * background.double()
        assert torch.allclose(found.rgb[r].double(), colour, atol=2e-5)
        assert torch.allclose(found.content[r].double(), wanted["content"], atol=1e-4, rtol=1e-4)
        assert torch.allclose(found.semantic[r].double(), wanted["semantic"], atol=1e-4, rtol=1e-4)
        assert float(found.opacity[r]) == pytest.approx(wanted["opacity"], abs=1e-5)
        assert float(found.depth[r]) == pytest.approx(wanted["depth"], rel=1e-4)


@settings(max_examples=15)
@given(st.integers(0, 9999), st.sampled_from([1e-4, 1 / 512, 0.02, 0.3]), st.floats(0.3, 6.0))
def test_the_budget_bounds_the_colour_error(seed: int, budget: float, thickness: float) -> None:
    parts = parts_of(seed=seed, thickness=thickness)
    rays = rays_of("contraction", 24, seed)
    with torch.no_grad():
        exact, quick = (render_rays(rays, parts, want=Want.COLOUR, budget=b) for b in (0.0, budget))
    assert exact.rgb is not None and quick.rgb is not None
    assert (exact.rgb - quick.rgb).abs().max() <= budget + 1e-6
    assert torch.equal(exact.opacity, quick.opacity) and torch.equal(exact.depth, quick.depth)
    assert quick.counts["kept"] <= exact.counts["kept"] <= exact.counts["samples"] == 24 * 17
    assert quick.weights is not None
    assert quick.counts["kept"] == int((quick.weights > 0).sum()) or budget > 0


@torch.no_grad()
def test_style_changes_colour_alone_and_sees_only_what_is_kept() -> None:
    parts = parts_of()
    rays = rays_of("contraction", 16)
    stylizer = Shift(reads=True)
    plain = render_rays(rays, parts, want=ALL, budget=0.05)
    styled = render_rays(rays, parts, want=ALL, budget=0.05, restyle=Restyle(stylizer))
    for name in ("content", "semantic", "depth", "opacity"):
        assert torch.equal(getattr(plain, name), getattr(styled, name))
    assert plain.rgb is not None and styled.rgb is not None and not torch.equal(plain.rgb, styled.rgb)
    assert stylizer.points == [styled.counts["kept"]] and styled.counts["kept"] < styled.counts["samples"]


def gradients(loss: Tensor, module: nn.Module) -> list[Tensor | None]:
    return list(torch.autograd.grad(loss, list(module.parameters()), allow_unused=True, retain_graph=True))


def test_semantics_never_move_density() -> None:
    parts = parts_of(proposal=True)
    rays = rays_of("contraction", 12)
    found = render_rays(rays, parts, want=ALL, budget=0.0, training=TrainingStep(step=0, semantic_samples=4))
    assert found.semantic is not None and found.rgb is not None and parts.semantic is not None
    assert all(g is None for g in gradients(found.semantic.square().sum(), parts.field))
    assert all(g is None for g in gradients(found.semantic.square().sum(), parts.sampler))
    assert all(g is not None and g.any() for g in gradients(found.semantic.square().sum(), parts.semantic))
    assert all(g is None for g in gradients(found.rgb.sum(), parts.semantic))


@pytest.mark.parametrize("moves", [False, True])
def test_content_moves_density_only_where_it_may(moves: bool) -> None:
    parts = parts_of()
    rays = rays_of("contraction", 12)
    found = render_rays(rays, parts, want=ALL, budget=0.0, training=TrainingStep(content_moves_density=moves))
    assert found.content is not None and found.rgb is not None
    reached = dict(
        zip(
            dict(parts.field.named_parameters()),
            gradients(found.content.square().sum(), parts.field),
            strict=True,
        )
    )
    assert (reached["to_density.weight"] is not None) == moves
    assert all(g is not None and g.any() for name, g in reached.items() if "to_density" not in name)
    assert all(g is not None and g.any() for g in gradients(found.rgb.square().sum(), parts.field))


@pytest.mark.parametrize("density", [0.0, 0.1, 1e4])
def test_a_background_is_seen_through_and_density_learns_from_it(density: float) -> None:
    """Colour c (1 - e^-x) + b e^-x over a length L, x = density L; its derivative is L (c - b) e^-x."""
    parts = Parts(
        space_of("box"), UniformConfig(samples=8).build(seed=0), Uniform(density, 0.3), None, Squash()
    )
    ahead = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    rays = parts.space.rays(-2 * ahead, ahead)
    background = torch.tensor([1.0, 0.5, 0.0])
    colour = 1 / (1 + math.exp(-0.3))
    through = math.exp(-2 * density)
    found = render_rays(rays, parts, want=Want.COLOUR, budget=0.0, background=background)
    assert found.rgb is not None
    assert torch.allclose(
        found.rgb, (colour * -math.expm1(-2 * density) + background * through)[None], atol=1e-6
    )
    assert float(found.opacity) == pytest.approx(-math.expm1(-2 * density), rel=1e-6)
    if density == 0:
        assert torch.equal(found.rgb[0], background)
        return  # nothing is kept, so that only samples of some weight learn
    for channel in range(3):
        (gradient,) = gradients(found.rgb[0, channel], parts.field)
        assert gradient is not None
        assert float(gradient) == pytest.approx(
            2 * (colour - float(background[channel])) * through, rel=1e-4, abs=1e-6
        )


@torch.no_grad()
@pytest.mark.parametrize(("samples", "count"), [(None, None), (1, 5), (3, 0), (99, None)])
def test_semantics_of_some_rays_and_samples_keep_the_opacity(samples: int | None, count: int | None) -> None:
    parts = parts_of()._replace(semantic=Ones())
    rays = rays_of("contraction", 9)
    some = TrainingStep(semantic_rays=count, semantic_samples=samples)
    found = render_rays(rays, parts, want=Want.SEMANTIC, budget=0.0, training=some)
    assert found.semantic is not None
    assert found.semantic.shape == (9 if count is None else count, 3)
    wanted = found.opacity[: len(found.semantic), None].expand_as(found.semantic)
    assert torch.allclose(found.semantic, wanted, atol=1e-5)


@torch.no_grad()
def test_nothing_is_computed_that_nobody_wants() -> None:
    parts = parts_of()
    rays = rays_of("contraction", 4)
    still = parts._replace(semantic=Never(), decoder=Never())  # type: ignore[arg-type]
    found = render_rays(rays, still, want=Want.DENSITY, budget=0.0)
    assert found.rgb is None and found.content is None and found.semantic is None
    assert found.depth.shape == found.opacity.shape == (4,)
    found = render_rays(rays, still, want=Want.CONTENT, budget=0.0)
    assert found.content is not None and found.rgb is None
    found = render_rays(rays, parts._replace(semantic=None), want=ALL, budget=0.0)
    assert found.rgb is not None and found.semantic is None
    found = render_rays(
        rays, parts._replace(semantic=Never()), want=Want.COLOUR, budget=0.0, restyle=Restyle(Shift())
    )  # type: ignore[arg-type]
    assert found.rgb is not None


@pytest.mark.parametrize("kind", ["contraction", "box"])
def test_near_densities_learn_by_the_square_of_their_distance(kind: Kind) -> None:
    field = Uniform(torch.rand(4 * 64, generator=torch.Generator().manual_seed(0)))
    parts = Parts(space_of(kind), UniformConfig(samples=64).build(seed=0), field, None, Squash())
    rays = parts.space.rays(torch.zeros(4, 3).double(), torch.tensor([[0.0, 0.6, 0.8]]).double().expand(4, 3))

    def gradient(step: int | None) -> Tensor:
        (grad,) = torch.autograd.grad(
            march(rays, parts, budget=0.0, step=step).weights.square().sum(), field.value
        )
        return grad.view(4, -1)

    plain = gradient(None)
    training = gradient(0)
    middle = midpoints(march(rays, parts, budget=0.0).sampled.t)
    share = (
        (middle / (4 * rays.near[:, None])).square().clamp(max=1)
        if kind == "contraction"
        else torch.ones(4, 64)
    )
    assert bool((share < 0.5).any()) == (kind == "contraction")
    torch.testing.assert_close(training, plain * share, rtol=1e-5, atol=1e-9)


def test_a_pose_learns_from_what_is_seen_but_not_from_semantics() -> None:
    """Rays that want gradients are rendered as the same rays without, and where samples lie moves nothing."""
    parts = parts_of(proposal=True)
    still = rays_of("contraction", 6)
    moved = still._replace(origin=still.origin.clone().requires_grad_(True))
    want = Want.CONTENT | Want.COLOUR | Want.SEMANTIC
    one, other = (render_rays(rays, parts, want=want, budget=0.0) for rays in (still, moved))
    for name in ("rgb", "content", "semantic", "depth"):
        assert torch.allclose(getattr(one, name), getattr(other, name), atol=2e-6), name
    assert other.content is not None and other.semantic is not None and other.sampled is not None
    (gradient,) = torch.autograd.grad(other.content.square().sum(), moved.origin, retain_graph=True)
    assert gradient.isfinite().all() and (gradient.norm(dim=1) > 0).all()
    assert torch.autograd.grad(other.semantic.sum(), moved.origin, allow_unused=True, retain_graph=True) == (
        None,
    )
    assert not other.sampled.t.requires_grad
