"""References to a style on a scene: the feed-forward step, a second or less a photograph."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ..datamanagers.basis import Basis
from ..errors import ConfigError, UsageError, WeightsError
from ..interfaces import Encoder
from ..plugins.stylizers.config import StylizerConfig
from ..style.colours import colour_maps
from ..style.config import NO_MASK, StyleConfig
from ..style.dictionary import BLEND, CLUSTERS, Reference, StyleDictionary, build_dictionary
from ..style.files import StyleFile, check_photographs, read_style
from ..style.look import Restyle
from ..style.matching import unit
from ..style.references import read_reference
from ..style.regional import RegionWeight, regional
from ..style.scene import SceneStyle
from ..style.wishes import labels
from .first_use import check_stylizer
from .loading import Trained, load_style
from .orders import Orders, take_orders
from .regions import Regions, TrainedViews

__all__ = [
    "Codes",
    "Encoders",
    "Styled",
    "apply_style",
    "dress",
    "encode_photograph",
    "encoders_of",
    "mixed",
    "open_encoders",
    "restyle",
]

_SHORTEST = 128
"""References are encoded at the scene's size, but not below this: clusters would have too few pixels."""


class Encoders(NamedTuple):
    """What brings references into a scene's terms: loaded once for any number of styles."""

    content: Encoder
    semantic: Encoder | None
    basis: Basis | None
    scene: SceneStyle
    device: torch.device = torch.device("cpu")
    """Device of the encoders."""


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
def open_encoders(trained: Trained) -> Encoders:
    """The encoders that a scene was trained with. Raises WeightsError where those at hand are others."""
    return encoders_of(trained, *load_style(trained.run))


@torch.inference_mode()
def encoders_of(trained: Trained, scene: SceneStyle, basis: Basis | None) -> Encoders:
    """The same for a style and a basis that are at hand."""
    config, facts = trained.config, trained.known.facts
    content = config.content.encoder.build()
    semantic = config.semantic.encoder.build() if config.semantic.encoder is not None and basis is not None else None
    for name, encoder, known in (("content", content, facts.content_encoder), ("semantic", semantic, facts.semantic_encoder)):
        if encoder is not None and encoder.identity != known:
            raise WeightsError(
                f"{name} encoder: the scene was trained with {known}, this is {encoder.identity}; "
                "use the same weights, or train the scene again"
            )
    device = trained.model.device
    return Encoders(content.to(device), None if semantic is None else semantic.to(device), basis, scene, device)


@torch.inference_mode()
def apply_style(trained: Trained, file: StyleFile, encoders: Encoders | None = None, trail: tuple[Path, ...] = ()) -> Styled:
    """Build the dictionary of a style's references and its stylizer on the scene; mix in the style that it goes towards.

    `trail` are the style files that led here. Raises UsageError for no references and wishes that the scene does not know,
    DataError for unreadable photographs, WeightsError where the encoders are not the scene's.
    """
    style = file.style
    if not style.references:
        raise UsageError("--references: at least one photograph is needed, for example --references autumn.jpg night.jpg")
    encoders = open_encoders(trained) if encoders is None else encoders
    styled = dress(trained, file, encoders, _dictionary(trained, style, encoders))
    if style.between is None or style.at == 0:
        return styled
    path = style.between.resolve()
    if path in trail:
        raise ConfigError(f"{style.between}: lies between styles that lead back to it; end the circle")
    other = read_style(style.between)
    check_photographs(style.between, other)
    return mixed(styled, apply_style(trained, other, encoders, (*trail, path)), style.at)


@torch.inference_mode()
def dress(trained: Trained, file: StyleFile, encoders: Encoders, dictionary: StyleDictionary) -> Styled:
    """A style whose dictionary is built already, on the scene. `between` is not heeded.

    The dictionary's names are the labels of the style's references. Raises UsageError for wishes that the scene does not know.
    """
    style, scene, basis = file.style, encoders.scene, encoders.basis
    if basis is not None:
        dictionary = dictionary._replace(origin=basis.origin().to(dictionary.keys))
    regions = Regions(TrainedViews(trained), scene, basis, file.regions, file.semantic_encoder)
    orders = take_orders(regions, dictionary, style)
    chosen = style.stylizer
    stylizer = regional(dictionary, scene, orders.allowed, chosen)
    partly = bool((orders.strength != 1).any())
    check_stylizer(chosen, stylizer, dictionary, scene)
    device = trained.model.device
    stylizer = stylizer.to(device)
    colours = colour_maps(
        stylizer,
        dictionary,
        scene,
        trained.model.decoder,
        features=chosen.features,
        share=chosen.colours,
        smoothing=chosen.smoothing(scene, orders.allowed),
    )
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
    trained: Trained,
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
    return apply_style(trained, StyleFile(style))


@torch.inference_mode()
def encode_photograph(
    trained: Trained, path: Path, encoders: Encoders, *, name: str, weight: float = 1.0, mask: Path | None = None
) -> Reference:
    """One photograph as samples in the scene's terms, at the size of the scene's own views."""
    return read_reference(
        path,
        content=encoders.content,
        semantic=encoders.semantic,
        basis=encoders.basis,
        longest=max(int(trained.known.cameras.size.amax()), _SHORTEST),
        weight=weight,
        guided=trained.config.datamanager.guided,
        mask=mask,
        name=name,
        device=encoders.device,
    )


def _dictionary(trained: Trained, style: StyleConfig, encoders: Encoders) -> StyleDictionary:
    references = [
        encode_photograph(
            trained,
            path,
            encoders,
            name=name,
            weight=style.weights[i] if style.weights else 1.0,
            mask=style.masks[i] if style.masks and style.masks[i] != NO_MASK else None,
        )
        for i, (path, name) in enumerate(zip(style.references, labels(style.references), strict=True))
    ]
    return build_dictionary(references, clusters=style.clusters, blend=style.blend, seed=trained.config.seed)


def mixed(a: Styled, b: Styled, at: float) -> Styled:
    """Style `a` on the way to `b`, which lies at 1.

    The dictionary and the orders stay those of `a`; codes and notes are those of both.
    """
    reference = torch.cat([a.codes.reference, b.codes.reference + len(a.codes.names)])
    codes = Codes(reference, a.codes.names + b.codes.names, torch.cat([a.codes.units, b.codes.units]))
    orders = a.orders._replace(notes=a.orders.notes + b.orders.notes)
    return a._replace(restyle=a.restyle.mixed(b.restyle, at), codes=codes, orders=orders)
