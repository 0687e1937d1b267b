"""Looks, and photographs, on one scene.

A look says how a scene is coloured: an immutable value, made by the page's controls, that `style_config` translates into the
terms of `style.json`. `Restyler` applies looks; it runs on the render worker alone. A photograph is encoded when it comes and
clustered once for each number of clusters: a slider costs the stylizer alone.
"""

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Literal, NamedTuple, TypeAlias, TypeVar

import torch
from torch import Tensor

from ..datamanagers.images import load_image
from ..errors import UsageError
from ..interfaces import Scene
from ..io.images import Picture, shrink
from ..plugins.stylizers.config import RegionToneConfig
from ..rendering.cameras import Cameras
from ..style.config import StyleConfig, labels
from ..style.dictionary import Encoders, Reference, StyleDictionary, build_dictionary, concatenate, encode_photograph
from ..style.files import StyleFile
from ..style.look import Restyle
from ..style.matching import unit
from ..style.regions import memberships
from ..style.restyle import Styled, apply_dictionary
from ..style.scene_style import SceneStyle

Key = TypeVar("Key")
Value = TypeVar("Value")
RegionAction: TypeAlias = Literal["pin", "forbid", "keep"]
_THUMBNAIL = 128
"""Longest side in pixels."""
_CACHED = 24
"""Dictionaries and styles that are kept for when somebody returns to them."""
_SOLID = 0.01
"""Opacity below which there is nothing to point at."""


@dataclass(frozen=True, eq=False)
class Photograph:
    """A photograph on the shelf, encoded once; compared by identity."""

    number: int
    """Its name in requests of the page."""
    name: str
    path: Path
    thumbnail: Picture
    reference: Reference


class RegionRule(NamedTuple):
    """A style that a region may take; `photograph` is None where the region is kept as it is."""

    region: int
    action: RegionAction
    photograph: Photograph | None


@dataclass(frozen=True, kw_only=True)
class Look:
    """Colours of a scene; equal looks are the same style. Ranges are those of `StyleConfig`."""

    mix: tuple[tuple[Photograph, float], ...] = ()
    """Photographs with their weights, above 0, in the order of the shelf; none = the scene as it is."""
    strength: float = 1.0
    bold: float = StyleConfig.bold
    """How far paint goes where the match is not sure, in [0, 1]."""
    luminance: float = 0.0
    temperature: float = 0.2
    """Of the matching of regions and codes, relative; low = each region takes from what is most like it."""
    clusters: int = 20
    blend: float = 0.1
    smoothness: float = RegionToneConfig.smoothness
    """Smoothness of styles between neighbouring regions without an edge between them, at least 0."""
    rules: frozenset[RegionRule] = frozenset()

    def __post_init__(self) -> None:
        style_config(self)  # which knows the ranges

    @property
    def plain(self) -> bool:
        """True for the scene as it was captured."""
        return not self.mix or self.strength == 0


def only(look: Look, photograph: Photograph) -> Look:
    """The look with one photograph alone."""
    return _valid_rules(replace(look, mix=((photograph, 1.0),)))


def set_weight(look: Look, photograph: Photograph, weight: float, shelf: Iterable[Photograph]) -> Look:
    """The look with another weight of a photograph; 0 removes it together with the rules that name it."""
    weights = dict(look.mix) | {photograph: weight}
    mix = tuple((each, weights[each]) for each in shelf if weights.get(each, 0.0) > 0)
    return _valid_rules(replace(look, mix=mix))


def set_rule(look: Look, region: int, action: RegionAction | None, photograph: Photograph | None = None) -> Look:
    """The look with a rule for a region; None removes its rules. Pinning and keeping replace the rules it had.

    A region for which every photograph would be forbidden loses its rules instead.
    """
    mine = {rule for rule in look.rules if rule.region == region}
    rest = look.rules - mine
    if action is None:
        return replace(look, rules=rest)
    new = {RegionRule(region, action, None if action == "keep" else photograph)}
    # Forbidden photographs add up; every other rule takes the place of those before it.
    if action == "forbid":
        new |= {rule for rule in mine if rule.action == "forbid"}
        if {rule.photograph for rule in new} >= {each for each, _ in look.mix}:
            return replace(look, rules=rest)
    return replace(look, rules=rest | new)


def renumbered(look: Look, regions: Sequence[int]) -> Look:
    """The look with region r as regions[r]: regions were measured again."""
    return replace(look, rules=frozenset(rule._replace(region=regions[rule.region]) for rule in look.rules))


def style_config(look: Look, stylizer: RegionToneConfig | None = None) -> StyleConfig:
    """The look as a style; references in the order of the mix."""
    number = {photograph: i for i, (photograph, _) in enumerate(look.mix)}

    def order(rule: RegionRule) -> tuple[int, str, int]:
        return rule.region, rule.action, -1 if rule.photograph is None else number.get(rule.photograph, -1)

    # REGION=REFERENCE, by the reference's place in the mix, as `--pin` and `--forbid` take them; `--keep` takes regions.
    texts: dict[str, list[str]] = {"pin": [], "forbid": [], "keep": []}
    for rule in sorted(look.rules, key=order):
        if rule.photograph is None:
            texts[rule.action].append(str(rule.region))
        elif rule.photograph in number:
            texts[rule.action].append(f"{rule.region}={number[rule.photograph]}")
    return StyleConfig(
        references=tuple(photograph.path for photograph, _ in look.mix),
        weights=tuple(weight for _, weight in look.mix),
        stylizer=replace(stylizer or RegionToneConfig(), temperature=look.temperature, smoothness=look.smoothness),
        clusters=look.clusters,
        blend=look.blend,
        strength=look.strength,
        bold=look.bold,
        luminance=look.luminance,
        pin=tuple(texts["pin"]),
        forbid=tuple(texts["forbid"]),
        keep=tuple(texts["keep"]),
    )


def _valid_rules(look: Look) -> Look:
    """The look without rules for photographs that are not in its mix."""
    mix = {photograph for photograph, _ in look.mix}
    return replace(look, rules=frozenset(rule for rule in look.rules if rule.photograph is None or rule.photograph in mix))


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
            clusters, blend, parts = look.clusters, look.blend, []
            for photograph, _ in look.mix:
                cluster = partial(
                    build_dictionary, [photograph.reference], clusters=clusters, blend=blend, seed=self.encoders.seed
                )
                parts.append(_cached(self._dictionaries, (photograph, clusters, blend), cluster))
            style = style_config(look, self._stylizer)
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
