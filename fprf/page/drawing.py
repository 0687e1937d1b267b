"""Looks on one scene, and their pictures and colours for clients: browsers draw Gaussians themselves, all
else is drawn here.

A moving camera must see something at once, a camera at rest everything: a new camera gets a small picture,
then the whole one. What a client's last view holds is kept, so that a slider that is moved while the camera
rests costs decoding alone.
"""

from collections.abc import Callable, Collection, Hashable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, TypeVar

import numpy as np
import torch
from torch import Tensor

from ..datamanagers.images import load_preview
from ..errors import UsageError
from ..io.images import Picture, to_uint8
from ..io.maps import match_image, palette
from ..ops.harmonics import HARMONIC
from ..rendering.cameras import Cameras, ideal_cameras
from ..scenes import Scene, SceneView
from ..splats.scene import SplatScene
from ..style.config import find_reference, labels, parse_place, parse_region_value
from ..style.dictionary import Encoders, StyleDictionary, build_dictionary, concatenate, encode_photograph
from ..style.files import StyleFile
from ..style.look import Restyle
from ..style.matching import unit
from ..style.regions import Regions, find_regions, memberships
from ..style.restyle import Styled, apply_dictionary, apply_style
from ..style.scene_style import RegionWeight, SceneStyle
from .looks import Look, Photograph, RegionAction, RegionRule, Shown
from .messages import Camera, ViewRequest
from .pack import Colours, Packed
from .render_worker import Steps
from .state import RegionInfo

K = TypeVar("K")
V = TypeVar("V")
_SHELF_PIXELS = 128
"""Longest side of a photograph on the shelf; by eye."""
_MAX_KEPT_STYLES = 24
"""Dictionaries and styles that are kept for when somebody returns to them; by eye."""
_MIN_POINTED_OPACITY = 0.01
"""Opacity below which there is nothing to point at; by eye."""
_STYLE_SHARE = 0.2
"""Of the time that Gaussians are coloured in, that of the style; by eye."""
_RECOLOURING_SHARE = 0.4
"""Of the same time, that of the harmonics; the rest is the packing; by eye."""
CACHE_BYTES = 128 << 20
"""Bytes of features that are kept of each client's last view; by eye."""
STRIP = 4096
"""Pixels of a step, or those of one row: after each one a newer request may take over; by eye."""
_PREVIEW_REDUCTION = 6
"""Factor by which the first picture of a new camera is smaller; by eye."""
_MIN_CANVAS_PIXELS = 8
"""Longer side of a picture, at least, whatever a client asks for."""
_MAX_CANVAS_PIXELS = 4096
"""Longer side of a picture, at most."""
_UNMATCHED_GREY = 0.5
"""Grey of the map of matches without a style."""
_DIMMED_BRIGHTNESS = 0.45
"""Brightness of what does not belong to the region that is picked; it is grey, too; by eye."""
_MIXED_BRIGHTNESS = 0.45
"""Brightness of a region's colour where a pixel belongs to many; by eye."""


class Restyler:
    """Looks as styles on one scene; runs on the render worker alone. Encoders are opened when they are first
    needed.

    A photograph is encoded when it comes and clustered once for each number of clusters: a slider costs the
    stylizer alone.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self._encoders: Encoders | None = None
        self._stale = False
        self._photographs = 0
        self._dictionaries: dict[tuple[Photograph, int, float], StyleDictionary] = {}
        self._styles: dict[Look, Styled] = {}

    @property
    def encoders(self) -> Encoders:
        """Encoders of the scene. Raises WeightsError where those at hand are others."""
        if self._encoders is None or self._stale:
            self._encoders = self.scene.encoders()
            self._stale = False
        return self._encoders

    def reload(self, scene: Scene) -> SceneStyle | None:
        """Replace the scene, and with it its style; return the style from before, if there was one."""
        self.scene = scene
        self._stale = True
        self._styles.clear()
        if self._encoders is None:
            return None
        return self._encoders.scene_style

    def encode(self, path: Path, name: str) -> Photograph:
        """Encode a photograph. Raises DataError for an unreadable one."""
        reference = encode_photograph(path, self.encoders, name=name)
        self._photographs += 1
        thumbnail = load_preview(path, _SHELF_PIXELS)
        return Photograph(self._photographs, name, path, thumbnail, reference)

    def styled(self, look: Look) -> Styled | None:
        """The look on the scene; None for the scene as it is. Raises UsageError for rules that contradict
        each other.
        """
        if look.plain:
            return None

        def made() -> Styled:
            # Each photograph is clustered once; a mix is their dictionaries side by side under the mix's
            # weights.
            if not look.painted:
                return apply_style(self.scene, StyleFile(look.mixed([]).config()), self.encoders)
            style = look.config()
            clusters = style.clusters
            blend = style.blend
            parts = []
            for photograph, _ in look.mix:
                cluster = partial(
                    build_dictionary,
                    [photograph.reference],
                    clusters=clusters,
                    blend=blend,
                    seed=self.encoders.seed,
                )
                parts.append(_recalled(self._dictionaries, (photograph, clusters, blend), cluster))
            dictionary = concatenate(parts, labels(style.references), [weight for _, weight in look.mix])
            return apply_dictionary(self.scene, StyleFile(style), self.encoders, dictionary)

        return _recalled(self._styles, look, made)

    def retain(self, photographs: Collection[Photograph]) -> None:
        """Drop what is kept for any other photograph."""
        for key in [*self._dictionaries]:
            if key[0] not in photographs:
                del self._dictionaries[key]
        for look in [*self._styles]:
            if not {*dict(look.mix)} <= {*photographs}:
                del self._styles[look]

    def restyle(self, look: Look) -> Restyle | None:
        """The look for a renderer."""
        styled = self.styled(look)
        return None if styled is None else styled.restyle

    def region_at(self, cameras: Cameras, pixel: tuple[float, float]) -> int | None:
        """The region at a pixel of the first camera, which lies within its view; None where there is
        nothing.
        """
        # The region of the pixel's strongest membership, by the features that the ray sees.
        place = torch.tensor([pixel], dtype=torch.float64)
        share, opacity = memberships(self.scene, self.encoders.scene_style, cameras, 0, place)
        if float(opacity[0]) >= _MIN_POINTED_OPACITY:
            return int(share[0].argmax())
        return None

    def region_info(self, look: Look, region: int) -> RegionInfo:
        """Return the style that a region takes in a look."""
        # A region stands for its points: its key is matched as they are.
        scene = self.encoders.scene_style
        styled = self.styled(look.unlit)
        taken: list[tuple[str, float]] = []
        if styled is not None:
            # What the region's key takes of each code, summed by photograph.
            attention = styled.restyle.match(scene.keys[region : region + 1].to(self.scene.device))[0].cpu()
            shares = torch.zeros(len(styled.codes.names)).index_add_(
                0, styled.codes.reference, attention.float()
            )
            names = []
            for photograph, _ in look.mix:
                names.append(photograph.name)
            taken = sorted(zip(names, shares.tolist(), strict=True), key=lambda row: -row[1])
        return RegionInfo(region, float(scene.share[region]), tuple(taken))


def _recalled(cache: dict[K, V], key: K, make: Callable[[], V]) -> V:
    """Return what is kept under a key, or make it; it becomes the last to be dropped."""
    cache[key] = cache.pop(key) if key in cache else make()
    while len(cache) > _MAX_KEPT_STYLES:
        del cache[next(iter(cache))]
    return cache[key]


def matching_regions(before: SceneStyle, now: SceneStyle) -> Annotated[Tensor, "K"]:
    """For each region of `before` the most similar one of `now`: regions are measured anew, in any order."""
    if before.keys.shape[1] == 0:
        return torch.zeros(len(before.keys), dtype=torch.int64)
    # Cosines about the mean of the features before, as regions are matched to codes.
    scores = unit(before.keys, before.semantic_mean) @ unit(now.keys, now.semantic_mean).T
    return scores.argmax(-1)


def gaussian_colours(
    scene: SplatScene,
    packed: Packed,
    restyler: Restyler,
    shown: Shown,
    progress: Callable[[float], None] = lambda share: None,
) -> Colours:
    """Colours of Gaussians in the captured light, for browsers; maps have one colour each. `progress` hears the
    share that is done.
    """
    progress(0.0)
    styled = restyler.styled(shown.look.unlit)
    progress(_STYLE_SHARE)
    harmonics = scene.restyled(None if styled is None else styled.restyle).shown.harmonics
    if shown.map == "none" and shown.region is None:
        first = _STYLE_SHARE + _RECOLOURING_SHARE
        progress(first)
        return packed.colours(
            harmonics, rounds=2, progress=lambda share: progress(first + (1 - first) * share)
        )
    # Maps are flat colours in the place of harmonics: what each Gaussian's features match.
    features = scene.found().features.float()
    solid = torch.ones(len(scene.gaussians))
    colours = 0.5 + HARMONIC * harmonics[:, 0]

    def match(restyle: Restyle) -> Tensor:
        return restyle.match(features, scene.gaussians.means)

    mapped = _mapped(colours, solid, shown, styled, match, lambda: _shares(restyler, features))
    return packed.colours(((mapped - 0.5) / HARMONIC)[:, None], rounds=0)


def _mapped(
    colours: Annotated[Tensor, "N 3"],
    opacity: Annotated[Tensor, "N"],
    shown: Shown,
    styled: Styled | None,
    match: Callable[[Restyle], Annotated[Tensor, "N T"]],
    memberships: Callable[[], Annotated[Tensor, "N K"]],
) -> Annotated[Tensor, "N 3"]:
    """Colours of a map of matches or regions in the place of those of the look, and one region lit up among
    them.
    """
    if shown.map == "matches":
        if styled is None:
            colours = torch.full((len(opacity), 3), _UNMATCHED_GREY)
        else:
            # Colours of the references, by what is taken of each code. The rest is what the look leaves as it
            # is.
            taken = match(styled.restyle)
            codes = styled.codes
            total = taken.sum(-1, keepdim=True)
            attention = taken / total.clamp_min(1e-10)
            kept = (1 - total[:, 0]).clamp(0, 1)
            picture = match_image(attention[None], codes.reference, codes.names, opacity[None], kept[None])[0]
            colours = torch.from_numpy(np.ascontiguousarray(picture)).float() / 255
    if shown.map != "regions" and shown.region is None:
        return colours
    share = memberships()
    if shown.map == "regions":
        # A region's colour is dimmed where a point belongs to many.
        most, region = share.max(-1)
        colours = (
            palette(share.shape[1])[region]
            * ((_MIXED_BRIGHTNESS + (1 - _MIXED_BRIGHTNESS) * most) * opacity)[:, None]
        )
    if shown.region is None:
        return colours
    grey = _DIMMED_BRIGHTNESS * colours.mean(-1, keepdim=True)
    return grey + (colours - grey) * share[:, shown.region, None]


def _shares(restyler: Restyler, semantic: Tensor) -> Annotated[Tensor, "N K"]:
    style = restyler.encoders.scene_style
    share: Tensor = RegionWeight(style, torch.eye(len(style.share))).to(semantic.device)(semantic.float())
    return share


class ScenePainter:
    """Renders a scene for clients, at most `longest` pixels a side.

    `show` receives a picture, of the look or as captured, and whether it is the last.
    """

    def __init__(
        self,
        scene: Scene,
        restyler: Restyler,
        show: Callable[[Hashable, str, Picture, bool], None],
        longest: int,
    ) -> None:
        self._scene = scene
        self._restyler = restyler
        self._show = show
        self._longest = longest
        # Of each client's last view: its camera, and the strips of the whole picture.
        self._views: dict[Hashable, tuple[Camera, list[SceneView]]] = {}

    def forget(self, client: Hashable) -> None:
        """Drop what is kept for a client."""
        self._views.pop(client, None)

    def render(self, client: Hashable, request: ViewRequest, shown: Shown) -> Steps[None]:
        """Show a small picture of a new camera, then the whole one, a step each strip."""
        kept = self._views.get(client)
        if kept is not None and kept[0] != request.camera:
            del self._views[client]
            kept = None
        styled = self._restyler.styled(shown.look)
        full = cameras_of([request.camera], longest=self._longest)
        width, height = full.size[0].tolist()
        small = (max(1, round(width / _PREVIEW_REDUCTION)), max(1, round(height / _PREVIEW_REDUCTION)))
        for size in [(width, height)] if kept else [small, (width, height)]:
            rows: list[Tensor] = []
            captured: list[Tensor] = []
            strips: list[SceneView] = []
            # What no look changes is computed once; another look only decodes it again.
            for strip in kept[1] if kept else strips_of(self._scene, cameras_of([request.camera], size)):
                rows.append(self._colours(strip, styled, shown))
                if request.captured:
                    captured.append(strip.restyled().rgb)
                strips.append(strip)
                yield
            whole = size == (width, height)
            if whole and sum(strip.bytes for strip in strips) <= CACHE_BYTES:
                self._views[client] = (request.camera, strips)
            self._show(client, "look", to_uint8(torch.cat(rows)), whole)
            if captured:
                self._show(client, "captured", to_uint8(torch.cat(captured)), whole)
            yield

    def _colours(self, strip: SceneView, styled: Styled | None, shown: Shown) -> Annotated[Tensor, "h W 3"]:
        """A strip as it is shown."""
        view = strip.restyled(None if styled is None else styled.restyle)

        def memberships() -> Tensor:
            return strip.paint(lambda semantic, _: _shares(self._restyler, semantic))

        def match(restyle: Restyle) -> Tensor:
            return strip.paint(restyle.match)

        return _mapped(
            view.rgb.view(-1, 3), view.opacity.view(-1), shown, styled, match, memberships
        ).view_as(view.rgb)


def picture_of(scene: Scene, cameras: Cameras, look: Restyle | None, wipe: float) -> Steps[Picture]:
    """Render the first view in a look, and left of `wipe`, a share of its width, as captured; a step each strip."""
    border = round(max(0.0, wipe) * int(cameras.size[0, 0]))

    def wiped(shown: Tensor, captured: Callable[[], Tensor]) -> Tensor:
        return torch.cat([captured()[:, :border], shown[:, border:]], 1) if border else shown

    if isinstance(scene, SplatScene):
        yield
        whole = scene.restyled(look).render(cameras, 0).rgb
        return to_uint8(wiped(whole, lambda: scene.render(cameras, 0).rgb))
    rows = []
    for strip in strips_of(scene, cameras):
        rows.append(wiped(strip.restyled(look).rgb, partial(_captured, strip)))
        yield
    return to_uint8(torch.cat(rows))


def _captured(strip: SceneView) -> Annotated[Tensor, "h W 3"]:
    return strip.restyled().rgb


def rules_of(restyler: Restyler, file: StyleFile, photographs: Sequence[Photograph]) -> frozenset[RegionRule]:
    """The rules of a style file on the scene of a restyler; `photographs` are its references. Regions that the
    scene does not have are left out. Raises UsageError for what names nothing.
    """
    style = file.style
    encoders = restyler.encoders
    regions = Regions(
        restyler.scene, encoders.scene_style, encoders.basis, file.regions, file.semantic_encoder
    )
    rules = set()
    actions: tuple[tuple[RegionAction, tuple[str, ...]], ...] = (("pin", style.pin), ("forbid", style.forbid))
    for action, texts in actions:
        for text in texts:
            region, named = parse_region_value(action, text)
            if parse_place(action, region) is not None:
                raise UsageError(
                    f"{text}: the page has rules for regions, not for places; use `fprf restyle`"
                )
            photograph = photographs[find_reference(named, style.references)]
            for match in find_regions(regions, region):
                rules.add(RegionRule(match.number, action, photograph))
    for text in style.keep:
        for match in find_regions(regions, text):
            rules.add(RegionRule(match.number, "keep", None))
    return frozenset(rules)


def strips_of(scene: Scene, cameras: Cameras) -> Iterator[SceneView]:
    """The first view in strips of some rows each, from the top."""
    width, height = cameras.size[0].tolist()
    tall = max(1, STRIP // width)
    for top in range(0, height, tall):
        size = torch.tensor([[width, min(tall, height - top)]])
        yield scene.cached(replace(cameras, centre=cameras.centre - torch.tensor([0.0, top]), size=size), 0)


def cameras_of(cameras: Sequence[Camera], size: tuple[int, int] | None = None, longest: int = 640) -> Cameras:
    """Pinhole cameras of one size: `size`, or the shape of the first one's canvas, `longest` pixels at its
    longer side.

    Each keeps its vertical angle. Raises UsageError for axes that are no rotation.
    """
    if size is None:
        width, height = cameras[0].size
        by = max(_MIN_CANVAS_PIXELS, min(longest, _MAX_CANVAS_PIXELS)) / max(width, height)
        size = (max(1, round(width * by)), max(1, round(height * by)))
    poses = []
    focal = []
    centre = []
    for camera in cameras:
        axes = torch.tensor(camera.axes, dtype=torch.float64)
        if (
            not torch.allclose(axes @ axes.T, torch.eye(3).double(), atol=1e-3)
            or float(torch.linalg.det(axes)) < 0
        ):
            raise UsageError("camera: its axes are no rotation")
        # Rows right, down, forward; a pose has columns right, up, back.
        turn = axes.T * torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
        poses.append(torch.cat([turn, torch.tensor(camera.place, dtype=torch.float64)[:, None]], 1))
        # The same vertical angle in another size; the principal point keeps its offset from the middle.
        by = size[1] / camera.size[1]
        focal.append([camera.lens[0] * by, camera.lens[1] * by])
        offset = []
        for k in (0, 1):
            offset.append((camera.lens[2 + k] - camera.size[k] / 2) * by)
        centre.append([size[0] / 2 + offset[0], size[1] / 2 + offset[1]])
    focals, centres = torch.tensor([focal, centre], dtype=torch.float64)
    return replace(ideal_cameras(torch.stack(poses), 1.0, size), focal=focals, centre=centres)
