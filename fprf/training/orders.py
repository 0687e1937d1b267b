"""A user's wishes about regions, found out on a scene: what each region may take, how strongly, and under which names."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ..errors import UsageError
from ..style.config import StyleConfig, find_reference, labels, parse_region_value, parse_strength
from ..style.controls import allowed_references
from ..style.dictionary import StyleDictionary
from ..style.files import StyleFile
from ..style.matching import scores, unit
from ..style.scene import SceneStyle
from .regions import Found, Regions, find_regions, key_of

__all__ = ["Orders", "region_scores", "take_orders"]


class Orders(NamedTuple):
    """What holds for each of K regions."""

    allowed: Annotated[Tensor, "K references"]
    """Which references it may take from, bool, in the order of the dictionary."""
    strength: Annotated[Tensor, "K"]
    """How strongly it is restyled; 0 = kept."""
    score: Annotated[Tensor, "K T"]
    """Cosine of the region with each style code, both from the scene's mean; 0 without semantics."""
    saved: StyleFile
    """The style with every wish in terms that hold on other scenes."""
    regions: Regions
    notes: tuple[str, ...]
    """A line for each thing that the user may not expect."""


def region_scores(scene: SceneStyle, dictionary: StyleDictionary) -> Annotated[Tensor, "K T"]:
    """Cosines between regions and style codes, in [-1, 1]: whether the references show such a thing at all.

    Both are seen from the scene's mean. Matching, which only has to choose, centres each side on its own: there a rose's
    petals are as far from its leaves as the sky from the road, and something would always fit.
    """
    return scores(unit(scene.keys, scene.semantic_mean), unit(dictionary.keys, scene.semantic_mean))


def take_orders(regions: Regions, dictionary: StyleDictionary, style: StyleConfig) -> Orders:
    """Find every region and reference that the style names. Raises UsageError for those that are not there, or contradict."""
    book = _Book(regions, dictionary, style.references)
    pins, bans = book.pairs("pin", style.pin), book.pairs("forbid", style.forbid)
    kept = [found for text in style.keep for found in book.find(text)]
    parsed = [parse_strength("region_strength", text) for text in style.region_strength]
    strengths = [(found, value) for text, value in parsed for found in book.find(text)]
    pinned: dict[int, set[int]] = {}
    for found, i in pins:
        pinned.setdefault(found.number, set()).add(book.order[i])
    allowed = allowed_references(
        len(regions.scene.share), len(dictionary.names), pin=pinned, forbid=[(f.number, book.order[i]) for f, i in bans]
    )
    for found in kept:
        if found.number in pinned or found.number in {f.number for f, _ in strengths}:
            raise UsageError(f"region {found.name}: is to be kept, and to be pinned or restyled in part; leave out one of both")
    strength, score = torch.ones(len(allowed)), region_scores(regions.scene, dictionary)
    for found, value in strengths:
        strength[found.number] = value
    strength[[found.number for found in kept]] = 0.0
    if style.keep_below is not None:
        best = score.masked_fill(~allowed[:, dictionary.reference], -torch.inf).amax(1)
        poor = (best < style.keep_below).nonzero().flatten().tolist()
        strength[[k for k in poor if k not in pinned]] = 0.0
    saved = replace(
        style,
        pin=tuple(f"{book.name(f)}={book.label(i)}" for f, i in pins),
        forbid=tuple(f"{book.name(f)}={book.label(i)}" for f, i in bans),
        keep=tuple(book.name(f) for f in kept),
        region_strength=tuple(f"{book.name(f)}={value:g}" for f, value in strengths),
    )
    file = StyleFile(saved, book.keys, regions.views.semantic_encoder)
    return Orders(allowed, strength, score, file, regions, tuple(dict.fromkeys(book.notes)))


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

    def find(self, text: str) -> list[Found]:
        found = find_regions(self.regions, text)
        if not found:
            self.notes.append(f"region {text!r} of the style: no region here is most like it, so it is left out")
        for each in found:
            if each.name in self.regions.keys:
                self.notes.append(f"region {text!r} of the style is region {each.number} here (cosine {each.alike:.2f})")
        return found

    def pairs(self, field: str, texts: Sequence[str]) -> list[tuple[Found, int]]:
        """Regions and references of REGION=REFERENCE; a mask may mean several regions."""
        wishes = [parse_region_value(field, text) for text in texts]
        return [(found, find_reference(w.value, self.references)) for w in wishes for found in self.find(w.region)]

    def label(self, reference: int) -> str:
        """A reference as a style file names it, wherever its photographs are moved to."""
        name = self.references[reference].name
        return name if self.names[reference] == name else str(reference)

    def name(self, found: Found) -> str:
        """What the region is called in a style file, which holds its key under that name."""
        if found.name in self.regions.keys or not self.keys:
            return found.name
        key, name = key_of(self.regions, found.number), f"region{found.number}"
        known = [other for other, its in self.keys.items() if its == key]
        if known:
            return known[0]
        while name in self.keys:
            name += "'"
        self.keys[name] = key
        return name
