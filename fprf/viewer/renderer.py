"""What each client sees: from a request to pictures, coarse to sharp, with what can be kept kept.

Geometry and features of a client's last view are kept up to a bound of memory, so that a slider that is moved while the
camera is still costs decoding alone. Runs on the desk.
"""

import time
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from ..io.images import Picture
from ..training.cached_view import Part, view_parts
from ..training.loading import Trained
from .cameras import Eye, Stage, fitted
from .ladder import Speed, rungs
from .painter import Layers, Painter, Shown, compose
from .restyler import Studio

__all__ = ["Frame", "Glance", "Sight"]

KEPT = 192 << 20
"""Bytes of features that are kept, of all clients' views together."""
CHUNK = 4096
"""Rays of a step: after each one a newer request may take over."""


class Glance(NamedTuple):
    """A client's request."""

    eye: Eye
    shown: Shown
    pixels: int
    """Longest side of the sharpest picture."""


class Frame(NamedTuple):
    """A picture for a client."""

    picture: Picture
    layers: Layers
    eye: Eye
    final: bool
    """Nothing sharper follows."""
    seconds: float
    """Since the work on the request began."""


@dataclass
class _Memory:
    """Of one client."""

    eye: Eye | None = None
    parts: dict[tuple[int, int], tuple[Part, ...]] = field(default_factory=dict)
    last: tuple[Glance, Layers] | None = None
    """The sharpest picture that was finished, and for what."""


class Sight:
    """Pictures for all clients of one scene; `show` gets them."""

    def __init__(self, trained: Trained, studio: Studio, stage: Stage, show: Callable[[Hashable, Frame], None]) -> None:
        self._trained, self._studio, self._stage, self._show = trained, studio, stage, show
        self._memory: OrderedDict[Hashable, _Memory] = OrderedDict()
        # Until something was measured: 100 000 rays a second, and a fifth of the time for a view that is kept.
        self._fresh, self._again = Speed(1e-5), Speed(2e-6)

    def forget(self, client: Hashable) -> None:
        """A client has gone."""
        self._memory.pop(client, None)

    def renew(self, trained: Trained) -> None:
        """The scene has changed."""
        self._trained = trained
        self._memory.clear()

    def look(self, client: Hashable, glance: Glance) -> Iterator[None]:
        """Work for the desk: show ever sharper pictures."""
        start = time.perf_counter()
        memory = self._memory.setdefault(client, _Memory())
        if memory.eye != glance.eye:
            self._memory[client] = memory = _Memory(glance.eye)
        self._memory.move_to_end(client)
        if memory.last is not None and _same(memory.last[0], glance):
            layers = memory.last[1]
            self._show(client, Frame(compose(layers, glance.shown), layers, glance.eye, True, time.perf_counter() - start))
            return
        styled = self._studio.styled(glance.shown.look)
        # Encoders need not be opened, nor a style be known, to show the scene as it is.
        scene = self._studio.encoders.scene if glance.shown.of_regions else None
        sizes = rungs(fitted(glance.eye.aspect, glance.pixels))
        kept = [size for size in sizes if size in memory.parts]
        first = max(self._fresh.first(sizes), self._again.first(kept) if kept else 0)
        for size in sizes[first:]:
            begun = time.perf_counter()
            again = size in memory.parts
            painter = Painter(self._trained.model.decoder, scene, styled, glance.shown, size)
            parts: list[Part] = []
            for part in memory.parts[size] if again else self._render(glance.eye, size):
                yield from painter.paint([part])
                if not again and sum(each.bytes for each in parts) + part.bytes <= KEPT:
                    parts.append(part)
            (self._again if again else self._fresh).learn(size[0] * size[1], time.perf_counter() - begun)
            if not again and sum(part.rays for part in parts) == size[0] * size[1]:
                self._keep(memory, size, tuple(parts))
            final, layers = size == sizes[-1], painter.layers()
            if final:
                memory.last = (glance, layers)
            self._show(client, Frame(compose(layers, glance.shown), layers, glance.eye, final, time.perf_counter() - start))
            yield

    def _render(self, eye: Eye, size: tuple[int, int]) -> Iterator[Part]:
        trained = self._trained
        cameras = self._stage.cameras([eye], size)
        config = replace(trained.config.render, chunk=min(CHUNK, trained.config.render.chunk))
        return view_parts(trained.model, trained.known.facts, cameras, 0, config)

    def _keep(self, memory: _Memory, size: tuple[int, int], parts: tuple[Part, ...]) -> None:
        """Keep the sharpest views that have room together, those of the client that looked last."""
        memory.parts[size] = parts
        for each in self._memory.values():
            while self._bytes() > KEPT and each.parts:
                del each.parts[min(each.parts)]

    def _bytes(self) -> int:
        return sum(part.bytes for memory in self._memory.values() for parts in memory.parts.values() for part in parts)


def _same(before: Glance, now: Glance) -> bool:
    """Whether what was painted for one serves the other."""
    same = before.eye == now.eye and before.pixels == now.pixels and before.shown.look == now.shown.look
    return same and before.shown.layers >= now.shown.layers
