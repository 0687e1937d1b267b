"""References to a style on a scene: the feed-forward step, a second or less a photograph."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ..errors import ConfigError, UsageError
from ..interfaces import Scene
from ..plugins.stylizers.config import StylizerConfig
from ..style.config import NO_MASK, StyleConfig, labels
from ..style.dictionary import BLEND, CLUSTERS, StyleDictionary, build_dictionary
from ..style.files import StyleFile, check_photographs, read_style
from ..style.look import Restyle
from ..style.matching import unit
from ..style.references import Encoders, encode_photograph
from ..style.regional import RegionWeight, regional
from ..style.scene import SceneStyle
from .first_use import check_stylizer
from .orders import Orders, take_orders
from .regions import Regions

__all__ = [
    "Codes",
    "Styled",
    "apply_style",
    "dress",
    "mixed",
    "restyle",
]


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
    orders: Orders


@torch.inference_mode()
def apply_style(here: Scene, file: StyleFile, encoders: Encoders | None = None, trail: tuple[Path, ...] = ()) -> Styled:
    """Build the dictionary of a style's references and its stylizer on the scene; mix in the style that it goes towards.

    `trail` are the style files that led here. Raises UsageError for no references and wishes that the scene does not know,
    DataError for unreadable photographs, WeightsError where the encoders are not the scene's.
    """
    style = file.style
    if not style.references:
        raise UsageError("--references: at least one photograph is needed, for example --references autumn.jpg night.jpg")
    encoders = here.encoders() if encoders is None else encoders
    styled = dress(here, file, encoders, _dictionary(style, encoders))
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
    orders = take_orders(regions, dictionary, style)
    chosen = style.stylizer
    stylizer = regional(dictionary, scene, orders.allowed, chosen)
    partly = bool((orders.strength != 1).any())
    check_stylizer(chosen, stylizer, dictionary, scene)
    device = here.device
    stylizer = stylizer.to(device)
    colours = here.colour_maps(stylizer, dictionary, scene, chosen, orders.allowed)
    mine = Restyle(
        stylizer,
        style.strength,
        RegionWeight(scene, orders.strength[:, None]).to(device) if partly else None,
        chosen.features,
        None if colours is None else colours.to(device),
        style.luminance,
    )
    codes = Codes(dictionary.reference, dictionary.names, unit(dictionary.keys, scene.semantic_mean))
    return Styled(mine, dictionary, scene, codes, orders)


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


def _dictionary(style: StyleConfig, encoders: Encoders) -> StyleDictionary:
    references = [
        encode_photograph(
            path,
            encoders,
            name=name,
            weight=style.weights[i] if style.weights else 1.0,
            mask=style.masks[i] if style.masks and style.masks[i] != NO_MASK else None,
        )
        for i, (path, name) in enumerate(zip(style.references, labels(style.references), strict=True))
    ]
    return build_dictionary(references, clusters=style.clusters, blend=style.blend, seed=encoders.seed)


def mixed(a: Styled, b: Styled, at: float) -> Styled:
    """Style `a` on the way to `b`, which lies at 1.

    The dictionary and the orders stay those of `a`; codes and notes are those of both.
    """
    reference = torch.cat([a.codes.reference, b.codes.reference + len(a.codes.names)])
    codes = Codes(reference, a.codes.names + b.codes.names, torch.cat([a.codes.units, b.codes.units]))
    orders = a.orders._replace(notes=a.orders.notes + b.orders.notes)
    return a._replace(restyle=a.restyle.mixed(b.restyle, at), codes=codes, orders=orders)
