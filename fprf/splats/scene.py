"""Scenes of Gaussians: of a capture that is looked at, or of a run; all that verbs, styles and viewers need
of them.

The content of such a scene is its colour: a look changes harmonics (`restyle`), by the semantics of its
Gaussians (`semantics`), and views are drawn by the rasteriser, through a pinhole that covers what a lens
shows (`photographs`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Annotated

import torch
from torch import Tensor

from ..datamanagers.basis import Basis
from ..datamanagers.scene import ParsedScene
from ..interfaces import Encoder
from ..io.cache import cache_folder
from ..ops.rasterise.gsplat import usable
from ..rendering.cameras import Cameras, directions_of, intrinsics_of, pixel_grid
from ..rendering.north import North, bearings_of
from ..rendering.renderer import enlarged
from ..scenes import Scene, SceneView, Values
from ..style.dictionary import Encoders
from ..style.look import Restyle
from ..style.placing import (
    VIEW_SAMPLES,
    Keypoints,
    Landmarks,
    ViewSamples,
    blurred,
    close_keypoints,
    close_size,
)
from ..style.scene_style import SceneStyle
from ..training.camera_optimizers import Tones
from ..types import Origin, View
from .drawing import SeenMeans, draw, seen_means
from .find_light import find_illumination
from .gaussians import GaussianRows, Gaussians
from .kept_light import kept_illumination
from .levels import Levels, StyledLevels
from .pinholes import camera_of, cover, covering, distorted
from .relighting import (
    Illumination,
    azimuth_note,
    captured_light_note,
    facing_north,
    mixed_gain,
    relit_harmonics,
)
from .restyle import ColourEncoder, restyled_harmonics
from .semantics import Semantics

CPU = torch.device("cpu")
_PAINTED_GAUSSIANS = 1 << 14
"""Gaussians whose values are found at a time: bounds the memory."""
_PAINTED_CHANNELS = 128
"""Channels that are drawn at a time: bounds the memory."""
_MIN_SAMPLE_OPACITY = 0.1
"""Pixels less opaque than this show nothing of the scene; by eye."""


@dataclass(frozen=True, eq=False)
class SplatScene(Scene):
    """Gaussians with views of them, all on the CPU but for what is drawn elsewhere."""

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
    """Longest side in pixels of the views that semantics were found in; references are encoded at that
    size.
    """
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
    """Pixels within which Gaussians are drawn as one, and those out of view not at all; None = all are
    drawn.
    """
    levels: Callable[[], Levels] | None = None
    """Levels of detail of the Gaussians as captured, for scenes that are drawn merged."""
    origin: Origin = (0.0, 0.0, 0.0)
    """Origin of the Gaussians and the views."""
    up: tuple[float, float, float] | None = None
    """Direction up; None = as the views are held level."""
    north: North | None = None
    """Direction of north; None if nothing tells it."""
    tones: Tones | None = None
    """Exposures of the views, where a run has learnt them."""
    poses: Callable[[ParsedScene, Sequence[int]], Annotated[Tensor, "V 6"]] | None = None
    """Fits poses of views to their photographs (`fit_poses`); None = there are no photographs."""
    asked: torch.device = CPU
    """Device to draw views on: the CPU, or a CUDA device if gsplat draws there."""
    illumination: Callable[[], Illumination] | None = None
    """Surfaces, shadows and sky for another light: asked for when first needed; None = found by each scene
    that needs it.
    """
    copied: Gaussians | None = None
    """All Gaussians in the scene's look, where they are drawn, if another scene has them already."""

    @property
    def names(self) -> tuple[str, ...]:
        return self.view_names

    @property
    def cameras(self) -> Cameras:
        return self.views

    @property
    def device(self) -> torch.device:
        """The CPU."""
        return CPU

    @property
    def semantic_encoder(self) -> str:
        """Identity of the encoder of the Gaussians' semantics."""
        return self.found().encoder

    @cached_property
    def shown(self) -> Gaussians:
        """The Gaussians in the scene's look, all in memory."""
        return self.part(slice(0, len(self.gaussians)))

    @property
    def drawn_on(self) -> torch.device:
        """Device that views are drawn on: what was asked for, or the CPU. The first call may wait until
        gsplat is compiled.
        """
        return self.asked if usable(self.asked) else CPU

    @cached_property
    def _there(self) -> Gaussians:
        """`shown`, where it is drawn."""
        if self.copied is None:
            return self.shown.to(self.drawn_on)
        return self.copied

    def part(self, rows: slice) -> Gaussians:
        """Some of the Gaussians in the scene's look."""
        if rows == slice(0, len(self.gaussians)):
            gaussians = self.gaussians
        else:
            gaussians = self.gaussians.select(rows)
        if self.look is None:
            return gaussians
        return gaussians.recoloured(self.styled_harmonics(gaussians, rows))

    def styled_harmonics(
        self, gaussians: Gaussians, rows: slice | Tensor, seen_at: Annotated[Tensor, "M 3"] | None = None
    ) -> Annotated[Tensor, "M K 3"]:
        """Harmonics in the scene's look of some of its Gaussians; `seen_at` as of `restyled_harmonics`."""
        look = self.look
        if look is None:
            return gaussians.harmonics
        harmonics = gaussians.harmonics
        if not look.painted_nothing:
            features = self.found().features[rows]
            harmonics = restyled_harmonics(harmonics, gaussians.means, features, look, seen_at)
        if look.lit:
            harmonics = relit_harmonics(harmonics, self.light_gain[rows])
        return harmonics

    @cached_property
    def light_gain(self) -> Annotated[Tensor, "N 3"]:
        """Factors of colours + 0.055 in the light of the scene's look."""
        assert self.look is not None  # by `styled_harmonics`
        return mixed_gain(self.light_found, self.look.lights)

    @property
    def light_found(self) -> Illumination:
        """Surfaces, shadows and sky for another light."""
        if self.illumination is None:
            return illuminated(self)
        return self.illumination()

    @property
    def light_notes(self) -> tuple[str, ...]:
        """A line about the light of the capture, for a look that changes it, and lines about azimuths and north, where
        some are given or said.
        """
        look = self.look
        if look is None or not look.lit:
            return ()
        unlit = all(config is None or config.unlit for _, config in look.lights)
        found = self.light_found
        sun = found.captured_sun
        notes = [captured_light_note(sun, unlit=unlit)]
        configs = [config for _, config in look.lights]
        if sun is not None or any(config is not None and config.place is not None for config in configs):
            if self.north is not None and found.north is None:
                notes.append(f"north is passed over, as it is not level: {self.north.source}")
            notes.append(azimuth_note(None if found.north is None else self.north, configs))
        return tuple(notes)

    def gaussian_rows(self) -> GaussianRows:
        """All Gaussians in the scene's look, to be read in parts."""
        bearings = bearings_of(self.views, self.north, self.up)
        return GaussianRows(len(self.gaussians), self.part, self.antialiased, bearings)

    @cached_property
    def _detail(self) -> Levels | StyledLevels:
        """Levels of detail in the scene's look."""
        assert self.levels is not None  # by `merged`
        levels = self.levels()
        look = self.look
        if look is None:
            return levels
        return StyledLevels(levels, self.styled_harmonics)

    @cached_property
    def seen(self) -> SeenMeans:
        """Means of what the views show of the Gaussians, for renderers that know no more."""
        return seen_means(self.gaussians, self.views, antialiased=self.antialiased)

    @torch.inference_mode()
    def render(self, cameras: Cameras, view: int, *, resolution: float | None = None) -> View:
        """Draw a view, its lens included."""
        # At a part of the resolution a smaller view is drawn, and enlarged.
        if resolution is None:
            share = self.resolution
        else:
            share = resolution
        if share < 1:
            small = cameras.select(torch.tensor([view])).scaled(1 / share)
            return enlarged(self.render(small, 0, resolution=1.0), cameras.size[view].tolist())
        # A lens of more than one radial term is drawn through a pinhole that covers it, and brought to its pixels
        # in the end.
        camera, place = cover(cameras, view, self.near)
        if self.merged is None:
            shown = self._there
        else:
            seen = covering(cameras, view, self.near)
            shown = self._detail.select(seen, self.merged).to(self.drawn_on)
        drawn = draw(shown, camera, antialiased=self.antialiased, background=self.background)
        colour = drawn.image.cpu()
        along = drawn.depth.cpu()
        opacity = drawn.opacity.cpu()
        # Depths are along z; those of a view along its rays, whose lengths are these where z is 1.
        if place is None:
            ahead = directions_of(intrinsics_of(cameras, view), torch.device("cpu"))[:, 2]
            depth = along / -ahead.view_as(along).float()
        else:
            inverse = camera.intrinsics.inverse().float()
            x = (torch.arange(camera.width) + 0.5) * inverse[0, 0] + inverse[0, 2]
            y = (torch.arange(camera.height) + 0.5) * inverse[1, 1] + inverse[1, 2]
            depth = along * (x.square() + y.square()[:, None] + 1).sqrt()
        shape = torch.stack([depth, opacity], -1)
        if place is not None:
            colour = distorted(colour, place)
            shape = distorted(shape, place, linear=True)
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
        features = self.found().features[:, : None if semantic else 0]
        means = self.gaussians.means
        # A pixel of a lens takes the nearest one of the pinhole.
        x, y = pixel.long().unbind(1)
        if place is not None:
            x, y = place[y, x].long().unbind(1)
        at = y.clamp(0, camera.height - 1) * camera.width + x.clamp(0, camera.width - 1)
        # Match maps have a channel for each style code: values are found for some Gaussians at a time, and
        # some channels drawn.
        channels = values(features[:1].float(), means[:1]).shape[1]
        shown = torch.empty(len(means), channels)
        out = torch.empty(len(at), channels)
        for start in range(0, len(means), _PAINTED_GAUSSIANS):
            rows = slice(start, start + _PAINTED_GAUSSIANS)
            shown[rows] = values(features[rows].float(), means[rows])
        for some, into in zip(
            torch.split(shown, _PAINTED_CHANNELS, 1), torch.split(out, _PAINTED_CHANNELS, 1), strict=True
        ):
            drawn = draw(self.gaussians, camera, antialiased=self.antialiased, features=some)
            # What is drawn is weighted by opacity.
            opacity = drawn.opacity.flatten()[at]
            into[:] = drawn.features.flatten(0, 1)[at] / opacity.clamp_min(1e-10)[:, None]
        return out, opacity

    def as_taken(self, view: int) -> "SplatScene":
        if self.tones is None:
            return self
        # Of a view that was held out, what its exposure says.
        red, green, blue = self.tones(torch.tensor([view]))[0].tolist()
        # The same Gaussians, recoloured and copied once; levels of detail are kept on their own.
        copied = self._there if self.merged is None else None
        return replace(self, tone=(red, green, blue), copied=copied)

    def fit_poses(
        self, captured: ParsedScene, views: Sequence[int], progress: Callable[[int, int, str], None]
    ) -> Annotated[Tensor, "V 6"]:
        progress(0, 1, "fitting poses")
        if self.poses is None:
            return super().fit_poses(captured, views, progress)
        return self.poses(captured, views)

    @property
    def counts(self) -> dict[str, int]:
        return {"gaussians": len(self.gaussians)}

    def restyled(self, look: Restyle | None) -> "SplatScene":
        """The same Gaussians in other colours."""
        return replace(self, look=None if look is None or look.idle else look, copied=None)

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
        """Colours in the place of content, and the semantic encoder. Raises WeightsError where weights are
        missing.
        """
        found = self.found()
        return Encoders(
            ColourEncoder(),
            self.encoder(),
            found.basis,
            found.style,
            longest=self.longest,
            landmarks=self._landmarks(),
        )

    def _landmarks(self) -> Landmarks | None:
        """Views by which photographs of the very place are told; None where nobody looked."""
        found = self.found()
        seen = found.seen
        if seen is None:
            return None

        @torch.inference_mode()
        def samples(view: int) -> ViewSamples:
            """Colours and semantics of a view as captured, at even steps through what is solid."""
            camera = camera_of(seen.cameras, view, self.near)
            features = found.features.float()
            drawn = draw(self.gaussians, camera, antialiased=self.antialiased, features=features)
            opacity = drawn.opacity[..., None]
            behind = (1 - opacity) * torch.tensor(self.background)
            colour = blurred((drawn.image + behind).clamp(0, 1)).flatten(0, 1)
            semantic = (drawn.features / opacity.clamp_min(_MIN_SAMPLE_OPACITY)).flatten(0, 1)
            at = (drawn.opacity.flatten() > _MIN_SAMPLE_OPACITY).nonzero()[:, 0]
            at = at[:: max(1, len(at) // VIEW_SAMPLES)]
            pixel = torch.stack([at % camera.width, at // camera.width], 1) + 0.5
            middle = seen.cameras.centre[view].double()
            focal = seen.cameras.focal[view].double()
            pose = seen.cameras.pose[view].double()

            def rays(pixel: Annotated[Tensor, "N 2"]) -> Annotated[Tensor, "N 3"]:
                # As it is drawn: without its lens.
                plane = (pixel.double() - middle) / focal
                local = torch.stack([plane[:, 0], -plane[:, 1], -torch.ones_like(plane[:, 0])], 1)
                return torch.nn.functional.normalize(local @ pose[:, :3].T, dim=1)

            return ViewSamples(pixel, colour[at], semantic[at], pose[:, 3], rays)

        @torch.inference_mode()
        def closer(view: int) -> Keypoints:
            """Keypoints of a view that is drawn larger, in its own pixels."""
            width, height = seen.cameras.size[view].tolist()
            camera = camera_of(seen.cameras.scaled(width / close_size((width, height))[0]), view, self.near)
            return close_keypoints(
                draw(self.gaussians, camera, antialiased=self.antialiased).image, (width, height)
            )

        return Landmarks(seen.keypoints, samples, closer)


def illuminated(scene: SplatScene) -> Illumination:
    """Find surfaces, shadows and sky of a scene for another light, from its views."""
    found = find_illumination(
        scene.gaussians, scene.views, antialiased=scene.antialiased, near=scene.near, up=scene.up
    )
    return facing_north(found, scene.north)


def with_illumination(scene: SplatScene, folder: Path | None = None) -> SplatScene:
    """The scene with its illumination, which is found once, when it is first asked for, and kept in a folder;
    None = that of the user's cache.
    """

    def known() -> Illumination:
        kept_in = folder or cache_folder("light")
        kept = kept_illumination(
            kept_in,
            scene.gaussians,
            scene.views,
            antialiased=scene.antialiased,
            near=scene.near,
            up=scene.up,
        )
        return facing_north(kept, scene.north)

    return replace(scene, illumination=cache(known))


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
