"""What the first photograph needs, made ready while nobody waits: encoders, kernels, a style, a picture of nothing."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..io.images import encode
from .cameras import Stage
from .looks import only
from .renderer import Glance, Sight
from .restyler import Studio
from .state import State

__all__ = ["rehearsal"]


def rehearsal(studio: Studio, sight: Sight, stage: Stage, folder: Path) -> Iterator[None]:
    """Work for the desk: what a photograph goes through, for no client. It leaves the scene's own style and no other."""
    studio.encoders  # noqa: B018  they are opened by asking for them
    yield
    path = folder / "rehearsal.png"
    ramp = np.linspace(0, 255, 96 * 128 * 3).reshape(96, 128, 3).astype(np.uint8)
    path.write_bytes(encode(ramp, "png"))
    card = studio.card(path, "rehearsal")
    yield
    look = only(State().look, card)
    studio.restyle(look)
    yield
    eye = stage.eye(studio.trained.known.cameras, 0)
    yield from sight.look(None, Glance(eye, replace(State(), look=look).shown, 32))
    sight.forget(None)
