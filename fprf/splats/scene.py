"""Scenes of Gaussians: of a capture that is looked at, or of a run; all that verbs, styles and viewers need of them.

The content of such a scene is its colour: a look changes harmonics (`restyle`), by the semantics of its Gaussians
(`semantics`), and views are drawn by the rasteriser, through a pinhole that covers what a lens shows (`photographs`).
"""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache, cached_property
from typing import Annotated

import torch
from torch import Tensor

from ..datamanagers.basis import Basis
from ..datamanagers.scene import Scene as ParsedScene
from ..errors import CheckpointError, DataError
from ..interfaces import Encoder, Scene, SceneView, Stylizer, Values
from ..ops.rasterise.reference import MIN_ALPHA
from ..plugins.stylizers.config import StylizerConfig
from ..rendering.cameras import Cameras, pixel_grid
from ..rendering.renderer import enlarged
from ..style.dictionary import Encoders, StyleDictionary
from ..style.look import ColourMaps, Restyle
from ..style.scene_style import SceneStyle
from ..training.camera_optimizers import Tones
from ..training.run import Known
from ..types import Origin, View
from .config import GaussiansConfig, LookConfig
from .files.base import Data
from .gaussians import GaussianRows, Gaussians
from .levels import Levels, StyledLevels
from .photographs import cover, distorted
from .restyle import Colours, region_maps, restyled_harmonics
from .semantics import Semantics, find_semantics, load_semantics, semantics_tensors, tensor_group
from .views import SeenMeans, clip_distance, draw, find_views, seen_means

_UP = (0.0, -1.0, 0.0)
"""What points up where nothing says so."""
_VIEWS = 32
"""Training views that semantics of a run are found in, at most."""


@dataclass(frozen=True, eq=False)
class SplatScene(Scene):
    """Gaussians with views of them, all on the CPU."""

    gaussians: Gaussians
    """Gaussians as they were captured; all finite."""
    antialiased: bool
    views: Cameras
    view_names: tuple[str, ...]
    found: Callable[[], Semantics]
    """Semantics from the views: asked for when first needed."""
    encoder: Callable[[], Encoder]
    """The encoder of these semantics, for references: built when first needed."""
    longest: int
    """Longest side in pixels of the views that semantics were found in; references are encoded at that size."""
    near: float = 0.01
    """Nothing is drawn nearer to a camera, along z."""
    background: tuple[float, float, float] = (0.5, 0.5, 0.5)
    resolution: float = 1.0
    """Share of a view's width and height that is rendered."""
    look: Restyle | None = None
    """Look that it is drawn in; None = as captured."""
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
        return self.view_names

    @property
    def cameras(self) -> Cameras:
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
        """All Gaussians in the scene's look, to be read in parts."""
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
        """Draw a view, its lens included."""
        # At a part of the resolution a smaller view is drawn, and enlarged.
        share = self.resolution if resolution is None else resolution
        if share < 1:
            small = cameras.select(torch.tensor([view])).scaled(1 / share)
            return enlarged(self.render(small, 0, resolution=1.0), cameras.size[view].tolist())
        # A lens is drawn through a pinhole that covers it, and brought to its pixels in the end.
        camera, place = cover(cameras, view, self.near)
        shown = self.shown if self.merged is None else self._detail.select(camera, self.merged)
        drawn = draw(shown, camera, antialiased=self.antialiased, background=self.background)
        # Depths are along z; those of a view along its rays, whose lengths are these where z is 1.
        inverse = camera.intrinsics.inverse().float()
        x = (torch.arange(camera.width) + 0.5) * inverse[0, 0] + inverse[0, 2]
        y = (torch.arange(camera.height) + 0.5) * inverse[1, 1] + inverse[1, 2]
        depth = drawn.depth * (x.square() + y.square()[:, None] + 1).sqrt()
        colour, shape = drawn.image, torch.stack([depth, drawn.opacity], -1)
        if place is not None:
            colour, shape = distorted(colour, place), distorted(shape, place, linear=True)
        return View((colour * torch.tensor(self.tone)).clamp(0, 1), shape[..., 0], shape[..., 1], 1.0)

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
        # What is drawn is weighted by opacity; a pixel of a lens takes the nearest one of the pinhole.
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

    def paint(self, values: Values) -> Annotated[Tensor, "N X"]:
        """Draw them in the place of colours."""
        return self.scene.paint(self.cameras, self.view, pixel_grid(self.cameras, self.view), values)[0]


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
    # Mistakes are told before views are sought, which takes seconds.
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


def run_scene(config: GaussiansConfig, known: Known, gaussians: Gaussians, near: float, *, quick: bool = False) -> SplatScene:
    """The scene of a run; its semantics are found when they are first asked for, `quick` in few, small views."""
    encoder = cache(config.semantic.encoder.build)
    count, side = (_VIEWS // 4, config.semantic_size // 2) if quick else (_VIEWS, config.semantic_size)

    def found() -> Semantics:
        every = torch.tensor(known.train)
        views = known.cameras.select(every[torch.linspace(0, len(every) - 1, min(count, len(every))).round().long()])
        views = views.scaled(max(1.0, float(views.size.amax()) / side))
        return find_semantics(gaussians, True, encoder(), views, config.regions, near=near)

    longest = min(side, int(known.cameras.size.amax()))
    return SplatScene(
        gaussians, True, known.cameras, known.names, cache(found), encoder, longest, near, config.background,
        origin=known.facts.origin,
    )  # fmt: skip


def scene_tensors(scene: SplatScene) -> dict[str, Tensor]:
    """Return everything found out about a capture, without its Gaussians: for a file of tensors."""
    cameras = {f"camera.{field.name}": getattr(scene.views, field.name) for field in fields(Cameras)}
    return {**cameras, **semantics_tensors(scene.found())}


def load_scene(tensors: dict[str, Tensor], gaussians: Gaussians, antialiased: bool, encoder: Encoder) -> SplatScene:
    """The scene of `scene_tensors`. Raises CheckpointError where they are not of these Gaussians and this encoder."""
    try:
        cameras = Cameras(**tensor_group(tensors, "camera"))
    except TypeError as error:
        raise CheckpointError(f"what is known of a capture is incomplete ({error})") from error
    semantics = load_semantics(tensors, len(gaussians))
    if semantics.encoder != encoder.identity:
        raise CheckpointError(f"what is known of a capture is of the encoder {semantics.encoder}, not {encoder.identity}")
    return captured(gaussians, antialiased, cameras, lambda: semantics, encoder)


def cache_name(data: Data, encoder: str, config: LookConfig) -> str:
    """A name for what is found out about a file: by its content, the encoder, and how it is looked at."""
    # The first number counts the versions of what is found.
    digest = hashlib.sha256(data)
    digest.update(f"10 {encoder} {config.up} {config.inside} {config.views} {config.size} {config.regions}".encode())
    return f"{digest.hexdigest()[:32]}.safetensors"
