"""Every method on the same cached views: what each shows, which codes its pixels take, and how long it took."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, NamedTuple, TypeVar

import torch
from torch import Tensor

from ..evaluation.colour_transfer import histogram_matching, reinhard
from ..evaluation.contest import STYLIZERS
from ..evaluation.flat import encoded, flat_look, flat_scene, render_flat
from ..plugins import registry
from ..plugins.stylizers.config import LocalAdainConfig, StylizerConfig
from ..style.config import StyleConfig
from ..style.dictionary import StyleDictionary, build_dictionary
from ..style.files import StyleFile
from ..style.look import Restyle
from ..style.references import Encoders, encode_photograph
from ..style.wishes import labels
from ..training.cached_view import CachedView
from ..training.loading import Trained
from ..training.restyle import dress
from ..types import Want

__all__ = ["FLAT", "GLOBAL", "PLAIN", "Shown", "dictionary_of", "in_scene", "lineup", "nothing", "one_by_one", "transfers"]

PLAIN = "no change"
FLAT = "2d"
"""The recommended stylizer on every picture alone, as if there were no scene."""
GLOBAL = ("reinhard", "histogram", "adain")
"""What the recommended stylizer shall beat: colours of each picture alone, and features without regions."""
_SHARP = 0.01
"""Relative temperature at which a point takes one code alone."""

Picture = Annotated[Tensor, "H W 3"]
T = TypeVar("T")


class Shown(NamedTuple):
    """One method on the views and frames, given in one list."""

    pictures: list[Picture]
    taken: list[Annotated[Tensor, "N T"]] | None
    """Share of each style code in each pixel; None where nothing is matched."""
    style_seconds: float
    """To make the style of the references, encoders included."""
    view_seconds: float
    """To colour one view whose geometry is there already."""


def lineup(recommended: StylizerConfig) -> dict[str, StylizerConfig]:
    """Stylizers by name, the recommended one last; it takes the place of its like."""
    name = registry.name_of(StylizerConfig.group, type(recommended))
    others = {other: config for other, config in STYLIZERS.items() if other != name}
    return {**others, "nearest-code": LocalAdainConfig(temperature=_SHARP), name: recommended}


def dictionary_of(
    trained: Trained, paths: Sequence[Path], encoders: Encoders, *, clusters: int, blend: float
) -> tuple[StyleDictionary, float]:
    """The style dictionary of photographs on a scene, and the seconds it took."""
    start = time.perf_counter()
    found = [encode_photograph(path, encoders, name=name) for path, name in zip(paths, labels(tuple(paths)), strict=True)]
    made = build_dictionary(found, clusters=clusters, blend=blend, seed=trained.config.seed)
    return made, time.perf_counter() - start


def nothing(views: Sequence[CachedView]) -> Shown:
    """The scene as it is."""
    pictures, seconds = _each(views, lambda view: view.restyled().rgb)
    return Shown(pictures, None, 0.0, seconds)


def transfers(plain: Sequence[Picture], references: Sequence[Picture]) -> dict[str, Shown]:
    """Transfers of colour of every picture alone, towards all pixels of all references."""
    style = torch.cat([image.reshape(-1, 3) for image in references])
    found = {}
    for name, transfer in {"reinhard": reinhard, "histogram": histogram_matching}.items():

        def moved(view: Picture, transfer: Callable[[Tensor, Tensor], Tensor] = transfer) -> Picture:
            return transfer(view.reshape(-1, 3), style).reshape(view.shape)

        pictures, seconds = _each(plain, moved)
        found[name] = Shown(pictures, None, 0.0, seconds)
    return found


def in_scene(
    trained: Trained,
    views: Sequence[CachedView],
    config: StylizerConfig,
    dictionary: StyleDictionary,
    encoders: Encoders,
    paths: Sequence[Path],
) -> Shown:
    """A stylizer of the scene."""
    start = time.perf_counter()
    look = dress(trained, StyleFile(StyleConfig(references=tuple(paths), stylizer=config)), encoders, dictionary).restyle
    spent = time.perf_counter() - start
    pictures, seconds = _each(views, lambda view: view.restyled(look).rgb)
    matched = Want.SEMANTIC in look.stylizer.needs
    return Shown(pictures, [_taken(view, look) for view in views] if matched else None, spent, seconds)


def one_by_one(
    trained: Trained, plain: Sequence[Picture], config: StylizerConfig, dictionary: StyleDictionary, encoders: Encoders
) -> Shown:
    """The stylizer on each picture as a photograph of its own: its own statistics and regions, the same dictionary."""
    guided, decoder = trained.config.datamanager.guided, trained.model.decoder
    regions, seed = trained.config.statistics.regions, trained.config.seed
    taken = []

    def restyled(view: Picture) -> Picture:
        view, semantic = view.to(encoders.device), None
        if encoders.semantic is not None:
            semantic = encoded(view, encoders.semantic, guided, encoders.basis)
        size = (view.shape[0], view.shape[1])
        flat = flat_scene(encoded(view, encoders.content, guided), semantic, size, regions=regions, seed=seed)
        look = flat_look(flat, dictionary, config, decoder)
        if semantic is not None:
            taken.append(look.match(semantic).cpu())
        return render_flat(flat, look, decoder).cpu()

    with torch.inference_mode():
        pictures, seconds = _each(plain, restyled)
    return Shown(pictures, taken or None, 0.0, seconds)


@torch.inference_mode()
def _taken(view: CachedView, look: Restyle) -> Annotated[Tensor, "N T"]:
    """Composited shares of the codes."""
    return torch.cat([part.mean(look.match(_semantic(part.semantic, part.content))) for part in view.parts])


def _semantic(semantic: Tensor | None, content: Tensor) -> Tensor:
    return content[:, :0] if semantic is None else semantic


def _each(views: Sequence[T], function: Callable[[T], Picture]) -> tuple[list[Picture], float]:
    """The pictures and the mean seconds of one."""
    start = time.perf_counter()
    pictures = [function(view) for view in views]
    return pictures, (time.perf_counter() - start) / max(1, len(views))
