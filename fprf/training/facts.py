"""Facts about a scene from before its training: the part of scene.json that a model is rebuilt from."""

import dataclasses
from dataclasses import dataclass, replace
from typing import Any

from ..checks import between
from ..errors import CheckpointError
from ..plugins.codec import from_json
from ..rendering.north import North
from ..rendering.space import Space
from ..types import Origin

_MAX_CHANNELS = 2**16
"""Channels that a file may ask for: a spoilt one must not take all memory."""
_MAX_SPACE_DISTANCE = 1e30
"""Distance that a file may ask for, space units: float32 ends at 3.4e38."""


@dataclass(frozen=True, kw_only=True)
class FieldFacts:
    """Facts of a scene of fields: what they learn, and from which encoders."""

    channels: int
    """Content channels, at least 1."""
    dim: int = 0
    """Semantic channels; 0 = no semantics."""
    content_encoder: str = ""
    """Identity of the content encoder, to which the decoder belongs."""
    semantic_encoder: str = ""
    """Identity of the semantic encoder; empty without one."""
    content_scale: float = 1.0
    """RMS standard deviation of the content targets: the unit of the content loss."""
    semantic_scale: float = 1.0
    """RMS standard deviation of the semantic targets: the unit of the semantic loss."""

    def __post_init__(self) -> None:
        between("channels", self.channels, 1, _MAX_CHANNELS)
        between("dim", self.dim, 0, _MAX_CHANNELS)


@dataclass(frozen=True, kw_only=True)
class Facts:
    """Facts of a trained scene of any kind: enough to rebuild its model without images or encoders."""

    space: Space
    background: tuple[float, float, float] | None = None
    """Colour behind everything, if anything can be seen through."""
    exposure: tuple[float, ...] = ()
    """Logarithm of each view's exposure over their mean (see `prepare.exposure_of`); empty where tones are
    not learnt.
    """
    held: tuple[int, ...] = ()
    """Views that neither tones nor poses are learnt from."""
    centres: tuple[tuple[float, float, float], ...] = ()
    """Centres of the cameras, in the world, as the capture says; empty where poses are not refined."""
    reach: float = 1.0
    """World distance that views commonly see: the unit in which cameras are shifted."""
    origin: Origin = (0.0, 0.0, 0.0)
    """Origin of the local frame that all of the run is in (see `rendering.local_frame`)."""
    up: tuple[float, float, float] | None = None
    """Direction up, where the capture tells it; None = as its cameras are held level."""
    north: North | None = None
    """Direction of north, if the capture tells it."""
    field: FieldFacts | None = None
    """Facts of its fields; None where it is made of something else."""

    def __post_init__(self) -> None:
        for name in ("near", "far"):
            between(f"space.{name}", getattr(self.space, name), 0, _MAX_SPACE_DISTANCE)

    @property
    def of_field(self) -> FieldFacts:
        """Facts of its fields. Raises CheckpointError where the file names none."""
        if self.field is None:
            raise CheckpointError("scene.json: says nothing about fields; train the scene again")
        return self.field


_FIELD_NAMES = frozenset(each.name for each in dataclasses.fields(FieldFacts))


def facts_to_json(facts: Facts) -> dict[str, Any]:
    """Facts as scene.json holds them: those of fields beside those of any scene."""
    document = dataclasses.asdict(replace(facts, field=None))
    del document["field"]
    if facts.field is not None:
        document |= dataclasses.asdict(facts.field)
    return document


def facts_from_json(document: Any) -> Facts:
    """The facts of scene.json. Raises ConfigError, or TypeError where it is no object.

    Files from before facts were told apart hold 0 channels of fields where there are none.
    """
    of_scene = {}
    of_field = {}
    for name, value in document.items():
        if name in _FIELD_NAMES:
            of_field[name] = value
        else:
            of_scene[name] = value
    field = None
    if of_field.get("channels", 0) != 0:
        field = from_json(of_field, FieldFacts, path="facts")
    return replace(from_json(of_scene, Facts, path="facts"), field=field)
