"""What restyling needs to know of a capture, found by looking at it: views, regions, and the semantics of its Gaussians.

Views from cameras of its own are encoded as photographs are; a guided filter brings the features to their pixels, regions
compete for the pixels where they meet by colour and depth (`ops.local_mixture`), and each Gaussian takes the mean of the pixels
that it shows in, by its weights there. The *content* of such a scene is its colour, as drawn: a style is then an affine map of
colours, which acts on harmonics exactly. Statistics are those of pixels: Gaussians themselves have less contrast (deviation
0.13 against 0.17 on a plant), since what is seen is a mix of many.
"""

import contextvars
import hashlib
import itertools
import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from functools import cache, cached_property
from typing import Annotated, Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from ..datamanagers.basis import Basis, fit_basis
from ..datamanagers.config import GuidedConfig
from ..datamanagers.scene import Scene as ParsedScene
from ..errors import CheckpointError, DataError
from ..interfaces import Encoder, Scene, SceneView, Stylizer, Values
from ..ops.backend import compiled
from ..ops.guided import upsample
from ..ops.local_mixture import explained
from ..ops.rasterise import Pinhole, lift
from ..ops.rasterise_reference import MIN_ALPHA
from ..plugins.captures import Data
from ..plugins.stylizers.config import StylizerConfig
from ..rendering.cameras import Cameras, pixel_grid
from ..rendering.renderer import enlarged
from ..style.colours import ColourMaps
from ..style.dictionary import StyleDictionary
from ..style.look import Restyle
from ..style.references import Encoders
from ..style.scene import SceneStyle, membership, region_contacts, region_units, scene_style
from ..style.scene import from_tensors as style_from
from ..style.scene import to_tensors as style_tensors
from ..training.camera_optimizers import Tones
from ..types import Origin, View
from .config import LookConfig
from .gaussians import GaussianRows, Gaussians, bulk_of
from .levels import Levels, StyledLevels, seen_by
from .photographs import camera_of, cover, distorted
from .restyle import Colours, region_maps, restyled_harmonics
from .views import OUTLYING, SeenMeans, clip_distance, draw, find_views, seen_means

_CHANNELS = 31
"""Principal components of the semantics that are kept; with the weight they are carried back in four vectors of eight."""
_SOLID = 0.5
"""Pixels and cells less opaque than this say nothing about the scene."""
_TRUST = 4.0
"""Pixels count by this power of their opacity: a soft edge would carry the backdrop's semantics."""
_SAMPLES = 65_536
"""Pixels of all views together that statistics are taken of, about."""
_COARSER = 2
"""Features, which are smooth, are filtered and carried back at the views' resolution divided by this."""
_MEETING = 0.25
"""Half the width of the windows in which regions compete for pixels, as a share of the root of a view's area."""
_GRAIN, _ROUGH = 0.03, 0.05
"""Deviations of colours in [0, 1], and of the logarithm of depth, that tell nothing apart."""
_TOGETHER = 8
"""Components of the features that are spread at a time: of all Gaussians there are copies of so many."""
_UP = (0.0, -1.0, 0.0)
"""What points up where nothing says so."""
_NEIGHBOURS, _LEVELS, _REACH = 1.0, 8, 0.02
"""Pixels that the nearest neighbourhood counts for, half of it for each that is twice as wide; how many; the edge of the
nearest one, as a share of the spread of the positions."""

_VIEWS_AT_ONCE = 4
"""Views that are looked at at the same time, at most: each takes the memory of what it draws."""
_Found = TypeVar("_Found")


class Semantics(NamedTuple):
    """Semantics of N Gaussians, gathered from views."""

    style: SceneStyle
    basis: Basis
    features: Annotated[Tensor, "N D"]
    """Half precision."""
    encoder: str
    """Identity of the encoder."""


@dataclass(frozen=True, eq=False)
class SplatScene(Scene):
    """Gaussians with views of them, all on the CPU."""

    gaussians: Gaussians
    """As they were captured; all finite."""
    antialiased: bool
    views: Cameras
    view_names: tuple[str, ...]
    found: Callable[[], Semantics]
    """Semantics from the views: asked for when first needed."""
    encoder: Callable[[], Encoder]
    """The encoder of these semantics, for references: built when first needed."""
    longest: int
    """Longest side in pixels at which that was looked at."""
    near: float = 0.01
    """Nothing is drawn nearer to a camera, along z."""
    background: tuple[float, float, float] = (0.5, 0.5, 0.5)
    resolution: float = 1.0
    """Share of a view's width and height that is rendered."""
    look: Restyle | None = None
    """None = as captured."""
    tone: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Factors of rendered colours, applied last."""
    merged: float | None = None
    """Pixels within which Gaussians are drawn as one, and those out of view not at all; None = all are drawn."""
    levels: Callable[[], Levels] | None = None
    """Levels of detail of the Gaussians as captured, for scenes that are drawn merged."""
    origin: Origin = (0.0, 0.0, 0.0)
    """Origin of the Gaussians and the views."""
    tones: Tones | None = None
    """Exposures of the views, where a run has learnt them."""
    poses: Callable[[ParsedScene, Sequence[int]], Annotated[Tensor, "V 6"]] | None = None
    """Fits poses of views to their photographs (`fit_poses`); None = there are no photographs."""

    @property
    def names(self) -> tuple[str, ...]:
        """Of the views."""
        return self.view_names

    @property
    def cameras(self) -> Cameras:
        """Of the views."""
        return self.views

    @property
    def device(self) -> torch.device:
        """The CPU."""
        return torch.device("cpu")

    @property
    def semantic_encoder(self) -> str:
        """Identity of the encoder of the Gaussians' semantics."""
        return self.found().encoder

    @cached_property
    def shown(self) -> Gaussians:
        """The Gaussians in the scene's look, all in memory."""
        return self.part(slice(0, len(self.gaussians)))

    def part(self, rows: slice) -> Gaussians:
        """Some of the Gaussians in the scene's look."""
        gaussians = self.gaussians if rows == slice(0, len(self.gaussians)) else self.gaussians.select(rows)
        if self.look is None:
            return gaussians
        features = self.found().features[rows]
        return gaussians.recoloured(restyled_harmonics(gaussians.harmonics, gaussians.means, features, self.look))

    def gaussian_rows(self) -> GaussianRows:
        """All of them, in the scene's look."""
        return GaussianRows(len(self.gaussians), self.part, self.antialiased)

    @cached_property
    def _detail(self) -> Levels | StyledLevels:
        """Levels of detail in the scene's look."""
        assert self.levels is not None  # by `merged`
        levels, look = self.levels(), self.look
        if look is None:
            return levels
        features = self.found().features

        def recolour(gaussians: Gaussians, index: Tensor) -> Tensor:
            return restyled_harmonics(gaussians.harmonics, gaussians.means, features[index], look)

        return StyledLevels(levels, recolour)

    @cached_property
    def seen(self) -> SeenMeans:
        """Means of what the views show of the Gaussians, for renderers that know no more."""
        return seen_means(self.gaussians, self.views, antialiased=self.antialiased)

    @torch.inference_mode()
    def render(self, cameras: Cameras, view: int, *, resolution: float | None = None) -> View:
        """Draw a view, its lens included. Raises DataError for a panorama."""
        share = self.resolution if resolution is None else resolution
        if share < 1:
            small = cameras.select(torch.tensor([view])).scaled(1 / share)
            return enlarged(self.render(small, 0, resolution=1.0), cameras.size[view].tolist())
        camera, place = cover(cameras, view, self.near)
        shown = self.shown if self.merged is None else self._detail.select(camera, self.merged)
        drawn = draw(shown, camera, antialiased=self.antialiased, background=self.background)
        layers = torch.cat([drawn.image, (drawn.depth * _ray_lengths(camera))[..., None], drawn.opacity[..., None]], -1)
        if place is not None:
            layers = torch.cat(
                [distorted(layers[..., :3], place), distorted(layers[..., 3:].contiguous(), place, linear=True)], -1
            )
        return View((layers[..., :3] * torch.tensor(self.tone)).clamp(0, 1), layers[..., 3], layers[..., 4], 1.0)

    @torch.inference_mode()
    def paint(
        self,
        cameras: Cameras,
        view: int,
        pixel: Annotated[Tensor, "R 2"],
        values: Values,
        *,
        semantic: bool = True,
    ) -> tuple[Annotated[Tensor, "R X"], Annotated[Tensor, "R"]]:
        """Values of the Gaussians, drawn."""
        camera, place = cover(cameras, view, self.near)
        features = self.found().features
        drawn = draw(
            self.gaussians,
            camera,
            antialiased=self.antialiased,
            features=values(features[:, : None if semantic else 0].float(), self.gaussians.means),
        )
        x, y = pixel.long().unbind(1)
        if place is not None:
            x, y = place[y, x].long().unbind(1)
        at = y.clamp(0, camera.height - 1) * camera.width + x.clamp(0, camera.width - 1)
        opacity = drawn.opacity.flatten()[at]
        return drawn.features.flatten(0, 1)[at] / opacity.clamp_min(1e-10)[:, None], opacity

    def as_taken(self, view: int) -> "SplatScene":
        if self.tones is None:
            return self
        # Of a view that was held out, what its exposure says.
        red, green, blue = self.tones(torch.tensor([view]))[0].tolist()
        return replace(self, tone=(red, green, blue))

    def fit_poses(
        self, captured: ParsedScene, views: Sequence[int], progress: Callable[[int, int, str], None]
    ) -> Annotated[Tensor, "V 6"]:
        progress(0, 1, "fitting poses")
        return super().fit_poses(captured, views, progress) if self.poses is None else self.poses(captured, views)

    @property
    def counts(self) -> dict[str, int]:
        return {"gaussians": len(self.gaussians)}

    def restyled(self, look: Restyle | None) -> "SplatScene":
        """The same Gaussians in other colours."""
        return replace(self, look=None if look is None or look.idle else look)

    def cached(self, cameras: Cameras, view: int) -> "GaussianView":
        """A view, of which nothing is kept: drawing it again takes milliseconds."""
        return GaussianView(self, cameras, view)

    @property
    def decoder(self) -> None:
        """None: the content is the colours."""
        return None

    def measured(self) -> tuple[SceneStyle, Basis | None]:
        """Statistics of pixels, and the basis."""
        return self.found().style, self.found().basis

    def encoders(self) -> Encoders:
        """Colours in the place of content, and the semantic encoder. Raises WeightsError where weights are missing."""
        found = self.found()
        return Encoders(Colours(), self.encoder(), found.basis, found.style, longest=self.longest)

    def colour_maps(
        self,
        stylizer: Stylizer,
        dictionary: StyleDictionary,
        style: SceneStyle,
        config: StylizerConfig,
        allowed: Annotated[Tensor, "K references"],
    ) -> ColourMaps | None:
        """From region to codes; the stylizer knows what is allowed."""
        return region_maps(stylizer, dictionary, style, config)


@dataclass(frozen=True, eq=False)
class GaussianView(SceneView):
    """A view of a scene of Gaussians."""

    scene: SplatScene
    cameras: Cameras
    view: int

    def restyled(self, restyle: Restyle | None = None) -> View:
        """Recolour all Gaussians and draw the view."""
        return self.scene.restyled(restyle).render(self.cameras, self.view)

    def match(self, restyle: Restyle) -> Annotated[Tensor, "N T"]:
        """Draw the shares of the style codes."""
        return self.scene.paint(self.cameras, self.view, pixel_grid(self.cameras, self.view), restyle.match)[0]


def look_at_capture(
    gaussians: Gaussians,
    antialiased: bool,
    encoder: Encoder,
    config: LookConfig,
    progress: Callable[[int, int], None] = lambda done, total: None,
    camera: Cameras | None = None,
) -> SplatScene:
    """Find views of Gaussians that are all finite, sizes included. What they show is found when it is first asked for.

    `camera` is the view that the capture was made from, where it is known. Raises DataError where nothing can be seen.
    """
    up = torch.tensor(config.up or _UP)
    if not bool(up.isfinite().all() & (up.norm() > 0)):
        raise DataError(f"up {config.up}: no direction; give three numbers, not all 0")
    if float(gaussians.opacities.max()) < MIN_ALPHA:
        raise DataError(f"all {len(gaussians)} Gaussians are transparent; nothing of the capture can be seen or restyled")
    cameras = find_views(
        gaussians,
        count=config.views,
        size=config.size,
        up=up,
        inside=config.inside,
        antialiased=antialiased,
        camera=camera,
    )

    def found() -> Semantics:
        near = clip_distance(gaussians)
        return find_semantics(gaussians, antialiased, encoder, cameras, config.regions, near=near, progress=progress)

    return captured(gaussians, antialiased, cameras, cache(found), encoder)


def captured(
    gaussians: Gaussians, antialiased: bool, cameras: Cameras, found: Callable[[], Semantics], encoder: Encoder
) -> SplatScene:
    """The scene of a capture; its views are numbered."""
    names = tuple(f"{view:02d}" for view in range(len(cameras)))
    longest, near = int(cameras.size.amax()), clip_distance(gaussians)
    return SplatScene(gaussians, antialiased, cameras, names, found, lambda: encoder, longest, near)


@torch.inference_mode()
def find_semantics(
    gaussians: Gaussians,
    antialiased: bool,
    encoder: Encoder,
    cameras: Cameras,
    regions: int,
    *,
    near: float,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Semantics:
    """Encode views of Gaussians, carry the features back, and find the regions. Lenses are left out.

    Raises DataError where nothing is opaque enough to be seen.
    """
    total, numbers = 3 * len(cameras), [(view,) for view in range(len(cameras))]

    def encoded(view: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        camera = camera_of(cameras, view, near)
        drawn = draw(gaussians.select(seen_by(gaussians, camera)), camera, antialiased=antialiased)
        maps = encoder.cutout(drawn.image.permute(2, 0, 1)[None], drawn.opacity[None])[0].float()
        return drawn.image, drawn.opacity, drawn.depth, maps

    pictures, cells, solid = [], [], []
    for view, (image, opacity, depth, maps) in enumerate(_at_once(encoded, numbers)):
        progress(view, total)
        pictures.append((image, opacity, depth))
        cover = torch.nn.functional.interpolate(opacity[None, None], maps.shape[1:], mode="area")[0, 0]
        cells.append(maps)
        solid.append(maps[:, cover > _SOLID].T)
    if not any(len(each) for each in solid):
        raise DataError("nothing in the capture is opaque enough to be seen; it cannot be restyled")
    basis = fit_basis(torch.cat(solid), _CHANNELS)
    dim = basis.matrix.shape[1]
    every = max(1, sum(opacity.numel() for _, opacity, _ in pictures) // (_SAMPLES * _COARSER**2))
    samples: list[tuple[Tensor, Tensor, Tensor]] = []
    pairs: list[Tensor] = []
    pixels: list[tuple[Tensor, Tensor]] = []
    reduced = cameras.scaled(_COARSER)

    def filtered(view: int) -> tuple[Tensor, Tensor]:
        image, opacity, depth = pictures[view]
        layers = torch.cat([image, opacity[..., None], (depth * opacity)[..., None]], 2)
        coarse = _reduced(layers, reduced.select(torch.tensor([view])))
        return coarse, _pixel_features(basis, cells[view], coarse[..., :3], coarse[..., 3])

    for view, (coarse, fine) in enumerate(_at_once(filtered, numbers)):
        progress(len(cameras) + view, total)
        image, opacity, _ = pictures[view]
        pixels.append((coarse, fine))
        # Colours are those of single pixels of the whole picture: averages would have less contrast.
        height, width = fine.shape[:2]
        colour, seen = (each[::_COARSER, ::_COARSER][:height, :width].flatten(0, 1) for each in (image, opacity))
        at = (seen[::every] > _SOLID).nonzero()[:, 0] * every
        samples.append(((colour[at] / seen[at, None]).clamp(0, 1), fine.flatten(0, 1)[at], seen[at]))
        # Neighbours along rows: where both are solid.
        solid_here = coarse[..., 3] > _SOLID
        pair = (solid_here[:, :-1] & solid_here[:, 1:]).flatten().nonzero()[::every, 0]
        shown = torch.cat([_colours(coarse), fine], 2)
        pairs.append(torch.stack([shown[:, :-1].flatten(0, 1)[pair], shown[:, 1:].flatten(0, 1)[pair]], 1))
    # The pictures are seen; what follows takes as much memory.
    pictures.clear()
    cells.clear()
    colour, semantic, seen = (torch.cat(each) for each in zip(*samples, strict=True))
    style = scene_style(colour, semantic, seen, None, regions, seed=0)
    ends = torch.cat(pairs)
    if len(style.share) > 1:
        style = style._replace(contacts=region_contacts(style, ends[..., 3:], ends[..., :3]))

    units = region_units(style.keys, style.semantic_mean)

    def member(view: int) -> Tensor:
        fine = pixels[view][1]
        return membership(fine.flatten(0, 1), style.semantic_mean, *units).view(*fine.shape[:2], -1)

    def carried(view: int, share: Tensor) -> tuple[Tensor, Tensor]:
        coarse, fine = pixels[view]
        fine, trust = _sharpened(style, share, fine, coarse), coarse[..., 3:4] ** _TRUST
        camera = camera_of(reduced, view, near)
        index = seen_by(gaussians, camera)
        shape = (gaussians.means[index], gaussians.quaternions[index], gaussians.log_scales[index], gaussians.logits[index])
        return index, lift(*shape, camera, torch.cat([fine * trust, trust], 2), antialiased=antialiased)

    sums, weights = torch.zeros(len(gaussians), dim), torch.zeros(len(gaussians))
    # Memberships are computed here, not on the threads: some of numba's own layers bear one caller at a time.
    for view, (index, lifted) in enumerate(_at_once(carried, ((view, member(view)) for view in range(len(cameras))))):
        progress(2 * len(cameras) + view, total)
        sums.index_add_(0, index, lifted[:, :dim])
        weights.index_add_(0, index, lifted[:, dim])
    progress(total, total)
    sums *= _COARSER**2
    weights *= _COARSER**2
    features = _spread(gaussians.means, sums, weights, style.semantic_mean)
    return Semantics(style, basis, features, encoder.identity)


def _at_once(function: Callable[..., _Found], given: Iterable[tuple[Any, ...]]) -> Iterator[_Found]:
    """function(*arguments) for each of what is given, in order: several at a time, each on one thread.

    For views. The operations on one are too short to be shared between threads, which would wait for each other most of the
    time. What is given is asked for by this thread, a little ahead.
    """
    before = torch.get_num_threads()
    threads = min(before, _VIEWS_AT_ONCE)
    if threads == 1:
        yield from itertools.starmap(function, given)
        return

    def begin() -> None:
        torch.set_num_threads(1)
        if compiled():
            import numba

            numba.set_num_threads(1)

    left, waiting = iter(given), deque[Future[_Found]]()
    with ThreadPoolExecutor(threads, "fprf-views", begin) as pool:
        try:
            while True:
                for arguments in itertools.islice(left, threads + 1 - len(waiting)):
                    # Modes of this thread that hold in others only if they are carried over.
                    run = contextvars.copy_context().run
                    waiting.append(pool.submit(run, torch.inference_mode()(function), *arguments))
                if not waiting:
                    break
                yield waiting.popleft().result()
        finally:
            for each in waiting:
                each.cancel()
            torch.set_num_threads(before)  # which threads that begin later take over


def semantics_tensors(found: Semantics) -> dict[str, Tensor]:
    """Return semantics for a file of tensors."""
    parts = {"style": style_tensors(found.style), "basis": found.basis.tensors()}
    named = {f"{group}.{name}": tensor for group, tensors in parts.items() for name, tensor in tensors.items()}
    return {**named, "semantic": found.features, "encoder": torch.tensor([*found.encoder.encode()], dtype=torch.uint8)}


def load_semantics(tensors: dict[str, Tensor], count: int) -> Semantics:
    """Read the tensors of `semantics_tensors`. Raises CheckpointError where they are not of as many Gaussians."""
    features = tensors.get("semantic", torch.zeros(0, 0))
    try:
        basis = Basis.from_tensors(_group(tensors, "basis"))
        encoder = bytes(tensors["encoder"].tolist()).decode()
    except (KeyError, ValueError, DataError) as error:
        raise CheckpointError(f"what is known of a capture is incomplete ({error})") from error
    if features.shape != (count, basis.matrix.shape[1]):
        raise CheckpointError(f"what is known of a capture has features {tuple(features.shape)}; it is of another one")
    return Semantics(style_from(_group(tensors, "style")), basis, features.half(), encoder)


def scene_tensors(scene: SplatScene) -> dict[str, Tensor]:
    """Return everything found out about a capture, without its Gaussians: for a file of tensors."""
    cameras = {f"camera.{field.name}": getattr(scene.views, field.name) for field in fields(Cameras)}
    return {**cameras, **semantics_tensors(scene.found())}


def load_scene(tensors: dict[str, Tensor], gaussians: Gaussians, antialiased: bool, encoder: Encoder) -> SplatScene:
    """The scene of `scene_tensors`. Raises CheckpointError where they are not of these Gaussians and this encoder."""
    try:
        cameras = Cameras(**_group(tensors, "camera"))
    except TypeError as error:
        raise CheckpointError(f"what is known of a capture is incomplete ({error})") from error
    semantics = load_semantics(tensors, len(gaussians))
    if semantics.encoder != encoder.identity:
        raise CheckpointError(f"what is known of a capture is of the encoder {semantics.encoder}, not {encoder.identity}")
    return captured(gaussians, antialiased, cameras, lambda: semantics, encoder)


def _group(tensors: dict[str, Tensor], name: str) -> dict[str, Tensor]:
    return {key.partition(".")[2]: tensor for key, tensor in tensors.items() if key.startswith(f"{name}.")}


def cache_name(data: Data, encoder: str, config: LookConfig) -> str:
    """A name for what is found out about a file: by its content, the encoder, and how it is looked at."""
    digest = hashlib.sha256(data)
    digest.update(f"9 {encoder} {config.up} {config.inside} {config.views} {config.size} {config.regions}".encode())
    return f"{digest.hexdigest()[:32]}.safetensors"


def _pixel_features(
    basis: Basis, maps: Annotated[Tensor, "C h w"], image: Annotated[Tensor, "H W 3"], opacity: Annotated[Tensor, "H W"]
) -> Annotated[Tensor, "H W D"]:
    """Features at pixels, by the guided filter that photographs pass.

    Its window is a share of the root of the area: one of the shorter side of an upright view hardly covers two of the encoder's
    cells, and a fir before the sky was half sky.
    """
    guided = GuidedConfig()
    low = basis.project(maps.flatten(1).T).T.reshape(-1, *maps.shape[1:])
    filled = (image + (1 - opacity)[..., None]).clamp(0, 1)
    radius = round(guided.radius * math.sqrt(opacity.numel()))
    return upsample(low, filled, radius=radius, eps=guided.eps, stride=guided.stride)


def _sharpened(
    style: SceneStyle,
    share: Annotated[Tensor, "H W K"],
    fine: Annotated[Tensor, "H W D"],
    coarse: Annotated[Tensor, "H W 5"],
) -> Annotated[Tensor, "H W D"]:
    """Features moved to the regions that explain what pixels look like, by their colour and depth.

    `share` are the pixels' memberships in the regions; `coarse` holds colours times opacity, opacity, depth times opacity.
    """
    opacity = coarse[..., 3]
    depth = (coarse[..., 4] / opacity.clamp_min(_SOLID)).clamp_min(1e-30).log()
    guide, noise = torch.cat([_colours(coarse), depth[..., None]], 2), torch.tensor([*3 * (_GRAIN,), _ROUGH])
    after = explained(share, guide, opacity > _SOLID, radius=_MEETING * math.sqrt(opacity.numel()), noise=noise)
    moved: Tensor = fine + (after - share) @ style.keys
    return moved


def _colours(coarse: Annotated[Tensor, "H W 4+"]) -> Annotated[Tensor, "H W 3"]:
    """Colours of solid pixels without what is behind them."""
    return (coarse[..., :3] / coarse[..., 3:4].clamp_min(_SOLID)).clamp(0, 1)


def _reduced(pixels: Annotated[Tensor, "H W C"], cameras: Cameras) -> Annotated[Tensor, "h w C"]:
    width, height = (int(v) for v in cameras.size[0])
    return torch.nn.functional.interpolate(pixels.permute(2, 0, 1)[None], (height, width), mode="area")[0].permute(1, 2, 0)


def _spread(
    points: Annotated[Tensor, "N 3"], sums: Annotated[Tensor, "N D"], mass: Annotated[Tensor, "N"], none: Annotated[Tensor, "D"]
) -> Annotated[Tensor, "N D"]:
    """Means at points, drawn to those of ever larger neighbourhoods, which decide where little was seen: half precision.

    A point far from whatever was seen takes `none`.
    """
    trust, levels = mass.clone(), []
    # Neither stray Gaussians nor the distance from the origin decide how large neighbourhoods are, nor where they begin.
    near = points[torch.from_numpy(bulk_of(points.numpy()).apart <= OUTLYING)].double()
    edge = _REACH * float(near.var(0, correction=0).mean().sqrt())
    for level in range(_LEVELS):
        box = ((points - near.amin(0)) / max(edge * 2**level, 1e-30)).clamp(-1, 2.0**20).long() + 1
        _, box = torch.unique((box[:, 0] << 42) + (box[:, 1] << 21) + box[:, 2], return_inverse=True)
        weight = sums.new_zeros(int(box.max()) + 1).index_add_(0, box, mass)
        share = weight.clamp_max(_NEIGHBOURS * 0.5**level) / weight.clamp_min(1e-12)
        trust += (weight * share)[box]
        levels.append((box.int(), share))
    out = torch.empty(sums.shape, dtype=torch.float16)
    for some in torch.split(torch.arange(sums.shape[1]), _TOGETHER):
        part = sums[:, some]
        mean = part.clone()
        for box, share in levels:
            mean += (sums.new_zeros(len(share), len(some)).index_add_(0, box, part) * share[:, None])[box]
        out[:, some] = torch.where(trust[:, None] > 1e-6, mean / trust.clamp_min(1e-12)[:, None], none[some]).half()
    return out


def _ray_lengths(camera: Pinhole) -> Tensor:
    """Length of the ray to each pixel where z is 1."""
    inverse = camera.intrinsics.inverse().float()
    x = (torch.arange(camera.width) + 0.5) * inverse[0, 0] + inverse[0, 2]
    y = (torch.arange(camera.height) + 0.5) * inverse[1, 1] + inverse[1, 2]
    return (x.square() + y.square()[:, None] + 1).sqrt()
