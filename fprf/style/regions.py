"""What a style asks of single regions of a scene: which regions its texts mean, and what each of them may
take.

Letters: K regions of the scene, T style codes. A region is named by its number, by its name in a style file,
by a pixel of a view (`VIEW:X,Y`) or by a mask over one (`VIEW:MASK.png`); the grammar is that of
`style.config`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from ..datamanagers.basis import Basis
from ..datamanagers.images import load_mask
from ..errors import UsageError
from ..io.paths import as_path
from ..rendering.cameras import Cameras, pixel_grid
from ..scenes import Scene
from .config import (
    Place,
    StyleConfig,
    find_reference,
    labels,
    parse_pixel,
    parse_place,
    parse_region_value,
    parse_strength,
)
from .dictionary import StyleDictionary
from .files import RegionKey, StyleFile
from .matching import scores, unit
from .scene_style import Membership, SceneStyle

ALIKE = 0.5
"""Least cosine of a region with a key from elsewhere: below, the scene has no such region.

Between the embedded towns in all lights and a photographed street, right matches lay from 0.53 to 0.98
(bundled semantic encoder, 8 regions a scene); of the regions of scenes with nothing in common 9 in 10 lay
below.
"""

_MASK_SIDE_PIXELS = 128
"""Longest side in pixels at which a mask over a view is looked at."""

_MIN_POINTED_OPACITY = 0.01
"""Less opacity is nothing to point at."""


class Regions(NamedTuple):
    """A scene's regions, and what is needed to find them."""

    scene: Scene
    scene_style: SceneStyle
    basis: Basis | None
    keys: Mapping[str, RegionKey] = {}
    """Regions that a style file names."""
    encoder: str = ""
    """Identity of the encoder that the keys are of, if the file tells."""

    @property
    def keys_fit(self) -> bool:
        """The keys are of the scene's own semantic encoder."""
        lengths_fit = self.basis is not None and {*map(len, self.keys.values())} == {len(self.basis.mean)}
        return lengths_fit and self.encoder in ("", self.scene.semantic_encoder)


class RegionMatch(NamedTuple):
    """One region that somebody meant."""

    number: int
    name: str
    """Its name in the style file, or the number as text."""
    alike: float = 1.0
    """Cosine with the key of that name; 1 where the region was pointed at."""


def key_of(regions: Regions, number: int) -> RegionKey:
    """The semantics of a region in the encoder's own channels, to six digits: what it can be found by on
    another scene.
    """
    if regions.basis is None:
        return ()
    return tuple(float(f"{x:.6g}") for x in regions.basis.lift(regions.scene_style.keys[number]).tolist())


def find_regions(regions: Regions, text: str) -> list[RegionMatch]:
    """Find the regions that a text means: one, those that a mask covers, or those like a region of the style
    file, if any are.

    Raises UsageError for what names nothing on this scene, DataError for an unreadable mask.
    """
    count = len(regions.scene_style.share)
    if text.isascii() and text.isdigit():
        if int(text) >= count:
            raise UsageError(f"region {text}: regions go from 0 to {count - 1}; --explain lists them")
        return [RegionMatch(int(text), text)]
    if text in regions.keys:
        return _alike(regions, text)
    view = _view_named_in(regions, text)
    rest = text[len(regions.scene.names[view]) + 1 :]
    pixel = parse_pixel(rest)
    if pixel is None:
        found = _regions_under_mask(regions, view, as_path(rest))
    else:
        found = {_region_at_pixel(regions, view, pixel, text)}
    result: list[RegionMatch] = []
    for k in sorted(found):
        result.append(RegionMatch(k, str(k)))
    return result


def _view_named_in(regions: Regions, text: str) -> int:
    """The view that a text begins with."""
    names = regions.scene.names
    # Longest names first: one view's name may begin with another's.
    for view in sorted(range(len(names)), key=lambda v: -len(names[v])):
        if text.startswith(f"{names[view]}:"):
            return view
    named = ""
    if regions.keys:
        named = f", a name in the style file ({', '.join(regions.keys)})"
    raise UsageError(
        f"region {text!r}: neither a number{named}, nor VIEW:X,Y or VIEW:MASK.png with a view of the run "
        f"({names[0]} … {names[-1]})"
    )


def _region_at_pixel(regions: Regions, view: int, pixel: tuple[float, float], text: str) -> int:
    """The region that most of what a pixel sees belongs to."""
    x, y = pixel
    width, height = regions.scene.cameras.size[view].tolist()
    if not (0 <= x < width and 0 <= y < height):
        raise UsageError(
            f"{text}: outside of the view; x goes from 0 to {width - 1}, y from 0 to {height - 1}"
        )
    centre = torch.tensor([[int(x) + 0.5, int(y) + 0.5]], dtype=torch.float64)
    share, opacity = memberships(regions.scene, regions.scene_style, regions.scene.cameras, view, centre)
    if float(opacity[0]) < _MIN_POINTED_OPACITY:
        raise UsageError(f"{text}: there is nothing at that pixel; choose another")
    return int(share[0].argmax())


def _regions_under_mask(regions: Regions, view: int, path: Path) -> set[int]:
    """Regions of which a mask covers more than half of what the view shows, and the one that fills most of the
    mask: by their mass in the view and under the mask, on a small copy of both.
    """
    share, opacity = membership_view(regions, view, _MASK_SIDE_PIXELS)
    painted = load_mask(path, upright=True).astype(np.float32)
    white = np.asarray(cv2.resize(painted, opacity.shape[::-1], interpolation=cv2.INTER_AREA))
    mass = (share * opacity[..., None]).flatten(0, 1)
    inside = torch.from_numpy(white).flatten() @ mass
    total = mass.sum(0)
    if float(inside.sum()) < _MIN_POINTED_OPACITY:
        raise UsageError(
            f"{path}: the mask selects nothing of view {regions.scene.names[view]}; paint white what counts"
        )
    mostly = (inside / total.clamp_min(1e-10) > 0.5) & (inside >= 1)
    return {int(inside.argmax()), *mostly.nonzero().flatten().tolist()}


def _alike(regions: Regions, name: str) -> list[RegionMatch]:
    """Find the regions that, of all that the style file knows, are most like the one of that name, and really
    like it.
    """
    style = regions.scene_style
    if regions.basis is None or not regions.keys_fit:
        raise UsageError(
            f"region {name!r}: the style file knows it by the semantic encoder {regions.encoder or '(unnamed)'}, the scene has "
            f"{regions.scene.semantic_encoder or 'none'}; name the region by its number or a pixel of a view instead, or "
            "choose that encoder with --semantic.encoder"
        )
    if len(style.share) == 1:
        return [RegionMatch(0, name)]
    # Among all keys of the file: a region that is more like another name is left to that.
    there = regions.basis.project(torch.tensor(list(regions.keys.values())))
    alike, nearest = scores(unit(style.keys, style.semantic_mean), unit(there, style.semantic_mean)).max(1)
    mine = (nearest == list(regions.keys).index(name)) & (alike >= ALIKE)
    found: list[RegionMatch] = []
    for k in mine.nonzero().flatten().tolist():
        found.append(RegionMatch(k, name, float(alike[k])))
    return found


def memberships(
    scene: Scene, style: SceneStyle, cameras: Cameras, view: int, pixel: Annotated[Tensor, "N 2"]
) -> tuple[Annotated[Tensor, "N K"], Annotated[Tensor, "N"]]:
    """Share of what pixels (centres) see that belongs to each region of a scene's style, and their
    opacity.
    """
    belongs = Membership(style.keys, style.semantic_mean).to(scene.device)
    return scene.paint(
        cameras, view, pixel, lambda features, points: belongs(features), semantic=belongs.divided
    )


def membership_view(
    regions: Regions, view: int, size: int
) -> tuple[Annotated[Tensor, "H W K"], Annotated[Tensor, "H W"]]:
    """Share of each pixel that belongs to each region, and its opacity, with the longest side at most `size`
    pixels.
    """
    cameras = shrunk(regions.scene.cameras, view, size)
    share, opacity = memberships(regions.scene, regions.scene_style, cameras, 0, pixel_grid(cameras, 0))
    width, height = (int(v) for v in cameras.size[0])
    return share.view(height, width, -1), opacity.view(height, width)


def shrunk(cameras: Cameras, view: int, size: int) -> Cameras:
    """One view alone, with the longest side at most `size` pixels."""
    one = cameras.select(torch.tensor([view]))
    return one.scaled(max(1.0, float(one.size.amax()) / size))


class RegionControls(NamedTuple):
    """Controls of each of K regions."""

    allowed: Annotated[Tensor, "K references"]
    """References that it may take from, bool, in the order of the dictionary."""
    strength: Annotated[Tensor, "K"]
    """Strength of the style; 0 = kept."""
    score: Annotated[Tensor, "K T"]
    """Cosine of the region with each style code, both from the scene's mean, in [-1, 1]; 0 without
    semantics.
    """
    saved: StyleFile
    """The style with every region named in terms that hold on other scenes."""
    regions: Regions
    notes: tuple[str, ...]
    """A line for each thing that the user may not expect."""
    places: tuple[tuple[Place, Annotated[Tensor, "K references"]], ...]
    """References that each region may take from in places, each over those before it."""


def region_controls(regions: Regions, dictionary: StyleDictionary, style: StyleConfig) -> RegionControls:
    """Find every region and reference that the style names. Raises UsageError for those that are not there,
    or contradict.
    """
    names = _StyleNames(regions, dictionary, style.references)
    asked = _find_asked(names, style)
    allowed = _allowed_references(names, asked)
    # Scores say whether the references show such a thing at all, so both sides are seen from the scene's
    # mean. Matching, which only has to choose, centres each side on its own: there a rose's petals are as far
    # from its leaves as the sky from the road, and something would always fit.
    centre = regions.scene_style.semantic_mean
    score = scores(unit(regions.scene_style.keys, centre), unit(dictionary.keys, centre))
    strength = _region_strengths(names, asked, style, score, allowed)
    file = StyleFile(_portable_style(names, asked, style), names.keys, regions.scene.semantic_encoder)
    notes = tuple(dict.fromkeys(names.notes))
    return RegionControls(
        allowed, strength, score, file, regions, notes, _places_allowed(names, asked, allowed)
    )


class _Asked(NamedTuple):
    """Rules of a style, by numbers of regions and references."""

    pins: list[tuple[RegionMatch, int]]
    bans: list[tuple[RegionMatch, int]]
    kept: list[RegionMatch]
    strengths: list[tuple[RegionMatch, float]]
    places: dict[str, tuple[Place, set[int]]]
    """Places by their texts, with the references that they take from."""

    @property
    def pinned(self) -> set[int]:
        """Numbers of the regions that are pinned."""
        found: set[int] = set()
        for match, _ in self.pins:
            found.add(match.number)
        return found


def _find_asked(names: "_StyleNames", style: StyleConfig) -> _Asked:
    pins = []
    places: dict[str, tuple[Place, set[int]]] = {}
    for text in style.pin:
        pin = parse_region_value("pin", text)
        place = parse_place("pin", pin.region)
        if place is None:
            pins.append(pin)
        else:
            _, chosen = places.setdefault(pin.region, (place, set()))
            chosen.add(find_reference(pin.value, style.references))
    bans = []
    for text in style.forbid:
        bans.append(parse_region_value("forbid", text))
    kept: list[RegionMatch] = []
    for text in style.keep:
        kept += names.find(text)
    strengths: list[tuple[RegionMatch, float]] = []
    for text in style.region_strength:
        region, value = parse_strength("region_strength", text)
        for match in names.find(region):
            strengths.append((match, value))
    asked = _Asked(names.find_pairs(pins), names.find_pairs(bans), kept, strengths, places)
    partly = asked.pinned | {match.number for match, _ in strengths}
    for match in kept:
        if match.number in partly:
            raise UsageError(
                f"region {match.name}: is to be kept, and to be pinned or restyled in part; leave out one of both"
            )
    return asked


def _allowed_references(names: "_StyleNames", asked: _Asked) -> Annotated[Tensor, "K references"]:
    """References that each region may take from: a pinned region those that it is pinned to, every other one all
    that are not forbidden.
    """
    allowed = torch.ones(len(names.regions.scene_style.share), len(names.dictionary.names), dtype=torch.bool)
    allowed[sorted(asked.pinned)] = False
    for match, i in asked.pins:
        allowed[match.number, names.order[i]] = True
    for match, i in asked.bans:
        allowed[match.number, names.order[i]] = False
    for k in (~allowed.any(1)).nonzero().flatten().tolist():
        raise UsageError(f"region {k}: every reference is forbidden; allow one, or keep the region as it is")
    return allowed


def _region_strengths(
    names: "_StyleNames",
    asked: _Asked,
    style: StyleConfig,
    score: Annotated[Tensor, "K T"],
    allowed: Annotated[Tensor, "K references"],
) -> Annotated[Tensor, "K"]:
    """Strength of the style in each region; 0 = kept."""
    strength = torch.ones(len(allowed))
    for match, value in asked.strengths:
        strength[match.number] = value
    strength[[match.number for match in asked.kept]] = 0.0
    if style.keep_below is None:
        return strength
    best = score.masked_fill(~allowed[:, names.dictionary.reference], -torch.inf).amax(1)
    poor = (best < style.keep_below).nonzero().flatten().tolist()
    strength[[k for k in poor if k not in asked.pinned]] = 0.0
    if poor and not bool(strength.any()):
        if len(score) == 1:
            scored = "a scene of one region has no scores"
        else:
            scored = f"the best score is {float(best.max()):.2f}"
        names.notes.append(f"keep_below {style.keep_below:g}: every region stays as it is; {scored}")
    return strength


def _places_allowed(
    names: "_StyleNames", asked: _Asked, allowed: Annotated[Tensor, "K references"]
) -> tuple[tuple[Place, Annotated[Tensor, "K references"]], ...]:
    """What regions may take in each place: of its references those that they may; all of them where that is
    none.
    """
    found = []
    for place, chosen in asked.places.values():
        only = torch.zeros(allowed.shape[1], dtype=torch.bool)
        only[[names.order[i] for i in chosen]] = True
        both = allowed & only
        found.append((place, torch.where(both.any(1, keepdim=True), both, only)))
    return tuple(found)


def _portable_style(names: "_StyleNames", asked: _Asked, style: StyleConfig) -> StyleConfig:
    """The style with regions named by keys, which hold on other scenes, and references by file."""
    pins = []
    for match, i in asked.pins:
        pins.append(f"{names.region(match)}={names.reference(i)}")
    for text, (_, chosen) in asked.places.items():
        for i in sorted(chosen):
            pins.append(f"{text}={names.reference(i)}")
    return replace(
        style,
        pin=tuple(pins),
        forbid=tuple(f"{names.region(match)}={names.reference(i)}" for match, i in asked.bans),
        keep=tuple(names.region(match) for match in asked.kept),
        region_strength=tuple(f"{names.region(match)}={value:g}" for match, value in asked.strengths),
    )


class _StyleNames:
    """Finds regions and references by what a style calls them, and collects the keys and notes that belong to
    them.
    """

    def __init__(self, regions: Regions, dictionary: StyleDictionary, references: Sequence[Path]) -> None:
        self.regions = regions
        self.dictionary = dictionary
        self.references = references
        self.labels = labels(references)
        self.order = [dictionary.names.index(label) for label in self.labels]
        # All regions, not only those that are named: on another scene each must find its like among all of
        # them.
        every = {}
        for k in range(len(regions.scene_style.share)):
            if regions.basis is not None:
                every[f"region{k}"] = key_of(regions, k)
        if regions.keys_fit:
            self.keys = dict(regions.keys)
        else:
            self.keys = every
        self.notes: list[str] = []

    def find(self, text: str) -> list[RegionMatch]:
        """Find the regions that a text means, and note what is not obvious about them."""
        matches = find_regions(self.regions, text)
        if not matches:
            self.notes.append(
                f"region {text!r} of the style: no region here is most like it, so it is left out"
            )
        for each in matches:
            if each.name in self.regions.keys:
                self.notes.append(
                    f"region {text!r} of the style is region {each.number} here (cosine {each.alike:.2f})"
                )
        return matches

    def find_pairs(self, texts: Sequence[tuple[str, str]]) -> list[tuple[RegionMatch, int]]:
        """Find regions and references of REGION=REFERENCE; a mask may mean several regions."""
        found: list[tuple[RegionMatch, int]] = []
        for region, value in texts:
            for match in self.find(region):
                found.append((match, find_reference(value, self.references)))
        return found

    def reference(self, number: int) -> str:
        """A reference as a style file names it, wherever its photographs are moved to."""
        name = self.references[number].name
        if self.labels[number] == name and "=" not in name:
            return name
        return str(number)

    def region(self, region: RegionMatch) -> str:
        """Name of a region in a style file, which holds its key under that name."""
        if region.name in self.regions.keys or not self.keys:
            return region.name
        key = key_of(self.regions, region.number)
        name = f"region{region.number}"
        same_key = []
        for other, its in self.keys.items():
            if its == key:
                same_key.append(other)
        if same_key:
            return same_key[0]
        while name in self.keys:
            name += "'"
        self.keys[name] = key
        return name
