"""Pictures of fields for clients: coarse to sharp, in layers, with what can be kept kept.

A moving camera must see something at once, a camera at rest everything: the first picture is the finest one that can be had
within `FIRST_SECONDS`, as fast as this machine has been so far, and each next one has four times the pixels. Layers (the look,
the scene as captured, maps) take time; compositing them does not: a wipe that is dragged renders nothing. Geometry and features
of a client's last view are kept, so that a slider that is moved while the camera rests costs decoding alone.
"""

import time
from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Callable, Generator, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..interfaces import Decoder
from ..io.images import Picture, to_uint8
from ..io.maps import depth_image, match_image, palette
from ..rendering.cameras import Cameras
from ..style.look import Restyle
from ..style.regional import RegionWeight
from ..style.restyle import Styled
from ..style.scene import SceneStyle
from ..training.loading import Trained
from ..training.views import Part, view_parts
from .cameras import CameraState, PageTransform, picture_size
from .render_worker import Steps
from .restyler import Restyler
from .state import ViewSettings

CACHE_BYTES = 192 << 20
"""Features that are kept, of all clients' views together."""
CHUNK = 4096
"""Rays of a step: after each one a newer request may take over."""
FIRST_SECONDS = 0.1
"""Time for the first picture of a new camera."""
NO_MATCH = 128
"""Grey of the map of matches without a style."""
_MIN_SIDE = 16
"""No picture's longer side is smaller, unless that of the largest is."""
_DIM = 0.45
"""Brightness of what does not belong to the region that is picked; it is grey, too."""
_UNSURE = 0.45
"""Brightness of a region's colour where a pixel belongs to many."""


class RenderRequest(NamedTuple):
    """A client's request for a picture."""

    camera: CameraState
    view: ViewSettings
    pixels: int
    """Longest side of the sharpest picture."""


@dataclass(frozen=True)
class Layers:
    """Layers of one view at one size."""

    pictures: dict[str, Picture]
    share: NDArray[np.float32] | None
    """Share of each pixel that belongs to the region that is picked, [H W]."""
    depth: Tensor
    """World distance along each ray, [H W]; infinite where there is nothing."""


class RenderedFrame(NamedTuple):
    """A picture for a client."""

    picture: Picture
    layers: Layers
    camera: CameraState
    final: bool
    """Nothing sharper follows."""
    seconds: float
    """Since the work on the request began."""


def resolutions(size: tuple[int, int]) -> list[tuple[int, int]]:
    """Sizes (width, height) from the coarsest to `size` itself, each twice as wide as the one before."""
    sizes, divisor = [size], 2
    while max(size) / divisor >= _MIN_SIDE:
        sizes.append((max(1, round(size[0] / divisor)), max(1, round(size[1] / divisor))))
        divisor *= 2
    return sizes[::-1]


class Speed:
    """Running mean of the seconds that a pixel takes."""

    def __init__(self, guess: float) -> None:
        self.seconds = guess

    def update(self, pixels: int, seconds: float) -> None:
        """Learn that a picture of so many pixels took so long."""
        self.seconds += 0.3 * (seconds / pixels - self.seconds)

    def first(self, sizes: list[tuple[int, int]]) -> int:
        """Index of the finest of `sizes` (coarse to fine) that should take at most `FIRST_SECONDS`; at least 0."""
        fits = [i for i, (width, height) in enumerate(sizes) if width * height * self.seconds <= FIRST_SECONDS]
        return max(fits, default=0)


def first_speeds() -> tuple[Speed, Speed]:
    """Of new views and of kept ones until something was measured: 100 000 rays a second, and a fifth of the time."""
    return Speed(1e-5), Speed(2e-6)


@dataclass
class _ClientCache:
    camera: CameraState | None = None
    parts: dict[tuple[int, int], tuple[Part, ...]] = field(default_factory=dict)
    last: tuple[RenderRequest, Layers] | None = None
    """The sharpest picture that was finished, and for what."""


class SceneRenderer(ABC):
    """Serves the requests of all clients of one scene. Runs on the render worker."""

    @abstractmethod
    def render(self, client: Hashable, request: RenderRequest) -> Steps:
        """Show a client what it requests, step by step; the client None is nobody."""

    @abstractmethod
    def frame(self, cameras: Cameras, view: int, look: Restyle | None) -> Generator[None, None, Picture]:
        """Render one frame of a film, step by step, and return it."""

    @abstractmethod
    def forget(self, client: Hashable) -> None:
        """Drop what is kept for a client."""


class ProgressiveRenderer(SceneRenderer):
    """Renders fields; `show` receives the pictures."""

    def __init__(
        self,
        trained: Trained,
        restyler: Restyler,
        transform: PageTransform,
        show: Callable[[Hashable, RenderedFrame], None],
        speeds: tuple[Speed, Speed] | None = None,
    ) -> None:
        self._trained, self._restyler, self._transform, self._show = trained, restyler, transform, show
        self._caches: OrderedDict[Hashable, _ClientCache] = OrderedDict()
        self._speed, self._cached_speed = speeds or first_speeds()

    def forget(self, client: Hashable) -> None:
        self._caches.pop(client, None)

    def frame(self, cameras: Cameras, view: int, look: Restyle | None) -> Generator[None, None, Picture]:
        rows = []
        for part in self._parts(cameras, view):
            rows.append(part.colour(self._trained.model.decoder, look))
            yield
        width, height = (int(v) for v in cameras.size[view])
        return to_uint8(torch.cat(rows).view(height, width, 3))

    def render(self, client: Hashable, request: RenderRequest) -> Steps:
        """Show ever sharper pictures, a step each chunk of rays."""
        start = time.perf_counter()
        cache = self._caches.setdefault(client, _ClientCache())
        if cache.camera != request.camera:
            self._caches[client] = cache = _ClientCache(request.camera)
        self._caches.move_to_end(client)

        def show(layers: Layers, final: bool) -> None:
            picture = composite_layers(layers, request.view)
            self._show(client, RenderedFrame(picture, layers, request.camera, final, time.perf_counter() - start))

        if cache.last is not None and _covers(cache.last[0], request):
            show(cache.last[1], True)
            return
        styled = self._restyler.styled(request.view.look)
        # Encoders need not be opened, nor a style be known, to show the scene as it is.
        scene = self._restyler.encoders.scene if request.view.shows_regions else None
        sizes = resolutions(picture_size(request.camera.aspect, request.pixels))
        cached = [size for size in sizes if size in cache.parts]
        first = max(self._speed.first(sizes), self._cached_speed.first(cached) if cached else 0)
        for size in sizes[first:]:
            begun = time.perf_counter()
            again = size in cache.parts
            chunks: list[dict[str, NDArray[Any]]] = []
            parts: list[Part] = []
            for part in cache.parts[size] if again else self._march(request.camera, size):
                chunks.append(render_layers(part, self._trained.model.decoder, scene, styled, request.view))
                yield
                if not again and sum(each.bytes for each in parts) + part.bytes <= CACHE_BYTES:
                    parts.append(part)
            (self._cached_speed if again else self._speed).update(size[0] * size[1], time.perf_counter() - begun)
            if not again and sum(part.rays for part in parts) == size[0] * size[1]:
                self._keep(cache, size, tuple(parts))
            final, done = size == sizes[-1], join_layers(chunks, request.view, size)
            if final:
                cache.last = (request, done)
            show(done, final)
            yield

    def _march(self, camera: CameraState, size: tuple[int, int]) -> Iterator[Part]:
        return self._parts(self._transform.cameras([camera], size), 0)

    def _parts(self, cameras: Cameras, view: int) -> Iterator[Part]:
        trained = self._trained
        config = replace(trained.config.render, chunk=min(CHUNK, trained.config.render.chunk))
        return view_parts(trained.model, trained.known.facts, cameras, view, config)

    def _keep(self, cache: _ClientCache, size: tuple[int, int], parts: tuple[Part, ...]) -> None:
        """Keep the sharpest views that fit together, those of the latest client first."""
        cache.parts[size] = parts
        for each in self._caches.values():
            while self._bytes() > CACHE_BYTES and each.parts:
                del each.parts[min(each.parts)]

    def _bytes(self) -> int:
        return sum(part.bytes for cache in self._caches.values() for parts in cache.parts.values() for part in parts)


def _covers(before: RenderRequest, now: RenderRequest) -> bool:
    """True where the layers of one request serve the other."""
    same = before.camera == now.camera and before.pixels == now.pixels and before.view.look == now.view.look
    return same and before.view.layers >= now.view.layers


@torch.inference_mode()
def render_layers(
    part: Part, decoder: Decoder, scene: SceneStyle | None, styled: Styled | None, view: ViewSettings
) -> dict[str, NDArray[Any]]:
    """The layers of a chunk of a view, its depth and its opacity. `styled` None = the scene as it is.

    `scene` may be None where no region is shown.
    """
    restyle = None if styled is None else styled.restyle
    layers = {"look": to_uint8(part.colour(decoder, restyle)), "depth": part.depth.numpy(), "opacity": part.opacity.numpy()}
    if view.wipe is not None:
        layers["plain"] = to_uint8(part.colour(decoder, None))
    if view.map == "matches" and styled is not None and part.semantic is not None:
        layers["matches"] = match_colours(styled, part.mean(styled.restyle.match(part.semantic)), part.opacity)
    elif view.map == "matches":
        layers["matches"] = np.full_like(layers["look"], NO_MATCH)
    if view.shows_regions:
        assert scene is not None
        weight = RegionWeight(scene, torch.eye(len(scene.share))).to(part.content.device)
        memberships = part.mean(weight(part.content[:, :0] if part.semantic is None else part.semantic))
        if view.map == "regions":
            layers["regions"] = to_uint8(region_colours(memberships, part.opacity))
        if view.region is not None:
            layers["share"] = memberships[:, view.region].float().numpy()
    return layers


def join_layers(chunks: Sequence[Mapping[str, NDArray[Any]]], view: ViewSettings, size: tuple[int, int]) -> Layers:
    """The layers of all chunks of a view of `size` (width, height)."""
    width, height = size
    whole = {name: np.concatenate([chunk[name] for chunk in chunks]) for name in chunks[0]}
    whole = {name: rows.reshape(height, width, *rows.shape[1:]) for name, rows in whole.items()}
    depth, opacity = (torch.from_numpy(whole.pop(name)) for name in ("depth", "opacity"))
    share = whole.pop("share", None)
    if view.map == "depth":
        whole["depth"] = depth_image(depth, opacity)
    return Layers(whole, share, torch.where(opacity > 0.5, depth, torch.inf))


def match_colours(styled: Styled, taken: Annotated[Tensor, "N T"], opacity: Annotated[Tensor, "N"]) -> Picture:
    """Colours [N 3] of the references that each pixel takes its style from, by what it takes of each code."""
    total = taken.sum(-1, keepdim=True)
    attention, kept = taken / total.clamp_min(1e-10), (1 - total[:, 0]).clamp(0, 1)
    codes = styled.codes
    return np.asarray(match_image(attention[None], codes.reference, codes.names, opacity[None], kept[None])[0])


def region_colours(memberships: Annotated[Tensor, "N K"], opacity: Annotated[Tensor, "N"]) -> Annotated[Tensor, "N 3"]:
    """A colour for each region, darker where something belongs to many."""
    most, region = memberships.max(-1)
    light = (_UNSURE + (1 - _UNSURE) * most) * opacity
    return palette(memberships.shape[1])[region] * light[:, None]


def composite_layers(layers: Layers, view: ViewSettings) -> Picture:
    """One picture of the layers; layers that were not rendered are left out."""
    picture = layers.pictures["look"]
    if layers.share is not None and view.region is not None:
        grey = _DIM * picture.mean(-1, keepdims=True)
        picture = np.rint(grey + (picture - grey) * layers.share[..., None]).astype(np.uint8)
    if view.map in layers.pictures:
        over = layers.pictures[view.map]
        picture = np.rint(picture * (1 - view.map_opacity) + over * view.map_opacity).astype(np.uint8)
    if view.wipe is not None and "plain" in layers.pictures:
        width = picture.shape[1]
        edge = round(min(1.0, max(0.0, view.wipe)) * width)
        picture = np.concatenate([layers.pictures["plain"][:, :edge], picture[:, edge:]], 1)
    return np.ascontiguousarray(picture)
