"""Photographs and looks on one scene. Not for several threads: all of it happens on the desk.

A photograph is encoded when it comes, clustered once for each number of clusters, and never again: a slider costs the
stylizer alone.
"""

from collections import OrderedDict
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, TypeAlias, TypeVar

import torch
from torch import Tensor

from ..datamanagers.images import load_image
from ..errors import UsageError
from ..io.images import shrink
from ..rendering.cameras import Cameras
from ..style.dictionary import StyleDictionary, build_dictionary
from ..style.files import StyleFile
from ..style.look import Restyle
from ..style.references import Encoders, encode_photograph
from ..style.regional import RegionWeight
from ..style.scene import SceneStyle
from ..style.wishes import labels
from ..training.loading import Trained
from ..training.restyle import Styled, dress, mixed
from ..training.views import paint_pixels
from .looks import Card, Look, settled, style_of

__all__ = ["Opener", "Picked", "Studio", "joined", "names_of"]

Opener: TypeAlias = Callable[[Trained, Encoders | None], Encoders]
"""Opens the encoders of a scene with its style; those that were opened before may be kept."""
Key = TypeVar("Key")
Value = TypeVar("Value")

_THUMBNAIL = 128
_KEPT = 24
"""Dictionaries and styles that are kept for when somebody returns to them."""
_SOLID = 0.01


class Picked(NamedTuple):
    """A region that somebody pointed at."""

    region: int
    share: float
    """Of the scene."""
    taken: tuple[tuple[str, float], ...]
    """What it takes from each photograph, the most first; none where there is no style."""


class Studio:
    """Encoders are opened when they are first needed, which takes a fraction of a second."""

    def __init__(self, trained: Trained, opened: Opener | None = None) -> None:
        self.trained = trained
        self._opened: Opener = opened or (lambda trained, before: trained.encoders())
        self._encoders: Encoders | None = None
        self._stale = False
        self._cards = 0
        self._dictionaries: OrderedDict[tuple[Card, int, float], StyleDictionary] = OrderedDict()
        self._styles: OrderedDict[Look, Styled] = OrderedDict()

    @property
    def encoders(self) -> Encoders:
        """Those of the scene. Raises WeightsError where those at hand are others."""
        if self._encoders is None or self._stale:
            self._encoders = self._opened(self.trained, self._encoders)
            self._stale = False
        return self._encoders

    def renew(self, trained: Trained, opened: Opener | None = None) -> SceneStyle | None:
        """The scene has changed, and with it its style: the one from before, if there was one."""
        self.trained, self._opened = trained, opened or self._opened
        self._stale = True
        self._styles.clear()
        return None if self._encoders is None else self._encoders.scene

    @property
    def regions(self) -> int:
        """How many the scene has."""
        return len(self.encoders.scene.share)

    def card(self, path: Path, name: str) -> Card:
        """Encode a photograph. Raises DataError for an unreadable one."""
        reference = encode_photograph(path, self.encoders, name=name)
        self._cards += 1
        return Card(self._cards, name, path, shrink(load_image(path, upright=True), _THUMBNAIL), reference)

    def styled(self, look: Look) -> Styled | None:
        """The look on the scene; None for the scene as it is. Raises UsageError for wishes that contradict each other."""
        look = settled(look)
        here = self._alone(look)
        if here is None or look.towards is None:
            return here
        there = self._alone(look.towards)
        assert there is not None  # else it would have settled
        return mixed(here, there, look.at)

    def keep(self, cards: Collection[Card]) -> None:
        """Nobody will ask for any other photograph again."""
        self._dictionaries = OrderedDict((key, value) for key, value in self._dictionaries.items() if key[0] in cards)
        self._styles = OrderedDict((look, value) for look, value in self._styles.items() if {*dict(look.mix)} <= {*cards})

    def restyle(self, look: Look) -> Restyle | None:
        """What a renderer needs of the look."""
        styled = self.styled(look)
        return None if styled is None else styled.restyle

    def region_at(self, cameras: Cameras, pixel: tuple[float, float]) -> int | None:
        """The region at a pixel of the first camera; None where there is nothing. Raises UsageError outside of the view."""
        width, height = cameras.size[0].tolist()
        if not (0 <= pixel[0] < width and 0 <= pixel[1] < height):
            raise UsageError(f"pixel {pixel[0]:.0f},{pixel[1]:.0f}: outside of the view of {width}x{height}")
        weight = RegionWeight(self.encoders.scene, torch.eye(self.regions)).to(self.trained.model.device)
        place = torch.tensor([pixel], dtype=torch.float64)
        config = self.trained.config.render
        share, opacity = paint_pixels(self.trained.model, cameras, 0, place, config, weight, semantic=weight.divided)
        return int(share[0].argmax()) if float(opacity[0]) >= _SOLID else None

    def picked(self, look: Look, region: int) -> Picked:
        """What there is to say of a region in a look."""
        scene, styled = self.encoders.scene, self.styled(look)
        taken: list[tuple[str, float]] = []
        if styled is not None:
            device = self.trained.model.device
            attention = styled.restyle.match(scene.keys[region : region + 1].to(device))[0].cpu()
            shares = torch.zeros(len(styled.codes.names)).index_add_(0, styled.codes.reference, attention.float())
            taken = sorted(zip(names_of(look), shares.tolist(), strict=True), key=lambda row: -row[1])
        return Picked(region, float(scene.share[region]), tuple(taken))

    def _alone(self, look: Look) -> Styled | None:
        """Without what it goes towards."""
        look = replace(look, towards=None, at=0.0)
        if look.plain:
            return None
        if look not in self._styles:
            parts = [self._dictionary(card, look.clusters, look.blend) for card, _ in look.mix]
            style = style_of(look)
            names = labels(style.references)
            dictionary = joined(parts, names, [weight for _, weight in look.mix])
            self._styles[look] = dress(self.trained, StyleFile(style), self.encoders, dictionary)
        return _recent(self._styles, look)

    def _dictionary(self, card: Card, clusters: int, blend: float) -> StyleDictionary:
        key = (card, clusters, blend)
        if key not in self._dictionaries:
            seed = self.trained.config.seed
            self._dictionaries[key] = build_dictionary([card.reference], clusters=clusters, blend=blend, seed=seed)
        return _recent(self._dictionaries, key)


def names_of(look: Look) -> tuple[str, ...]:
    """What the photographs of a look are called on the page, in the order of its style codes."""
    look = settled(look)
    mix = look.mix if look.towards is None else (*look.mix, *look.towards.mix)
    return tuple(card.name for card, _ in mix)


def joined(parts: Sequence[StyleDictionary], names: Sequence[str], weights: Sequence[float]) -> StyleDictionary:
    """Dictionaries of one reference each as one, under new names and weights: what `build_dictionary` makes of all of them
    at once, but for the order.
    """
    counts = torch.tensor([len(part.keys) for part in parts])
    coloured = all(part.colour_mean is not None for part in parts)

    def together(name: str) -> Tensor:
        return torch.cat([getattr(part, name) for part in parts])

    return StyleDictionary(
        keys=together("keys"),
        mean=together("mean"),
        covariance=together("covariance"),
        share=together("share"),
        reference=torch.arange(len(parts)).repeat_interleave(counts),
        weight=torch.tensor(weights, dtype=torch.float32).repeat_interleave(counts),
        names=tuple(names),
        blend=parts[0].blend,
        colour_mean=together("colour_mean") if coloured else None,
        colour_covariance=together("colour_covariance") if coloured else None,
    )


def _recent(kept: OrderedDict[Key, Value], key: Key) -> Value:
    """What is kept under a key, which becomes the last to be dropped."""
    kept.move_to_end(key)
    while len(kept) > _KEPT:
        kept.popitem(last=False)
    return kept[key]
