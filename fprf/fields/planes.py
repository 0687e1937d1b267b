"""Fields on tri-planes (`ops.triplane`): content and density, semantics (paper), and the proposals of the
sampler.

A point x of the cube [-1, 1]^3 has at each scale the product over three planes, P_xy(x, y) P_xz(x, z) P_yz(y,
z), of their bilinear samples there (K-Planes, Fridovich-Keil et al. 2023, Section 3.1); the features of all
scales side by side are its latent. Density is exp of a linear map of the latent; content and semantics are
networks on it.

N points · M samples of rays that are kept · L = scales x channels of the latent · C content channels · D
semantic channels. Inputs are float32 on any device; density is per unit of the scene's space.
"""

import math
from collections.abc import Sequence
from typing import Annotated, Any

import torch
from torch import Tensor, nn

from ..interfaces import ContentField, Decoder, SemanticField
from ..ops import dense, proposal, triplane
from ..ops.harmonics import spherical_harmonics
from ..rendering.space import Space
from ..types import FieldSample, Rays
from .config import PlanesConfig, SemanticPlanesConfig

MAX_LOG_DENSITY = 15.0
"""exp(15) = 3e6 per space unit is opaque within a micro-unit: above it nothing looks different, and gradients
of exp would overflow.
"""


class _Exp(torch.autograd.Function):
    """exp whose gradient is bounded on both sides, so that what is opaque or empty can still change."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return x.clamp(max=MAX_LOG_DENSITY).exp()

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Tensor:
        (x,) = ctx.saved_tensors
        result: Tensor = grads[0] * x.clamp(-MAX_LOG_DENSITY, MAX_LOG_DENSITY).exp()
        return result


def density(raw: Annotated[Tensor, "N"]) -> Annotated[Tensor, "N"]:
    """exp(raw - 1), capped at exp(15): the start is thin, so that light reaches the whole scene
    (K-Planes).
    """
    result: Tensor = _Exp.apply(raw - 1)  # type: ignore[no-untyped-call]
    return result


def linear(inputs: int, outputs: int, *, generator: torch.Generator) -> nn.Linear:
    """A linear map without bias, uniform in +-sqrt(3 / inputs): unit variance out for unit variance in."""
    layer = nn.Linear(inputs, outputs, bias=False)
    # A uniform draw within +-b has the variance b^2 / 3.
    bound = math.sqrt(3 / inputs)
    with torch.no_grad():
        layer.weight.uniform_(-bound, bound, generator=generator)
    return layer


def mlp(inputs: int, hidden: int, layers: int, outputs: int, *, generator: torch.Generator) -> nn.Sequential:
    """`layers` hidden ReLU layers of width `hidden`, then a linear one; hidden weights keep the variance
    through ReLU.
    """
    parts: list[nn.Module] = []
    for _ in range(layers):
        layer = linear(inputs, hidden, generator=generator)
        with torch.no_grad():
            # ReLU passes half of the variance (He et al. 2015).
            layer.weight.mul_(math.sqrt(2))
        parts += [layer, nn.ReLU(inplace=True)]
        inputs = hidden
    parts.append(linear(inputs, outputs, generator=generator))
    return nn.Sequential(*parts)


def weights(network: nn.Sequential) -> list[Tensor]:
    """Weights of each linear map, [outputs, inputs]."""
    found: list[Tensor] = []
    for layer in network:
        if isinstance(layer, nn.Linear):
            found.append(layer.weight)
    return found


class Planes(nn.Module):
    """Planes at several scales: points [N 3] to their latents [N L]; `out` is L."""

    def __init__(self, resolutions: Sequence[int], channels: int, *, generator: torch.Generator) -> None:
        super().__init__()
        self.resolutions = tuple(resolutions)
        self.out = len(self.resolutions) * channels
        # Positive start (K-Planes): a product of three zero-mean planes would start with no signal and no
        # gradient.
        table = torch.empty(triplane.rows(self.resolutions), channels).uniform_(0.1, 0.5, generator=generator)
        self.table = nn.Parameter(table)
        self.gradient: triplane.HeldGradient | None = None

    def hold_gradient(self) -> triplane.HeldGradient | None:
        """Let kernels add to one gradient of the table from step to step, where that is worth it; who trains
        clears it.
        """
        self.gradient = triplane.held(self.table)
        return self.gradient

    def forward(self, points: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N out"]:
        """Features, coarse scales first."""
        return triplane.lookup(points, self.table, self.resolutions, self.gradient)

    def density(
        self, points: Annotated[Tensor, "N 3"], weight: Annotated[Tensor, "out"]
    ) -> tuple[Annotated[Tensor, "N"], Annotated[Tensor, "N out"]]:
        """Density exp(latent . weight - 1) per space unit, and the latent.

        One linear map, no network: cheap enough for every sample of every ray, most of which are empty.
        """
        if dense.usable(points, self.table, weight) and triplane.usable(points, self.table):
            return triplane.weighed(points, self.table, self.resolutions, weight, limit=MAX_LOG_DENSITY)
        latent = self(points)
        return density(latent @ weight), latent

    def variation(self) -> Tensor:
        """Total variation: mean squared difference of neighbouring nodes, summed over scales."""
        return triplane.variation(self.table, self.resolutions, self.gradient)


class PlanesField(ContentField):
    """K-Planes content field. Density bypasses the network, so that it is cheap where nothing is seen."""

    def __init__(self, config: PlanesConfig, *, channels: int, seed: int) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        self.degree = config.degree
        self.planes = Planes(config.resolutions, config.channels, generator=generator)
        self.to_density = linear(self.planes.out, 1, generator=generator)
        inputs = self.planes.out + config.degree**2
        self.to_content = mlp(inputs, config.hidden, config.layers, channels, generator=generator)
        # Decoders expect features of about their training scale: the offset learns their mean.
        self.offset = nn.Parameter(torch.zeros(channels))

    def density(self, points: Annotated[Tensor, "N 3"]) -> FieldSample:
        """Density per space unit; the latent is the plane feature."""
        return FieldSample(*self.planes.density(points, self.to_density.weight[0]))

    def content(
        self, latent: Annotated[Tensor, "M L"], view: Annotated[Tensor, "M 3"]
    ) -> Annotated[Tensor, "M C"]:
        """Content features seen from a direction, f(latent, harmonics(view)) + offset."""
        maps = weights(self.to_content)
        return self._network(latent, view, maps, [None] * (len(maps) - 1) + [self.offset])

    def colour(
        self, latent: Annotated[Tensor, "M L"], view: Annotated[Tensor, "M 3"], decoder: Decoder
    ) -> Annotated[Tensor, "M 3"]:
        """The content, decoded; two linear maps in a row, the last of the content and the first of the
        decoder, are one.
        """
        layers = decoder.layers
        if layers is None or torch.is_grad_enabled():
            return super().colour(latent, view, decoder)
        *maps, last = weights(self.to_content)
        (first, shift), *rest = layers
        joined = first @ self.offset
        if shift is not None:
            joined = joined + shift
        biases = [None] * len(maps) + [joined] + [b for _, b in rest]
        return torch.sigmoid(
            self._network(latent, view, [*maps, first @ last, *(w for w, _ in rest)], biases)
        )

    def _network(
        self,
        latent: Annotated[Tensor, "M L"],
        view: Annotated[Tensor, "M 3"],
        maps: list[Tensor],
        biases: Sequence[Tensor | None],
    ) -> Annotated[Tensor, "M O"]:
        # Samples of one ray follow each other and share the direction: what it adds is computed once a ray.
        first, run = dense.runs(view)
        shared = spherical_harmonics(view.index_select(0, first), self.degree)
        return dense.network(latent, maps, biases, shared=shared, row=run)

    def penalties(self) -> dict[str, Tensor]:
        """'variation' of the planes."""
        return {"variation": self.planes.variation()}


class SemanticPlanes(SemanticField):
    """K-Planes semantic field."""

    def __init__(self, config: SemanticPlanesConfig, *, channels: int, seed: int) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        self.planes = Planes(config.resolutions, config.channels, generator=generator)
        self.network = mlp(self.planes.out, config.hidden, config.layers, channels, generator=generator)

    def forward(self, points: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N D"]:
        maps = weights(self.network)
        return dense.network(self.planes(points), maps, [None] * len(maps))

    def penalties(self) -> dict[str, Tensor]:
        """None: semantics need no smoothing beyond the planes' own resolution."""
        return {}


class ProposalField(nn.Module):
    """One scale of small planes and a linear map to density."""

    def __init__(self, resolution: int, channels: int, *, seed: int) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        self.planes = Planes((resolution,), channels, generator=generator)
        self.to_density = linear(self.planes.out, 1, generator=generator)

    def forward(self, points: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N"]:
        """Density per space unit at points of the unit cube."""
        return self.planes.density(points, self.to_density.weight[0])[0]

    def compiled(self, *given: Tensor) -> bool:
        """True where `propose` applies to rays and edges: on the CPU, in float32, whole vectors of channels."""
        return triplane.usable(given[0], self.planes.table) and proposal.usable(*given, learns=False)

    def propose(
        self,
        rays: Rays,
        s: Annotated[Tensor, "R E"],
        space: Space,
        count: int,
        *,
        padding: float,
        shift: Annotated[Tensor, "R 1"],
    ) -> Annotated[Tensor, "R count+1"]:
        """Edges at even steps of the weights that this density gives to the steps between edges s; nothing
        learns.
        """
        (size,) = self.planes.resolutions
        return proposal.propose(
            *(rays.origin, rays.direction, rays.near, rays.far, s, space.warp, self.planes.table, size),
            self.to_density.weight[0],
            limit=MAX_LOG_DENSITY,
            count=count,
            padding=padding,
            shift=shift,
        )
