"""References to a style on a scene: the feed-forward step, a second or less a photograph, and what holds for single regions."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ..errors import ConfigError, UsageError
from ..interfaces import Scene
from ..plugins.stylizers.config import StylizerConfig
from ..testing.outputs import check_stylizer
from .colours import own_colours
from .config import NO_MASK, Place, StyleConfig, find_reference, labels, parse_place, parse_region_value, parse_strength
from .controls import allowed_references
from .dictionary import BLEND, CLUSTERS, Reference, StyleDictionary, build_dictionary
from .files import StyleFile, check_photographs, read_style
from .light import light_of
from .look import Restyle
from .matching import scores, unit
from .references import Encoders, encode_photograph
from .regional import RegionWeight, regional
from .regions import RegionMatch, Regions, find_regions, key_of
from .scene import SceneStyle


class Codes(NamedTuple):
    """The style codes that points can take, of one style or of two that are mixed: what match maps speak of."""

    reference: Annotated[Tensor, "T"]
    names: tuple[str, ...]
    units: Annotated[Tensor, "T D"]
    """Directions of their keys from the scene's mean: cosines with these are scores."""


class Styled(NamedTuple):
    """A style on a scene."""

    restyle: Restyle
    dictionary: StyleDictionary
    scene: SceneStyle
    codes: Codes
    controls: "RegionControls"


@torch.inference_mode()
def apply_style(
    here: Scene,
    file: StyleFile,
    encoders: Encoders | None = None,
    trail: tuple[Path, ...] = (),
    encoded: dict[tuple[Path, Path], Reference] | None = None,
) -> Styled:
    """Build the dictionary of a style's references and its stylizer on the scene; mix in the style that it goes towards.

    `trail` are the style files that led here. `encoded` keeps photographs with their masks for further styles. Raises
    UsageError for no references and wishes that the scene does not know, DataError for unreadable photographs, WeightsError
    where the encoders are not the scene's.
    """
    style = file.style
    if not style.references:
        raise UsageError("--references: at least one photograph is needed, for example --references autumn.jpg night.jpg")
    encoders = here.encoders() if encoders is None else encoders
    styled = dress(here, file, encoders, _dictionary(style, encoders, {} if encoded is None else encoded))
    if style.between is None or style.at == 0:
        return styled
    path = style.between.resolve()
    if path in trail:
        raise ConfigError(f"{style.between}: lies between styles that lead back to it; end the circle")
    other = read_style(style.between)
    check_photographs(style.between, other)
    return mixed(styled, apply_style(here, other, encoders, (*trail, path)), style.at)


@torch.inference_mode()
def dress(here: Scene, file: StyleFile, encoders: Encoders, dictionary: StyleDictionary) -> Styled:
    """A style whose dictionary is built already, on the scene. `between` is not heeded.

    The dictionary's names are the labels of the style's references. Raises UsageError for wishes that the scene does not know.
    """
    style, scene, basis = file.style, encoders.scene, encoders.basis
    if basis is not None:
        dictionary = dictionary._replace(origin=basis.origin().to(dictionary.keys))
    regions = Regions(here, scene, basis, file.regions, file.semantic_encoder)
    controls = region_controls(regions, dictionary, style)
    if controls.places and here.decoder is not None:
        raise UsageError("--pin: places are for Gaussians; for a run of fields pin regions, such as --pin 3=autumn.jpg")
    chosen, device = style.stylizer, here.device
    partly = bool((controls.strength != 1).any())
    weight = RegionWeight(scene, controls.strength[:, None]).to(device) if partly else None

    def look(allowed: Annotated[Tensor, "K references"]) -> Restyle:
        stylizer = regional(dictionary, scene, allowed, chosen)
        check_stylizer(chosen, stylizer, dictionary, scene, affine=here.decoder is None and chosen.colours <= 0)
        stylizer = stylizer.to(device)
        colours = here.colour_maps(stylizer, dictionary, scene, chosen, allowed)
        moved = None if colours is None else colours.to(device)
        light = None
        if chosen.light and style.bold < 1:
            own = own_colours(stylizer, scene, here.decoder)
            light = light_of(scene, dictionary, match, own, bold=style.bold, allowed=allowed)
            light = None if light is None else light.to(device)
        return Restyle(stylizer, style.strength, weight, chosen.features, moved, style.luminance, light=light)

    def match(part: StyleDictionary) -> Annotated[Tensor, "K T"]:
        return chosen.build(dictionary=part, scene=scene).region_match(scene.keys)

    places = tuple((place.about(here.origin), look(allowed)) for place, allowed in controls.places)
    mine = replace(look(controls.allowed), places=places)
    codes = Codes(dictionary.reference, dictionary.names, unit(dictionary.keys, scene.semantic_mean))
    return Styled(mine, dictionary, scene, codes, controls)


def restyle(
    here: Scene,
    references: Sequence[Path],
    stylizer: StylizerConfig,
    *,
    strength: float = 1.0,
    weights: Sequence[float] = (),
    clusters: int = CLUSTERS,
    blend: float = BLEND,
) -> Styled:
    """`apply_style` without wishes about regions."""
    style = StyleConfig(
        references=tuple(references),
        stylizer=stylizer,
        strength=strength,
        weights=tuple(weights),
        clusters=clusters,
        blend=blend,
    )
    return apply_style(here, StyleFile(style))


def _dictionary(style: StyleConfig, encoders: Encoders, encoded: dict[tuple[Path, Path], Reference]) -> StyleDictionary:
    references = []
    for i, (path, name) in enumerate(zip(style.references, labels(style.references), strict=True)):
        mask, weight = style.masks[i] if style.masks else NO_MASK, style.weights[i] if style.weights else 1.0
        if (path, mask) not in encoded:
            encoded[path, mask] = encode_photograph(path, encoders, name=name, mask=None if mask == NO_MASK else mask)
        references.append(encoded[path, mask]._replace(name=name, weight=weight))
    return build_dictionary(references, clusters=style.clusters, blend=style.blend, seed=encoders.seed)


def mixed(a: Styled, b: Styled, at: float) -> Styled:
    """Style `a` on the way to `b`, which lies at 1.

    The dictionary and the controls stay those of `a`; codes and notes are those of both.
    """
    reference = torch.cat([a.codes.reference, b.codes.reference + len(a.codes.names)])
    codes = Codes(reference, a.codes.names + b.codes.names, torch.cat([a.codes.units, b.codes.units]))
    controls = a.controls._replace(notes=a.controls.notes + b.controls.notes)
    return a._replace(restyle=a.restyle.mixed(b.restyle, at), codes=codes, controls=controls)


class RegionControls(NamedTuple):
    """Controls of each of K regions."""

    allowed: Annotated[Tensor, "K references"]
    """References that it may take from, bool, in the order of the dictionary."""
    strength: Annotated[Tensor, "K"]
    """Strength of the style; 0 = kept."""
    score: Annotated[Tensor, "K T"]
    """Cosine of the region with each style code, both from the scene's mean; 0 without semantics."""
    saved: StyleFile
    """The style with every wish in terms that hold on other scenes."""
    regions: Regions
    notes: tuple[str, ...]
    """A line for each thing that the user may not expect."""
    places: tuple[tuple[Place, Annotated[Tensor, "K references"]], ...]
    """References that each region may take from in places, each over those before it."""


def region_scores(scene: SceneStyle, dictionary: StyleDictionary) -> Annotated[Tensor, "K T"]:
    """Cosines between regions and style codes, in [-1, 1]: whether the references show such a thing at all.

    Both are seen from the scene's mean. Matching, which only has to choose, centres each side on its own: there a rose's
    petals are as far from its leaves as the sky from the road, and something would always fit.
    """
    return scores(unit(scene.keys, scene.semantic_mean), unit(dictionary.keys, scene.semantic_mean))


def region_controls(regions: Regions, dictionary: StyleDictionary, style: StyleConfig) -> RegionControls:
    """Find every region and reference that the style names. Raises UsageError for those that are not there, or contradict."""
    book = _Book(regions, dictionary, style.references)
    wishes = [parse_region_value("pin", text) for text in style.pin]
    place_of = {wish.region: place for wish in wishes if (place := parse_place("pin", wish.region))}
    pins = book.pairs([wish for wish in wishes if wish.region not in place_of])
    bans = book.pairs([parse_region_value("forbid", text) for text in style.forbid])
    kept = [match for text in style.keep for match in book.find(text)]
    parsed = [parse_strength("region_strength", text) for text in style.region_strength]
    strengths = [(match, value) for text, value in parsed for match in book.find(text)]
    pinned: dict[int, set[int]] = {}
    for match, i in pins:
        pinned.setdefault(match.number, set()).add(book.order[i])
    allowed = allowed_references(
        len(regions.scene.share), len(dictionary.names), pin=pinned, forbid=[(f.number, book.order[i]) for f, i in bans]
    )
    for match in kept:
        if match.number in pinned or match.number in {f.number for f, _ in strengths}:
            raise UsageError(f"region {match.name}: is to be kept, and to be pinned or restyled in part; leave out one of both")
    strength, score = torch.ones(len(allowed)), region_scores(regions.scene, dictionary)
    for match, value in strengths:
        strength[match.number] = value
    strength[[match.number for match in kept]] = 0.0
    if style.keep_below is not None:
        best = score.masked_fill(~allowed[:, dictionary.reference], -torch.inf).amax(1)
        poor = (best < style.keep_below).nonzero().flatten().tolist()
        strength[[k for k in poor if k not in pinned]] = 0.0
    taken: dict[str, set[int]] = {}
    for wish in wishes:
        if wish.region in place_of:
            taken.setdefault(wish.region, set()).add(find_reference(wish.value, style.references))
    places = []
    for text, chosen in taken.items():
        only = torch.zeros(len(dictionary.names), dtype=torch.bool)
        only[[book.order[i] for i in chosen]] = True
        # What regions may take of these references; all of them where that is none.
        both = allowed & only
        places.append((place_of[text], torch.where(both.any(1, keepdim=True), both, only)))
    saved = replace(
        style,
        pin=(
            *(f"{book.name(f)}={book.label(i)}" for f, i in pins),
            *(f"{text}={book.label(i)}" for text, chosen in taken.items() for i in sorted(chosen)),
        ),
        forbid=tuple(f"{book.name(f)}={book.label(i)}" for f, i in bans),
        keep=tuple(book.name(f) for f in kept),
        region_strength=tuple(f"{book.name(f)}={value:g}" for f, value in strengths),
    )
    file = StyleFile(saved, book.keys, regions.views.semantic_encoder)
    return RegionControls(allowed, strength, score, file, regions, tuple(dict.fromkeys(book.notes)), tuple(places))


class _Book:
    """Looks up names, and remembers which keys and notes belong to them."""

    def __init__(self, regions: Regions, dictionary: StyleDictionary, references: Sequence[Path]) -> None:
        self.regions, self.references = regions, references
        self.names = labels(references)
        self.order = [dictionary.names.index(name) for name in self.names]
        # All regions, not only those that are wished about: on another scene each must find its like among all of them.
        every = {f"region{k}": key_of(regions, k) for k in range(len(regions.scene.share)) if regions.basis is not None}
        self.keys = dict(regions.keys) if regions.keys else every
        self.notes: list[str] = []

    def find(self, text: str) -> list[RegionMatch]:
        matches = find_regions(self.regions, text)
        if not matches:
            self.notes.append(f"region {text!r} of the style: no region here is most like it, so it is left out")
        for each in matches:
            if each.name in self.regions.keys:
                self.notes.append(f"region {text!r} of the style is region {each.number} here (cosine {each.alike:.2f})")
        return matches

    def pairs(self, wishes: Sequence[tuple[str, str]]) -> list[tuple[RegionMatch, int]]:
        """Regions and references of REGION=REFERENCE; a mask may mean several regions."""
        return [(match, find_reference(value, self.references)) for region, value in wishes for match in self.find(region)]

    def label(self, reference: int) -> str:
        """A reference as a style file names it, wherever its photographs are moved to."""
        name = self.references[reference].name
        return name if self.names[reference] == name else str(reference)

    def name(self, region: RegionMatch) -> str:
        """Name of the region in a style file, which holds its key under that name."""
        if region.name in self.regions.keys or not self.keys:
            return region.name
        key, name = key_of(self.regions, region.number), f"region{region.number}"
        known = [other for other, its in self.keys.items() if its == key]
        if known:
            return known[0]
        while name in self.keys:
            name += "'"
        self.keys[name] = key
        return name
