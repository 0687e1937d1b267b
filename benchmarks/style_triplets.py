"""The stylizers on photographs: triplets whose corresponding parts are painted, each photograph taken as a scene."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from fprf.datamanagers.config import GuidedConfig
from fprf.datamanagers.images import load_image
from fprf.evaluation.contest import PLAIN, STYLIZERS, Exhibit, Row, colour_baselines, judge_exhibit
from fprf.evaluation.flat import cells_basis, encoded, flat_look, flat_reference, flat_scene, painted, render_flat
from fprf.evaluation.triplets import COLOURS, Triplet, read_triplets, triplet_names
from fprf.interfaces import Decoder, Encoder
from fprf.io.images import shrink
from fprf.plugins.decoders.config import MlpDecoderConfig
from fprf.plugins.encoders.config import EncoderConfig
from fprf.plugins.stylizers.config import IdentityConfig
from fprf.style.dictionary import build_dictionary

DIM, REGIONS, CLUSTERS = 32, 16, 20
"""Of `fprf-lite`: semantic components, regions of a scene, codes of a reference."""
SOURCES = ("painted", "encoder")


@dataclass(frozen=True)
class Tools:
    content: Encoder
    semantic: Encoder
    decoder: Decoder

    @classmethod
    def of(cls, content: EncoderConfig, semantic: EncoderConfig) -> "Tools":
        encoder = content.build()
        decoder = MlpDecoderConfig().build(encoder=encoder.identity, channels=encoder.channels)
        return cls(encoder, semantic.build(), decoder)


def photograph(path: Path, longest: int) -> Tensor:
    return torch.from_numpy(shrink(load_image(path), longest)).float() / 255


def restyled(triplet: Triplet, tools: Tools, source: str) -> dict[str, Tensor]:
    """The content photograph by every stylizer, its parts told apart by the painted regions or by the encoder."""
    guided, size = GuidedConfig(), (triplet.content.shape[0], triplet.content.shape[1])
    here, there = (encoded(image, tools.content, guided) for image in (triplet.content, triplet.style))
    if source == "painted":
        kinds = len(COLOURS)
        where = painted(triplet.content_regions, kinds, size)
        where_there = painted(triplet.style_regions, kinds, (triplet.style.shape[0], triplet.style.shape[1]))
    else:
        basis = cells_basis(triplet.content, tools.semantic, DIM)
        where, where_there = (encoded(image, tools.semantic, guided, basis) for image in (triplet.content, triplet.style))
    flat = flat_scene(here, where, size, regions=len(COLOURS) if source == "painted" else REGIONS)
    dictionary = build_dictionary(
        [flat_reference("style", there, where_there, triplet.style.reshape(-1, 3))],
        clusters=len(COLOURS) if source == "painted" else CLUSTERS,
    )
    configs = {"decoded": IdentityConfig(), **STYLIZERS} if source == SOURCES[0] else STYLIZERS
    return {
        name: render_flat(flat, flat_look(flat, dictionary, config, tools.decoder), tools.decoder)
        for name, config in configs.items()
    }


def peer(folder: Path, triplet: Triplet) -> dict[str, Tensor]:
    """What the paper of the triplets made of it, where that lies beside them."""
    path = folder / "dpst_result" / f"{triplet.name}.jpg"
    if not path.is_file():
        return {}
    image = torch.from_numpy(load_image(path)).float().permute(2, 0, 1)[None] / 255
    size = (triplet.content.shape[0], triplet.content.shape[1])
    return {"luan et al.": F.interpolate(image, size, mode="area")[0].permute(1, 2, 0)}


def contests(
    folder: Path,
    tools: Tools,
    judges: dict[str, Encoder],
    *,
    count: int,
    longest: int,
    full: bool,
    seen: Callable[[str, dict[str, Tensor]], None],
) -> dict[str, dict[str, dict[str, Row]]]:
    """Rows by source of the regions, triplet and method. `seen` is shown all pictures of a triplet."""
    found: dict[str, dict[str, dict[str, Row]]] = {source: {} for source in SOURCES}
    for name in _spread(triplet_names(folder), count):
        (triplet,) = read_triplets(folder, names=[name], size=None)
        triplet = triplet._replace(
            content=photograph(folder / "content" / f"{name}.jpg", longest),
            style=photograph(folder / "style" / f"{name}.jpg", longest),
        )
        common = {PLAIN: triplet.content}
        common |= {k: v[0] for k, v in colour_baselines([triplet.content], [triplet.style]).items()}
        common |= peer(folder, triplet)
        made = {source: restyled(triplet, tools, source) for source in SOURCES}
        every = {**common, **{f"{source}/{k}": image for source in SOURCES for k, image in made[source].items()}}
        exhibit = Exhibit(
            plain=[triplet.content],
            styled={k: [image] for k, image in every.items()},
            regions=[triplet.content_regions],
            references=[triplet.style],
            reference_regions=[triplet.style_regions],
        )
        rows = judge_exhibit(exhibit, judges, full=full)
        for source in SOURCES:
            found[source][name] = {k: rows[k] for k in common} | {k: rows[f"{source}/{k}"] for k in made[source]}
        seen(name, {"style": triplet.style, **every})
    return found


def _spread(names: Sequence[str], count: int) -> list[str]:
    """So many of the names, evenly spread."""
    kept = min(count, len(names))
    return [names[i * len(names) // kept] for i in range(kept)]
