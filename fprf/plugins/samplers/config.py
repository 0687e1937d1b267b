"""Sampler configs. `build` imports the implementation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from ...checks import at_least, between, positive
from ...errors import ConfigError
from ..config import PluginConfig

if TYPE_CHECKING:
    from ...interfaces import Sampler


@dataclass(frozen=True, kw_only=True)
class SamplerConfig(PluginConfig):
    """Places the samples of a ray."""

    group: ClassVar[str] = "fprf.samplers"

    def build(self, *, seed: int) -> Sampler:
        """The sampler, its parameters drawn from the seed."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class UniformConfig(SamplerConfig):
    """Even spacing in the space's own measure, no proposal."""

    samples: int = 128
    """Samples per ray."""

    def __post_init__(self) -> None:
        at_least("sampler.samples", self.samples, 1)

    def build(self, *, seed: int) -> Sampler:
        from .samplers import ProposalSampler

        return ProposalSampler(ProposalConfig(samples=(), resolutions=(), final=self.samples), seed=seed)


@dataclass(frozen=True, kw_only=True)
class ProposalConfig(SamplerConfig):
    """Proposal sampling (mip-NeRF 360): small density planes say where the field's samples go."""

    samples: tuple[int, ...] = (256, 128)
    """Samples per ray of each proposal level."""
    final: int = 48
    """Samples per ray that meet the content field."""
    resolutions: tuple[int, ...] = (128, 256)
    """Plane resolution of each level's density."""
    channels: int = 8
    """Channels of the proposal planes."""
    anneal_steps: int = 1000
    """Steps over which proposals sharpen from even to trusted."""
    anneal_slope: float = 10.0
    """Sharpness at first."""
    padding: float = 1e-3
    """Total probability spread evenly over a ray, so that no place is ruled out; above 0."""
    update_every: int = 5
    """After the warm-up the proposals learn every so many steps."""
    warm_up: int = 5000
    """Steps during which the proposals learn at each step, ever more rarely towards its end."""

    def __post_init__(self) -> None:
        at_least("sampler.final", self.final, 1)
        at_least("sampler.channels", self.channels, 1)
        positive("sampler.padding", self.padding)
        between("sampler.padding", self.padding, 0.0, 1.0)
        at_least("sampler.anneal_steps", self.anneal_steps, 0)
        at_least("sampler.warm_up", self.warm_up, 0)
        positive("sampler.anneal_slope", self.anneal_slope)
        at_least("sampler.update_every", self.update_every, 1)
        # A level is a pair of samples and a resolution.
        for n in (*self.samples, *self.resolutions):
            at_least("sampler.samples and resolutions", n, 2)
        if len(self.samples) != len(self.resolutions):
            levels = len(self.samples)
            resolutions = len(self.resolutions)
            raise ConfigError(
                f"sampler.samples: {levels} levels but {resolutions} in sampler.resolutions; name as many of each"
            )

    def build(self, *, seed: int) -> Sampler:
        from .samplers import ProposalSampler

        return ProposalSampler(self, seed=seed)
