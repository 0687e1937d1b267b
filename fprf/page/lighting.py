"""The light of looks on a scene of Gaussians, for browsers, which compute colours of it themselves (`suns.py`).

Surfaces and openness are found when a light is first asked for, and take seconds; a light takes a tenth of one.
"""

import math
import zlib
from collections.abc import Callable, Hashable, Iterator, Mapping
from functools import partial
from typing import Annotated, Any

import torch
from torch import Tensor

from ..errors import UsageError
from ..light.config import SunConfig
from ..light.day import day
from ..splats.relighting import Illumination, thinned
from ..splats.scene import SplatScene
from .pack import container
from .render_worker import RenderWorker
from .suns import packed_light, packed_surfaces, surfaces_header

_SHOWN_SUNS = 24
"""Suns of the day that the page's slider goes along."""
_MAX_MOVING_GAUSSIANS = 150_000
"""Gaussians that a sun is followed on exactly while it is dragged, at most: a fifth of a second on two cores."""


class Lighting:
    """Finds lights; runs on the render worker alone. `order` is that of the Gaussians as browsers have them."""

    def __init__(self, scene: SplatScene, order: Annotated[Tensor, "N"]) -> None:
        self._scene = scene
        self._order = order
        self.found: Illumination | None = None
        """Findings that take seconds."""
        self._draft: Illumination | None = None
        self._every = math.ceil(len(order) / _MAX_MOVING_GAUSSIANS)

    def find(self) -> Illumination:
        """Findings about the scene, made once."""
        if self.found is None:
            self.found = self._scene.light_found
        return self.found

    def surfaces(self) -> bytes:
        """Data for browsers, whatever the light: a head and planes of bytes."""
        illumination = self.find()
        hours: list[dict[str, Any]] = []
        for hour in day(_SHOWN_SUNS, illumination.noon, clockwise=illumination.clockwise):
            hours.append({"hour": hour.hour, "at": [hour.azimuth, hour.elevation]})
        head = {**surfaces_header(illumination), "day": hours}
        planes = packed_surfaces(illumination)[:, self._order.numpy()]
        return container(head, {"planes": zlib.compress(planes.tobytes(), 1)})

    def light(self, config: SunConfig, *, moving: bool = False) -> bytes:
        """A light: a head and the bytes of its sun, if it has one. Of many Gaussians, `moving` finds shadows on some
        alone, and gives their neighbours the same.
        """
        illumination = self.find()
        reach = self._draft_reach if moving and self._every > 1 else None
        found = packed_light(illumination, config, reach)
        parts = {}
        if found.met is not None:
            parts["met"] = zlib.compress(found.met[self._order.numpy()].tobytes(), 1)
        return container({**found.head, "strength": config.sun_strength}, parts)

    def _draft_reach(self, sun: Annotated[Tensor, "3"], degrees: float) -> Annotated[Tensor, "N"]:
        """Reach of one of so many neighbours, for all of them."""
        if self._draft is None:
            self._draft = thinned(self.find(), self._order[:: self._every], self._every)
        found = self._draft.reach(sun, degrees).repeat_interleave(self._every)[: len(self._order)]
        reach = torch.empty(len(self._order))
        reach[self._order] = found
        return reach


class Lights:
    """Lights of looks by their names. Calls come from any thread.

    `post` sends a message under the name of its kind, and `tell` says what takes its time, as those of `Session`.
    """

    def __init__(
        self,
        scene: SplatScene,
        order: Annotated[Tensor, "N"],
        worker: RenderWorker,
        post: Callable[[Hashable | None, str, Mapping[str, Any]], None],
        tell: Callable[[str, str, float | None], None],
        versions: Iterator[int],
    ) -> None:
        self._lighting = Lighting(scene, order)
        self._count = len(order)
        self._worker = worker
        self._post = post
        self._tell = tell
        self._versions = versions
        self._made: dict[str, tuple[int, bytes]] = {}

    def hello(self) -> list[tuple[str, dict[str, Any]]]:
        """Messages for a new client."""
        return [_message(name, version) for name, (version, _) in [*self._made.items()]]

    def surfaces(self) -> bytes:
        """Data of all lights for browsers."""

        def made() -> bytes:
            self._prepare()
            return self._lighting.surfaces()

        return self._worker.result(made)

    def light(self, name: str) -> bytes:
        """The light of the present look or of a kept one. Raises UsageError where there is none."""
        if (found := self._made.get(name)) is None:
            raise UsageError(f"{name}: no such light")
        return found[1]

    def relight(self, name: str, config: SunConfig | None, *, moving: bool = False) -> None:
        """Give a look another light, None the captured one; another light of this name that is still waiting is
        left out.
        """
        self._worker.run(("light", name), partial(self._make, name, config, moving))

    def _make(self, name: str, config: SunConfig | None, moving: bool) -> None:
        if config is None:
            if self._made.pop(name, None) is not None:
                self._post(None, *_message(name, None))
            return
        self._prepare()
        version = next(self._versions)
        self._made[name] = (version, self._lighting.light(config, moving=moving))
        self._post(None, *_message(name, version))

    def _prepare(self) -> None:
        """Find what all lights need, where that was not done yet; it is told meanwhile."""
        if self._lighting.found is not None:
            return
        self._tell("light", f"Finding what light reaches {self._count:,} Gaussians", None)
        try:
            self._lighting.find()
        finally:
            self._tell("light", "", None)


def _message(name: str, version: int | None) -> tuple[str, dict[str, Any]]:
    return f"light {name}", {"type": "light", "name": name, "version": version}
