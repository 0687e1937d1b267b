"""Photographs and looks on one scene. Runs on the render worker alone.

A photograph is encoded when it comes and clustered once for each number of clusters: a slider costs the stylizer alone.
"""

from collections import OrderedDict
from collections.abc import Collection
from pathlib import Path
from typing import Annotated, NamedTuple, TypeVar

import torch
from torch import Tensor

from ..datamanagers.images import load_image
from ..errors import UsageError
from ..interfaces import Scene
from ..io.images import shrink
from ..plugins.stylizers.config import RegionToneConfig
from ..rendering.cameras import Cameras
from ..style.config import labels
from ..style.dictionary import Encoders, StyleDictionary, build_dictionary, concatenate, encode_photograph
from ..style.files import StyleFile
from ..style.look import Restyle
from ..style.matching import unit
from ..style.regions import memberships
from ..style.restyle import Styled, apply_dictionary
from ..style.scene_style import SceneStyle
from .look import Look, Photograph, style_config

Key = TypeVar("Key")
Value = TypeVar("Value")

_THUMBNAIL = 128
"""Longest side in pixels."""
_CACHED = 24
"""Dictionaries and styles that are kept for when somebody returns to them."""
_SOLID = 0.01
"""Opacity below which there is nothing to point at."""


class RegionInfo(NamedTuple):
    """A region that was picked."""

    region: int
    share: float
    """Of the scene."""
    taken: tuple[tuple[str, float], ...]
    """Share that it takes from each photograph, the largest first; empty without a style."""


class Restyler:
    """Looks as styles on one scene; encoders are opened when they are first needed."""

    def __init__(self, scene: Scene, stylizer: RegionToneConfig | None = None) -> None:
        self.scene = scene
        self._stylizer = stylizer
        self._encoders: Encoders | None = None
        self._stale = False
        self._photographs = 0
        self._dictionaries: OrderedDict[tuple[Photograph, int, float], StyleDictionary] = OrderedDict()
        self._styles: OrderedDict[Look, Styled] = OrderedDict()

    @property
    def encoders(self) -> Encoders:
        """Encoders of the scene. Raises WeightsError where those at hand are others."""
        if self._encoders is None or self._stale:
            self._encoders = self.scene.encoders()
            self._stale = False
        return self._encoders

    def reload(self, scene: Scene) -> SceneStyle | None:
        """Replace the scene, and with it its style; return the style from before, if there was one."""
        self.scene, self._stale = scene, True
        self._styles.clear()
        return None if self._encoders is None else self._encoders.scene_style

    @property
    def regions(self) -> int:
        """Number of regions of the scene."""
        return len(self.encoders.scene_style.share)

    def encode(self, path: Path, name: str) -> Photograph:
        """Encode a photograph. Raises DataError for an unreadable one."""
        reference = encode_photograph(path, self.encoders, name=name)
        self._photographs += 1
        return Photograph(self._photographs, name, path, shrink(load_image(path, upright=True), _THUMBNAIL), reference)

    def styled(self, look: Look) -> Styled | None:
        """The look on the scene; None for the scene as it is. Raises UsageError for rules that contradict each other."""
        if look.plain:
            return None
        if look not in self._styles:
            parts = [self._dictionary(photograph, look.clusters, look.blend) for photograph, _ in look.mix]
            style = style_config(look, self._stylizer)
            dictionary = concatenate(parts, labels(style.references), [weight for _, weight in look.mix])
            self._styles[look] = apply_dictionary(self.scene, StyleFile(style), self.encoders, dictionary)
        return _use(self._styles, look)

    def retain(self, photographs: Collection[Photograph]) -> None:
        """Drop what is kept for any other photograph."""
        self._dictionaries = OrderedDict((key, value) for key, value in self._dictionaries.items() if key[0] in photographs)
        self._styles = OrderedDict((look, value) for look, value in self._styles.items() if {*dict(look.mix)} <= {*photographs})

    def restyle(self, look: Look) -> Restyle | None:
        """The look for a renderer."""
        styled = self.styled(look)
        return None if styled is None else styled.restyle

    def region_at(self, cameras: Cameras, pixel: tuple[float, float]) -> int | None:
        """The region at a pixel of the first camera; None where there is nothing. Raises UsageError outside of the view."""
        width, height = cameras.size[0].tolist()
        if not (0 <= pixel[0] < width and 0 <= pixel[1] < height):
            raise UsageError(f"pixel {pixel[0]:.0f},{pixel[1]:.0f}: outside of the view of {width}x{height}")
        place = torch.tensor([pixel], dtype=torch.float64)
        share, opacity = memberships(self.scene, self.encoders.scene_style, cameras, 0, place)
        return int(share[0].argmax()) if float(opacity[0]) >= _SOLID else None

    def region_info(self, look: Look, region: int) -> RegionInfo:
        """Return the style that a region takes in a look."""
        scene, styled = self.encoders.scene_style, self.styled(look)
        taken: list[tuple[str, float]] = []
        if styled is not None:
            attention = styled.restyle.match(scene.keys[region : region + 1].to(self.scene.device))[0].cpu()
            shares = torch.zeros(len(styled.codes.names)).index_add_(0, styled.codes.reference, attention.float())
            names = [photograph.name for photograph, _ in look.mix]
            taken = sorted(zip(names, shares.tolist(), strict=True), key=lambda row: -row[1])
        return RegionInfo(region, float(scene.share[region]), tuple(taken))

    def _dictionary(self, photograph: Photograph, clusters: int, blend: float) -> StyleDictionary:
        key = (photograph, clusters, blend)
        if key not in self._dictionaries:
            seed = self.encoders.seed
            self._dictionaries[key] = build_dictionary([photograph.reference], clusters=clusters, blend=blend, seed=seed)
        return _use(self._dictionaries, key)


def _use(cache: OrderedDict[Key, Value], key: Key) -> Value:
    """Return what is kept under a key, which becomes the last to be dropped."""
    cache.move_to_end(key)
    while len(cache) > _CACHED:
        cache.popitem(last=False)
    return cache[key]


def matching_regions(before: SceneStyle, now: SceneStyle) -> Annotated[Tensor, "K"]:
    """For each region of `before` the most similar one of `now`: regions are measured anew, in any order."""
    if before.keys.shape[1] == 0:
        return torch.zeros(len(before.keys), dtype=torch.int64)
    scores = unit(before.keys, before.semantic_mean) @ unit(now.keys, now.semantic_mean).T
    return scores.argmax(-1)
