"""Photographs and looks on one scene.

`Restyler` runs on the render worker alone. A photograph is encoded when it comes and clustered once for each number of
clusters: a slider costs the stylizer alone.
"""

from collections.abc import Callable, Collection
from functools import partial
from pathlib import Path
from typing import Annotated, TypeVar

import torch
from torch import Tensor

from ..datamanagers.images import load_image
from ..errors import UsageError
from ..interfaces import Scene
from ..io.images import shrink
from ..rendering.cameras import Cameras
from ..style.config import labels
from ..style.dictionary import Encoders, StyleDictionary, build_dictionary, concatenate, encode_photograph
from ..style.files import StyleFile
from ..style.look import Restyle
from ..style.matching import unit
from ..style.regions import memberships
from ..style.restyle import Styled, apply_dictionary
from ..style.scene_style import SceneStyle
from .state import Look, Photograph, RegionInfo

Key = TypeVar("Key")
Value = TypeVar("Value")
_THUMBNAIL = 128
"""Longest side in pixels."""
_CACHED = 24
"""Dictionaries and styles that are kept for when somebody returns to them."""
_SOLID = 0.01
"""Opacity below which there is nothing to point at."""


class Restyler:
    """Looks as styles on one scene; encoders are opened when they are first needed."""

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
        self.scene, self._stale = scene, True
        self._styles.clear()
        return None if self._encoders is None else self._encoders.scene_style

    def encode(self, path: Path, name: str) -> Photograph:
        """Encode a photograph. Raises DataError for an unreadable one."""
        reference = encode_photograph(path, self.encoders, name=name)
        self._photographs += 1
        return Photograph(self._photographs, name, path, shrink(load_image(path, upright=True), _THUMBNAIL), reference)

    def styled(self, look: Look) -> Styled | None:
        """The look on the scene; None for the scene as it is. Raises UsageError for rules that contradict each other."""
        if look.plain:
            return None

        def made() -> Styled:
            # Each photograph is clustered once; a mix is their dictionaries side by side under the mix's weights.
            style = look.config()
            clusters, blend, parts = style.clusters, style.blend, []
            for photograph, _ in look.mix:
                cluster = partial(
                    build_dictionary, [photograph.reference], clusters=clusters, blend=blend, seed=self.encoders.seed
                )
                parts.append(_cached(self._dictionaries, (photograph, clusters, blend), cluster))
            dictionary = concatenate(parts, labels(style.references), [weight for _, weight in look.mix])
            return apply_dictionary(self.scene, StyleFile(style), self.encoders, dictionary)

        return _cached(self._styles, look, made)

    def retain(self, photographs: Collection[Photograph]) -> None:
        """Drop what is kept for any other photograph."""
        self._dictionaries = {key: value for key, value in self._dictionaries.items() if key[0] in photographs}
        self._styles = {look: value for look, value in self._styles.items() if {*dict(look.mix)} <= {*photographs}}

    def restyle(self, look: Look) -> Restyle | None:
        """The look for a renderer."""
        styled = self.styled(look)
        return None if styled is None else styled.restyle

    def region_at(self, cameras: Cameras, pixel: tuple[float, float]) -> int | None:
        """The region at a pixel of the first camera; None where there is nothing. Raises UsageError outside of the view."""
        width, height = cameras.size[0].tolist()
        if not (0 <= pixel[0] < width and 0 <= pixel[1] < height):
            raise UsageError(f"pixel {pixel[0]:.0f},{pixel[1]:.0f}: outside of the view of {width}x{height}")
        # The region of the pixel's strongest membership, by the features that the ray sees.
        place = torch.tensor([pixel], dtype=torch.float64)
        share, opacity = memberships(self.scene, self.encoders.scene_style, cameras, 0, place)
        return int(share[0].argmax()) if float(opacity[0]) >= _SOLID else None

    def region_info(self, look: Look, region: int) -> RegionInfo:
        """Return the style that a region takes in a look."""
        # A region stands for its points: its key is matched as they are.
        scene, styled = self.encoders.scene_style, self.styled(look)
        taken: list[tuple[str, float]] = []
        if styled is not None:
            # What the region's key takes of each code, summed by photograph.
            attention = styled.restyle.match(scene.keys[region : region + 1].to(self.scene.device))[0].cpu()
            shares = torch.zeros(len(styled.codes.names)).index_add_(0, styled.codes.reference, attention.float())
            names = [photograph.name for photograph, _ in look.mix]
            taken = sorted(zip(names, shares.tolist(), strict=True), key=lambda row: -row[1])
        return RegionInfo(region, float(scene.share[region]), tuple(taken))


def _cached(cache: dict[Key, Value], key: Key, make: Callable[[], Value]) -> Value:
    """Return what is kept under a key, or make it; it becomes the last to be dropped."""
    cache[key] = cache.pop(key) if key in cache else make()
    while len(cache) > _CACHED:
        del cache[next(iter(cache))]
    return cache[key]


def matching_regions(before: SceneStyle, now: SceneStyle) -> Annotated[Tensor, "K"]:
    """For each region of `before` the most similar one of `now`: regions are measured anew, in any order."""
    if before.keys.shape[1] == 0:
        return torch.zeros(len(before.keys), dtype=torch.int64)
    # Cosines about the mean of the features before, as regions are matched to codes.
    scores = unit(before.keys, before.semantic_mean) @ unit(now.keys, now.semantic_mean).T
    return scores.argmax(-1)
