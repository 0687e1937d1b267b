"""Presets of rendering time: settings that change without training again. Imports no torch at first.

A preset sets samples along rays, error budget and resolution; whoever gives one of them himself keeps it. Trained
parameters stay as they are. `python -m benchmarks pareto` shows each preset beside every single knob.
"""

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, NamedTuple, TypeAlias

from ..checks import at_least, between, positive
from ..errors import PluginError, UsageError

if TYPE_CHECKING:
    from .camera_optimizers import Tones
    from .loading import Trained
    from .run import Known

Name: TypeAlias = Literal["draft", "standard", "best"]


class Preset(NamedTuple):
    """A point on the curve of time against error."""

    samples: float
    """Samples along rays, relative to those of training."""
    budget: float
    """Largest weight per ray that may be dropped."""
    resolution: float = 1.0
    """Share of an image's width and height that is rendered."""
    merged: float = 0.0
    """Pixels within which Gaussians are drawn as one."""


PRESETS: dict[Name, Preset] = {
    # Half the samples would cost 5 dB on fox, half the size 2.7 dB, and the latter is faster.
    "draft": Preset(samples=1.0, budget=1 / 256, resolution=0.5, merged=2.0),
    "standard": Preset(samples=1.0, budget=1 / 512, merged=2.0),
    "best": Preset(samples=1.5, budget=1 / 1024),
}


@dataclass(frozen=True, kw_only=True)
class QualityConfig:
    """Limit of the time for an image."""

    quality: Name | None = None
    """draft, standard or best; none = as the run's own config says."""
    samples: float | None = None
    """Samples along rays, relative to those of training; none = what the quality says."""
    budget: float | None = None
    """Largest weight per ray that may be dropped (0 = exact); none = what the quality says."""
    resolution: float | None = None
    """Share of an image's width and height that is rendered, in (0, 1]; the rest is interpolated; none = what the quality
    says."""
    chunk: int | None = None
    """Rays rendered at a time on the CPU, and at least so many on an accelerator; none = as the run's own config says."""
    max_memory: float | None = None
    """MiB that blocks of a large scene may take together; the least recently used make room. none = all stay."""

    tone: tuple[str, ...] = ()
    """Training views in whose light to show the scene, by name or number; several, as VIEW=WEIGHT, for what lies between
    them. none = the light that all views have in common. For runs with learnt `tones`."""

    def __post_init__(self) -> None:
        if self.samples is not None:
            positive("samples", self.samples)
        if self.max_memory is not None:
            positive("max_memory", self.max_memory)
        if self.budget is not None:
            between("budget", self.budget, 0.0, 0.5)
        if self.resolution is not None:
            positive("resolution", self.resolution)
            between("resolution", self.resolution, 0.0, 1.0)
        if self.chunk is not None:
            at_least("chunk", self.chunk, 1)


def at_quality(trained: "Trained", quality: QualityConfig) -> "Trained":
    """The run with other sampling; the same one where nothing is asked. Raises PluginError or UsageError where its
    sampler cannot.
    """
    preset = PRESETS[quality.quality] if quality.quality is not None else None
    samples = quality.samples if quality.samples is not None else preset.samples if preset is not None else 1.0
    render = trained.config.render
    if preset is not None:
        render = replace(render, budget=preset.budget, resolution=preset.resolution)
    # What is asked for one by one goes before the preset.
    given = {name: value for name in ("budget", "resolution", "chunk") if (value := getattr(quality, name)) is not None}
    render = replace(render, **given)
    if quality.tone:
        render = replace(render, tone=mixed_tone(trained.model.tones, trained.known, quality.tone))
    config = replace(trained.config, render=render)
    if samples == 1:
        return replace(trained, config=config)
    return _resampled(replace(trained, config=config), samples)


def mixed_tone(tones: "Tones | None", known: "Known", texts: tuple[str, ...]) -> tuple[float, float, float]:
    """Factors of some training views, weighted; as they are, VIEW alone counts 1. Raises UsageError for none and for others."""
    if tones is None:
        raise UsageError("tone: this run has learnt no tones; train it with --tones true, or leave --tone out")
    views, weights = [], []
    for text in texts:
        # A name may hold an equals sign itself.
        name, _, share = text.rpartition("=") if text not in known.names else (text, "", "1")
        name, share = (text, "1") if not name else (name, share)
        # Views go by name, or by number where no name is alike.
        try:
            weight = float(share)
            view = known.names.index(name) if name in known.names else int(name)
        except ValueError:
            few = ", ".join(known.names[k] for k in known.train[:3])
            raise UsageError(f"tone: {text!r} is no view or VIEW=WEIGHT; views are {few} ..., or their numbers") from None
        if view not in known.train or not 0 <= weight < math.inf:
            why = "was not learnt from" if view not in known.train else "has no weight of at least 0"
            raise UsageError(f"tone: {text!r}: the view {why}; choose one of the {len(known.train)} training views")
        views.append(view)
        weights.append(weight)
    if not sum(weights):
        raise UsageError("tone: all weights are 0; give at least one view a weight")
    # Tones are mixed as logarithms: halfway between two exposures is their geometric mean.
    shares = tuple(weight / sum(weights) for weight in weights)
    red, green, blue = tones.mixed(tuple(views), shares).tolist()
    return red, green, blue


def _resampled(trained: "Trained", samples: float) -> "Trained":
    from ..blocks.fields import BlockedSampler
    from .checkpoint import misfit
    from .model import Model

    old = trained.model.sampler
    try:
        scaled = trained.config.sampler.scaled(samples)
    except NotImplementedError:  # a plug-in that does not say
        raise PluginError(f"samples: {type(trained.config.sampler).__name__} does not scale; leave --samples at 1") from None
    # The same parameters with other numbers of samples; a sampler whose parameters depend on these cannot.
    sampler = scaled.build(seed=trained.config.seed)
    if isinstance(old, BlockedSampler):  # what proposes lies in the blocks
        sampler = BlockedSampler(sampler, old.members, old.router)
    elif misfit(sampler, state := old.state_dict()) is None:
        sampler.load_state_dict(state)
    else:
        raise UsageError("samples: this run's sampler has learnt for its own number of samples; leave --samples at 1")
    parts = trained.model.parts._replace(sampler=sampler.requires_grad_(False).to(trained.model.device))
    model = Model(parts, trained.model.tones)
    return replace(trained, config=replace(trained.config, sampler=scaled), model=model.eval())
