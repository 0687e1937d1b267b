"""What clients see: colours of Gaussians, which their browsers draw, and pictures of fields, which are drawn here.

A moving camera must see something at once, a camera at rest everything: the first picture of a field is the finest one that can
be had within `FIRST_SECONDS`, as fast as this machine has been so far, and each next one has four times the pixels. What a
client's last view holds is kept, so that a slider that is moved while the camera rests costs decoding alone.
"""

import time
from collections.abc import Callable, Generator, Hashable, Iterable
from dataclasses import dataclass, field, replace
from typing import Annotated, Literal, NamedTuple, TypeAlias

import numpy as np
import torch
from torch import Tensor

from ..errors import UsageError
from ..io.images import Picture, to_uint8
from ..io.maps import depth_image, match_image, palette
from ..ops.harmonics import HARMONIC
from ..page.pack import Colours, Packed
from ..rendering.cameras import Cameras, ideal_cameras
from ..splats.scene import SplatScene
from ..style.look import Restyle
from ..style.restyle import Styled
from ..style.scene_style import RegionWeight
from ..training.loading import Trained
from ..training.views import ViewChunk, view_chunks
from .messages import Camera
from .render_worker import Steps
from .restyler import Look, Restyler

Map: TypeAlias = Literal["none", "matches", "regions", "depth"]
CACHE_BYTES = 128 << 20
"""Features that are kept of each client's last view."""
CHUNK = 4096
"""Rays of a step: after each one a newer request may take over."""
FIRST_SECONDS = 0.1
"""Time for the first picture of a new camera."""
_MIN_CANVAS, _MAX_CANVAS = 8, 4096
"""Longer sides of pictures, in pixels."""
_MIN_SIDE = 16
"""No picture's longer side is smaller."""
_NO_MATCH = 0.5
"""Grey of the map of matches without a style."""
_DIM = 0.45
"""Brightness of what does not belong to the region that is picked; it is grey, too."""
_UNSURE = 0.45
"""Brightness of a region's colour where a pixel belongs to many."""


class Shown(NamedTuple):
    """What is shown of a scene."""

    look: Look
    map: Map = "none"
    region: int | None = None
    """A region to be highlighted; the others are dimmed."""


class Request(NamedTuple):
    """A client's request for a picture."""

    camera: Camera
    shown: Shown
    longest: int
    """Longest side of the sharpest picture."""
    captured: bool = False
    """Show the scene as captured beside."""


def gaussian_colours(scene: SplatScene, packed: Packed, restyler: Restyler, shown: Shown) -> Colours:
    """Colours of Gaussians for browsers; maps have one colour each."""
    styled = restyler.styled(shown.look)
    harmonics = scene.restyled(None if styled is None else styled.restyle).shown.harmonics
    if shown.map in ("none", "depth") and shown.region is None:
        return packed.colours(harmonics, rounds=2)
    # Maps are flat colours in the place of harmonics: what each Gaussian's features match.
    features, solid = scene.found().features, torch.ones(len(scene.gaussians))
    colours = 0.5 + HARMONIC * harmonics[:, 0]
    if shown.map == "matches":
        taken = None if styled is None else styled.restyle.match(features.float(), scene.gaussians.means)
        colours = _match_colours(styled, taken, solid)
    if shown.map == "regions" or shown.region is not None:
        memberships = _memberships(restyler, features)
        colours = _mapped(colours, memberships, solid, shown)
    return packed.colours(((colours - 0.5) / HARMONIC)[:, None], rounds=0)


def _mapped(colours: Tensor, memberships: Tensor, opacity: Tensor, shown: Shown) -> Annotated[Tensor, "N 3"]:
    """Colours of regions in the place of those of the look, or one region lit up among them."""
    if shown.map == "regions":
        most, region = memberships.max(-1)
        colours = palette(memberships.shape[1])[region] * ((_UNSURE + (1 - _UNSURE) * most) * opacity)[:, None]
    if shown.region is None:
        return colours
    grey = _DIM * colours.mean(-1, keepdim=True)
    return grey + (colours - grey) * memberships[:, shown.region, None]


def _memberships(restyler: Restyler, semantic: Tensor) -> Annotated[Tensor, "N K"]:
    style = restyler.encoders.scene_style
    share: Tensor = RegionWeight(style, torch.eye(len(style.share))).to(semantic.device)(semantic.float())
    return share


def _match_colours(
    styled: Styled | None, taken: Annotated[Tensor, "N T"] | None, opacity: Annotated[Tensor, "N"]
) -> Annotated[Tensor, "N 3"]:
    """Colours of the references that each point takes its style from, by what it takes of each code; grey without a style."""
    if styled is None or taken is None:
        return torch.full((len(opacity), 3), _NO_MATCH)
    # The rest of what is taken is what the look leaves as it is.
    total = taken.sum(-1, keepdim=True)
    attention, kept, codes = taken / total.clamp_min(1e-10), (1 - total[:, 0]).clamp(0, 1), styled.codes
    picture = match_image(attention[None], codes.reference, codes.names, opacity[None], kept[None])[0]
    return torch.from_numpy(np.ascontiguousarray(picture)).float() / 255


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


@dataclass
class _Kept:
    """A client's last view."""

    camera: Camera
    parts: dict[tuple[int, int], list[ViewChunk]] = field(default_factory=dict)


class FieldPainter:
    """Renders a field for clients; `show` receives a picture, of the look or as captured, and whether it is the last."""

    def __init__(self, trained: Trained, restyler: Restyler, show: Callable[[Hashable, str, Picture, bool], None]) -> None:
        self._trained, self._restyler, self._show = trained, restyler, show
        self._views: dict[Hashable, _Kept] = {}
        self._speed = Speed(1e-5)  # until something was measured

    def forget(self, client: Hashable) -> None:
        """Drop what is kept for a client."""
        self._views.pop(client, None)

    def render(self, client: Hashable, request: Request) -> Steps:
        """Show ever sharper pictures, a step each chunk of rays."""
        kept = self._views.get(client)
        if kept is None or kept.camera != request.camera:
            self._views[client] = kept = _Kept(request.camera)
        # From the sharpest size whose features are kept, else from the finest that comes at once, up to the full one.
        styled = self._restyler.styled(request.shown.look)
        full = cameras_of([request.camera], longest=request.longest)
        sizes = resolutions((int(full.size[0, 0]), int(full.size[0, 1])))
        ready = [size for size in sizes if size in kept.parts]
        for size in sizes[sizes.index(ready[-1]) if ready else self._speed.first(sizes) :]:
            start, again = time.perf_counter(), size in kept.parts
            rows: list[Tensor] = []
            captured: list[Tensor] = []
            parts: list[ViewChunk] = []
            # Features are marched once; another look only decodes them again.
            for part in kept.parts[size] if again else self._parts(cameras_of([request.camera], size), 0):
                rows.append(self._colours(part, styled, request.shown))
                if request.captured:
                    captured.append(part.colour(self._trained.model.decoder, None).cpu())
                if not again:
                    parts.append(part)
                yield
            if not again:
                self._speed.update(size[0] * size[1], time.perf_counter() - start)
            if not again and sum(part.bytes for part in parts) <= CACHE_BYTES:
                kept.parts = {size: parts}  # of the sharpest size that fits
            shape = (size[1], size[0])
            if request.shown.map == "depth":
                depth, opacity = torch.cat(rows).view(*shape, 2).unbind(-1)
                picture = depth_image(depth, opacity)
            else:
                picture = to_uint8(torch.cat(rows).view(*shape, 3))
            self._show(client, "look", picture, size == sizes[-1])
            if captured:
                self._show(client, "captured", to_uint8(torch.cat(captured).view(*shape, 3)), size == sizes[-1])
            yield

    @torch.inference_mode()
    def _colours(self, part: ViewChunk, styled: Styled | None, shown: Shown) -> Annotated[Tensor, "N 3"]:
        """A chunk as it is shown; of the map of depths, depth and opacity."""
        restyle, semantic = None if styled is None else styled.restyle, part.semantic
        if shown.map == "depth":
            return torch.stack([part.depth, part.opacity], -1).cpu()
        colours: Tensor = part.colour(self._trained.model.decoder, restyle).cpu()
        opacity = part.opacity.cpu()
        if shown.map == "matches":
            taken = None if styled is None or semantic is None else part.mean(styled.restyle.match(semantic)).cpu()
            colours = _match_colours(styled, taken, opacity)
        if shown.map == "regions" or shown.region is not None:
            memberships = part.mean(_memberships(self._restyler, part.content[:, :0] if semantic is None else semantic)).cpu()
            colours = _mapped(colours, memberships, opacity, shown)
        return colours

    def _parts(self, cameras: Cameras, view: int) -> Iterable[ViewChunk]:
        trained = self._trained
        config = replace(trained.config.render, chunk=min(CHUNK, trained.config.render.chunk))
        return view_chunks(trained.model, trained.known.facts, cameras, view, config)

    def frame(self, cameras: Cameras, view: int, look: Restyle | None) -> Generator[None, None, Picture]:
        """Render one frame of a film, step by step, and return it."""
        rows = []
        for part in self._parts(cameras, view):
            rows.append(part.colour(self._trained.model.decoder, look).cpu())
            yield
        width, height = (int(v) for v in cameras.size[view])
        return to_uint8(torch.cat(rows).view(height, width, 3))


def resolutions(size: tuple[int, int]) -> list[tuple[int, int]]:
    """Sizes (width, height) from the coarsest to `size` itself, each twice as wide as the one before."""
    sizes, divisor = [size], 2
    while max(size) / divisor >= _MIN_SIDE:
        sizes.append((max(1, round(size[0] / divisor)), max(1, round(size[1] / divisor))))
        divisor *= 2
    return sizes[::-1]


def cameras_of(cameras: "list[Camera]", size: tuple[int, int] | None = None, longest: int = 640) -> Cameras:
    """Pinhole cameras of one size: `size`, or the shape of the first one's canvas, `longest` pixels at its longer side.

    Each keeps its vertical angle. Raises UsageError for axes that are no rotation.
    """
    if size is None:
        width, height = cameras[0].size
        by = max(_MIN_CANVAS, min(longest, _MAX_CANVAS)) / max(width, height)
        size = (max(1, round(width * by)), max(1, round(height * by)))
    poses, focal, centre = [], [], []
    for camera in cameras:
        axes = torch.tensor(camera.axes, dtype=torch.float64)
        if not torch.allclose(axes @ axes.T, torch.eye(3).double(), atol=1e-3) or float(torch.linalg.det(axes)) < 0:
            raise UsageError("camera: its axes are no rotation")
        # Rows right, down, forward; a pose has columns right, up, back.
        turn = axes.T * torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
        poses.append(torch.cat([turn, torch.tensor(camera.place, dtype=torch.float64)[:, None]], 1))
        # The same vertical angle in another size; the principal point keeps its offset from the middle.
        by = size[1] / camera.size[1]
        focal.append([camera.lens[0] * by, camera.lens[1] * by])
        offset = [(camera.lens[2 + k] - camera.size[k] / 2) * by for k in (0, 1)]
        centre.append([size[0] / 2 + offset[0], size[1] / 2 + offset[1]])
    made = ideal_cameras(torch.stack(poses), 1.0, size)
    return type(made)(
        made.pose,
        torch.tensor(focal, dtype=torch.float64),
        torch.tensor(centre, dtype=torch.float64),
        made.size,
        made.distortion,
        made.lens,
    )
