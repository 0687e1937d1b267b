"""The renderer at its edges: no rays, and gradients near the camera."""

import pytest
import torch
import toy_parts as toys
from torch import Tensor, nn

from fprf.interfaces import ContentField, Decoder
from fprf.plugins.samplers.config import UniformConfig
from fprf.rendering.renderer import Parts, march, render_rays
from fprf.rendering.space import Kind, Space
from fprf.rendering.stepfun import midpoints, scale_gradient
from fprf.types import FieldSample, Rays, Want

pytestmark = pytest.mark.usefixtures("form")
EYE = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
NEAR = 0.1


class Told(ContentField):
    """The densities that it was given, sample by sample."""

    def __init__(self, values: Tensor) -> None:
        super().__init__()
        self.values = nn.Parameter(values)

    def density(self, points: Tensor) -> FieldSample:
        return FieldSample(self.values[: len(points)], points)

    def content(self, latent: Tensor, view: Tensor) -> Tensor:
        return latent

    def penalties(self) -> dict[str, Tensor]:
        return {}


class Plain(Decoder):
    def forward(self, content: Tensor) -> Tensor:
        return content.sigmoid()

    def restyled(self, content: Tensor, styled: Tensor, strength: float | Tensor) -> Tensor:
        return self(styled)

    def frozen_colour(self, content: Tensor) -> None:
        return None


def parts_of(kind: Kind, samples: int) -> Parts:
    values = torch.rand(4 * samples, generator=torch.Generator().manual_seed(0))
    space = Space(kind, (0.0, 0.0, 0.0), EYE, 1.0, NEAR, 1e3)
    return Parts(space, UniformConfig(samples=samples).build(seed=0), Told(values), None, Plain())


def rays_of(parts: Parts, count: int) -> Rays:
    origin = torch.zeros(count, 3, dtype=torch.float64)
    direction = torch.tensor([[0.0, 0.6, 0.8]], dtype=torch.float64).expand(count, 3)
    return parts.space.rays(origin, direction)


@torch.no_grad()
def test_no_rays() -> None:
    parts = parts_of("contraction", 8)
    found = render_rays(rays_of(parts, 0), parts, want=Want.COLOUR, budget=0.1, background=torch.ones(3))
    assert found.rgb is not None and found.rgb.shape == (0, 3)
    assert found.counts == {"rays": 0, "samples": 0, "kept": 0}


def test_scaled_gradients_leave_values_alone() -> None:
    x = torch.randn(5, 3, dtype=torch.float64, requires_grad=True)
    scale = torch.rand(5, 1, dtype=torch.float64)
    y = scale_gradient(x, scale)
    assert torch.equal(y, x)
    (grad,) = torch.autograd.grad((y * y).sum(), x)
    torch.testing.assert_close(grad, 2 * x.detach() * scale)


@pytest.mark.parametrize("kind", ["contraction", "box"])
def test_near_densities_learn_by_the_square_of_their_distance(kind: Kind) -> None:
    parts = parts_of(kind, 64)
    rays = rays_of(parts, 4)
    assert isinstance(parts.field, Told)

    def gradient(step: int | None) -> Tensor:
        marched = march(rays, parts, budget=0.0, step=step)
        assert isinstance(parts.field, Told)
        (grad,) = torch.autograd.grad(marched.weights.square().sum(), parts.field.values)
        return grad.view(4, -1)

    plain, training = gradient(None), gradient(0)
    middle = midpoints(march(rays, parts, budget=0.0).sampled.t)
    share = (middle / (4 * rays.near[:, None])).square().clamp(max=1) if kind == "contraction" else torch.ones(4, 64)
    assert bool((share < 0.5).any()) == (kind == "contraction")
    torch.testing.assert_close(training, plain * share, rtol=1e-5, atol=1e-9)


def test_near_features_learn_by_the_square_of_their_distance() -> None:
    """Each kept feature's gradient is its weight times its own share, sample by sample."""
    parts, rays = parts_of("contraction", 16), rays_of(parts_of("contraction", 16), 4)
    kept = march(rays, parts, budget=0.02, step=0).kept
    assert kept.gradient_scale is not None
    t = march(rays, parts, budget=0.02).sampled.t
    share = (midpoints(t) / (4 * rays.near[:, None])).square().clamp(max=1)
    whole = march(rays, parts, budget=0.0).weights
    index = [int((whole[r] - w).abs().argmin()) for r, w in zip(kept.ray.tolist(), kept.weight, strict=True)]
    assert len(kept.gradient_scale) < share.numel()
    assert torch.allclose(kept.gradient_scale, share[kept.ray, torch.tensor(index)])


def test_a_pose_learns_from_what_is_seen_but_not_from_semantics() -> None:
    """Rays that want gradients are rendered as the same rays without, and where samples lie moves nothing."""
    parts = toys.parts_of(proposal=True)
    still = toys.rays_of("contraction", 6)
    moved = still._replace(origin=still.origin.clone().requires_grad_(True))
    want = Want.CONTENT | Want.COLOUR | Want.SEMANTIC
    one, other = (render_rays(rays, parts, want=want, budget=0.0) for rays in (still, moved))
    for name in ("rgb", "content", "semantic", "depth"):
        assert torch.allclose(getattr(one, name), getattr(other, name), atol=2e-6), name
    assert other.content is not None and other.semantic is not None and other.sampled is not None
    (gradient,) = torch.autograd.grad(other.content.square().sum(), moved.origin, retain_graph=True)
    assert gradient.isfinite().all() and (gradient.norm(dim=1) > 0).all()
    assert torch.autograd.grad(other.semantic.sum(), moved.origin, allow_unused=True, retain_graph=True) == (None,)
    assert not other.sampled.t.requires_grad


@torch.no_grad()
def test_where_nothing_is_semantics_are_nothing() -> None:
    parts = toys.parts_of()._replace(field=toys.Uniform(0.0))
    found = render_rays(toys.rays_of("contraction", 4), parts, want=Want.SEMANTIC | Want.DENSITY, budget=0.0)
    assert found.semantic is not None and not found.semantic.any() and found.depth.isfinite().all()


class Aided(toys.Squash):
    """A decoder with a part that helps it: alone it answers half."""

    def frozen_colour(self, content: Tensor) -> Tensor:  # type: ignore[override]
        return self(content) / 2


def test_training_also_renders_what_the_decoder_says_alone() -> None:
    parts, rays = toys.parts_of()._replace(decoder=Aided()), toys.rays_of("contraction", 4)
    behind = torch.tensor([0.2, 0.4, 0.6])
    found = render_rays(rays, parts, want=Want.COLOUR, budget=0.0, step=0, background=behind)
    transmittance = 1 - found.opacity[:, None]
    assert found.rgb is not None and found.frozen_rgb is not None
    assert torch.allclose(found.frozen_rgb - transmittance * behind, (found.rgb - transmittance * behind) / 2, atol=1e-5)
    assert render_rays(rays, parts, want=Want.COLOUR, budget=0.0).frozen_rgb is None
