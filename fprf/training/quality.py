"""Presets of rendering time: settings that change without training again. Imports no torch at first.

Only the resolution is worth a knob (`python -m benchmarks pareto`, on fox): 1.5 times the samples along rays
took 1.5 times the time for 0.1 dB, half of them cost 3.6 dB; error budgets of 0 to 1/256 differ by 17 % of
the time and 0.01 dB.
"""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, NamedTuple, TypeAlias

from ..checks import between, positive
from ..errors import UsageError
from ..plugins.conversion import convert_fields

if TYPE_CHECKING:
    from .camera_optimizers import Tones
    from .field_scene import Trained
    from .run import Known

Name: TypeAlias = Literal["draft", "standard", "best"]


class Preset(NamedTuple):
    """A point on the curve of time against error."""

    resolution: float = 1.0
    """Share of an image's width and height that is rendered."""
    merged: float = 0.0
    """Pixels within which Gaussians are drawn as one."""


PRESETS: dict[Name, Preset] = {
    "draft": Preset(resolution=0.5, merged=2.0),
    "standard": Preset(merged=2.0),
    "best": Preset(),
}
"""Settings of each name; the module says what measured them."""


@dataclass(frozen=True, kw_only=True)
class QualityConfig:
    """Limit of the time for an image."""

    quality: Name | None = None
    """draft, standard or best; none = as the run's own config says."""
    resolution: float | None = None
    """Share of an image's width and height that is rendered, in (0, 1]; the rest is interpolated; none = what
    the quality says.
    """
    max_memory: float | None = None
    """MiB that blocks of a large scene may take together; the least recently used make room. none = all
    stay.
    """
    tone: str | None = None
    """Training view in whose light to show the scene, by name or number; none = the light that all views have
    in common. For runs with learnt `tones`.
    """

    def __post_init__(self) -> None:
        convert_fields(self)
        if self.max_memory is not None:
            positive("max_memory", self.max_memory)
        if self.resolution is not None:
            positive("resolution", self.resolution)
            between("resolution", self.resolution, 0.0, 1.0)


def at_quality(trained: "Trained", quality: QualityConfig) -> "Trained":
    """The run with other limits; the same one where nothing is asked. Raises UsageError where it has no such
    tone.
    """
    render = trained.config.render
    # A resolution that is asked for goes before that of the preset.
    if quality.resolution is not None:
        render = replace(render, resolution=quality.resolution)
    elif quality.quality is not None:
        render = replace(render, resolution=PRESETS[quality.quality].resolution)
    if quality.tone is not None:
        render = replace(render, tone=tone_of(trained.model.tones, trained.known, quality.tone))
    return replace(trained, config=replace(trained.config, render=render))


def tone_of(tones: "Tones | None", known: "Known", text: str) -> tuple[float, float, float]:
    """Factors of a training view, by name, or by number where no name is alike. Raises UsageError for
    others.
    """
    if tones is None:
        raise UsageError(
            "tone: this run has learnt no tones; train it with --tones true, or leave --tone out"
        )
    # Names of views may be numbers themselves: a name comes before a number.
    if text in known.names:
        view = known.names.index(text)
    elif text.isdecimal():
        view = int(text)
    else:
        view = -1
    if view not in known.train:
        few = ", ".join(known.names[k] for k in known.train[:3])
        raise UsageError(
            f"tone: {text!r} is no training view; the {len(known.train)} are {few} ..., or their numbers"
        )
    from torch import tensor

    red, green, blue = tones(tensor([view]))[0].tolist()
    return red, green, blue
