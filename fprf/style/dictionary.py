"""The style dictionary (paper, section on semantic matching): reference photographs to pixel samples, samples
to style codes.

Letters: N pixel samples of a photograph, C content channels, D semantic channels in the scene's basis, T
style codes of all references, K regions of the scene. Colours are sRGB in [0, 1].

Content and semantics of a photograph pass the same guided filter as the scene's training targets, at its own
pixels, so that a reference's statistics are in kind with the scene's. What moves them is the size that the
encoder sees (VGG relu2_1: the deviations change by 4 to 12 % from 512 to 384 pixels a side), so photographs
are encoded at the scene's own. What doesn't is how many pixels are looked at: every third and coarser filter
cells change them by 0.6 % at most, and cost a fifth.
"""

import hashlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import cv2
import numpy as np
import torch
from safetensors.torch import save
from torch import Tensor

from ..checks import at_least, between
from ..datamanagers.images import Cutout, Image, covered_mean, filled, load_cutout, load_mask
from ..errors import DataError
from ..interfaces import Encoder
from ..io.atomic import write_bytes
from ..ops.backend import double, float32_convolutions
from ..ops.config import GuidedConfig
from ..ops.guided import apply, coefficients
from .placing import Keypoints, Landmarks, Pairs, close_keypoints, close_size, find_place, weighed
from .statistics import covariance, group_moments, kmeans, mix, moments

if TYPE_CHECKING:
    from ..datamanagers.basis import Basis
    from .scene_style import SceneStyle

BLEND = 0.1
"""Share of the whole image's (or scene's) statistics in each local code. The paper has none, its released
code 0.3, which ends further from the truth where that is known (docs/evidence).
"""

CLUSTERS = 20
"""Local codes a reference: with ten, as the paper suggests, trees and houses share some (docs/evidence)."""

_MIN_SURE_MEMBERS = 32
"""Pixels of a code below which its own statistics say little."""
_SAMPLED_PIXELS = 20_000
"""Pixels of a photograph that are looked at, about, on a regular grid."""
_MIN_LONG_SIDE_PIXELS = 128
"""References are encoded at the scene's size, but not below this: clusters would have too few pixels."""
_MIN_SIDE_PIXELS = 64
"""No side is encoded smaller: deep encoders have nothing to pad with on a photograph of a few pixels."""
_FILTER_CELL_PIXELS = 16
"""Pixels between guided-filter coefficients."""
_FILTERED_ROWS = 4096
"""Pixels filtered at a time: bounds the memory."""

_CODE_TABLES = ("keys", "mean", "covariance", "share", "weight")
"""Fields of a dictionary with a row a code."""
_COLOUR_TABLES = ("colour_mean", "colour_covariance")
_OPTIONAL_TABLES = (*_COLOUR_TABLES, "beyond")
"""Fields with a row a code that may be None."""


class Encoders(NamedTuple):
    """Encoders and basis for references of a scene: loaded once for any number of styles."""

    content: Encoder
    semantic: Encoder | None
    basis: "Basis | None"
    scene_style: "SceneStyle"
    device: torch.device = torch.device("cpu")
    """Device of the encoders."""
    longest: int = 512
    """Longest side in pixels at which photographs are encoded: that of the scene's own views."""
    guided: GuidedConfig = GuidedConfig()
    """The filter that features of the scene's own images passed."""
    seed: int = 0
    """Of the clusters of a style dictionary."""
    landmarks: Landmarks | None = None
    """Views of the scene that tell photographs of the very place; None = nobody looks."""


class Reference(NamedTuple):
    """One reference photograph as pixel samples."""

    name: str
    content: Annotated[Tensor, "N C"]
    semantic: Annotated[Tensor, "N D"]
    """In the scene's semantic basis; D = 0 where the scene has no semantics."""
    weight: float = 1.0
    """Weight beside the others; above 0."""
    colour: Annotated[Tensor, "N 3"] | None = None
    """The samples' own colours, sRGB in [0, 1]; None where nobody will ask."""
    beyond: Annotated[Tensor, "N"] | None = None
    """Squared length that semantics lose by projection on the scene's basis (`Basis.beyond`): large for what
    the scene does not show. None = 0.
    """
    placed: Pairs | None = None
    """Colours of the scene and of the photograph at the very place; None where it shows another."""


@torch.inference_mode()
def encode_photograph(path: Path, encoders: Encoders, *, name: str, mask: Path | None = None) -> Reference:
    """Encode one photograph to samples in the scene's terms: D is 0 without a semantic encoder or basis.

    Of a photograph with a `mask`, a picture of the same shape, only what is white there is sampled; the
    encoders see all of it. What is transparent is neither sampled nor seen. Raises DataError where a file is
    no readable image, shows nothing, or a mask does not fit.
    """
    cutout = load_cutout(path)
    size = _encoded_size(cutout.pixels, encoders.longest)
    reduced, chosen = _reduced(cutout, size)
    if mask is not None:
        chosen = _within_mask(_read_mask(mask, path, cutout.pixels, size), chosen, mask, path)
    image = torch.from_numpy(reduced).to(encoders.device).float() / 255
    pixel = (_grid_pixels(size) if chosen is None else _every_nth_pixel(chosen)).to(image.device)
    content = _filtered(_encode(encoders.content, image), image, encoders.guided)(pixel)
    colour = image[pixel[:, 1], pixel[:, 0]]
    if encoders.semantic is None or encoders.basis is None:
        return Reference(name, content, content.new_zeros(len(content), 0), colour=colour)
    semantics = semantics_of(image, encoders.semantic, encoders.basis, encoders.guided)
    semantic, beyond = semantics(pixel)
    placed = None
    if encoders.landmarks is not None:
        placed = find_place(encoders.landmarks, image, chosen, lambda: _close_keypoints(cutout, size, chosen))
    if placed is not None:
        there, _ = semantics(placed.pixel.to(pixel))
        placed = weighed(placed, there, encoders.scene_style.semantic_mean.to(placed.semantic))
    return Reference(name, content, semantic, colour=colour, beyond=beyond, placed=placed)


def _encoded_size(photo: Image, longest: int) -> tuple[int, int]:
    """Width and height at which a photograph is encoded: reduced to the size of the scene's views where the
    shape allows, and enlarged only where an encoder could not take it.
    """
    height, width = photo.shape[:2]
    scale = min(1.0, max(longest, _MIN_LONG_SIDE_PIXELS) / max(height, width))
    return max(_MIN_SIDE_PIXELS, round(width * scale)), max(_MIN_SIDE_PIXELS, round(height * scale))


def _reduced(cutout: Cutout, size: tuple[int, int]) -> tuple[Image, Annotated[Tensor, "H W"] | None]:
    """A photograph at a size (width, height), and which of its pixels count (bool; None = all).

    What is transparent takes the colour of the nearest pixel that is not: of ten photographs, cut out to an
    island of 28 %, content features are then 0.16 of their deviation off those of the whole photograph, 0.25
    with colours that fade from the border outwards, 0.52 with white; semantics 0.88, 0.84 and 1.35.
    """
    if cutout.opaque is None:
        reduced = cv2.resize(cutout.pixels, size, interpolation=cv2.INTER_AREA)
        return np.asarray(reduced, dtype=np.uint8), None
    mean, cover = covered_mean(cutout.pixels, cutout.opaque.astype(np.float32), size)
    return filled(mean, cover > 0), _mostly_covered(torch.from_numpy(cover))


def _mostly_covered(cover: Annotated[Tensor, "H W"]) -> Annotated[Tensor, "H W"]:
    """Cells that are at least half covered, else all that are covered at all."""
    half = cover >= 0.5
    return half if bool(half.any()) else cover > 0


def _close_keypoints(
    cutout: Cutout, size: tuple[int, int], chosen: Annotated[Tensor, "H W"] | None
) -> Keypoints:
    """Keypoints of a photograph that is larger than a size (width, height), in pixels of that size; `chosen` as of
    `_reduced`.
    """
    larger = close_size(size)
    enlarged = larger[0] > cutout.pixels.shape[1]
    pixels = cv2.resize(cutout.pixels, larger, interpolation=cv2.INTER_CUBIC if enlarged else cv2.INTER_AREA)
    where = None
    if chosen is not None:
        mask = chosen.cpu().numpy().astype(np.uint8)
        where = torch.from_numpy(cv2.resize(mask, larger, interpolation=cv2.INTER_NEAREST)) > 0
    return close_keypoints(torch.from_numpy(pixels).float() / 255, size, where)


def _grid_pixels(size: tuple[int, int]) -> Annotated[Tensor, "N 2"]:
    """Pixels (x, y, int64) of a regular grid over a picture of a size (width, height)."""
    width, height = size
    step = max(1, round((height * width / _SAMPLED_PIXELS) ** 0.5))
    rows = torch.arange(step // 2, height, step)
    columns = torch.arange(step // 2, width, step)
    y, x = torch.meshgrid(rows, columns, indexing="ij")
    return torch.stack([x.flatten(), y.flatten()], 1)


def _every_nth_pixel(chosen: Annotated[Tensor, "H W"]) -> Annotated[Tensor, "N 2"]:
    """Every n-th of the chosen pixels (x, y, int64), so that a small part is looked at closely."""
    pixel = chosen.nonzero().flip(1)
    step = max(1, round(len(pixel) / _SAMPLED_PIXELS))
    return pixel[step // 2 :: step]


def semantics_of(
    image: Annotated[Tensor, "H W 3"], encoder: Encoder, basis: "Basis", guided: GuidedConfig
) -> Callable[[Annotated[Tensor, "N 2"]], tuple[Annotated[Tensor, "N D"], Annotated[Tensor, "N"]]]:
    """Encode a photograph: what comes back gives filtered semantics at pixels (x, y, int64) in a scene's basis, and what
    lies beyond it (`Basis.beyond`).
    """
    maps = _encode(encoder, image)
    cells = maps.flatten(1).T
    low = basis.project(cells)
    # Projecting is linear and so is the filter: fewer channels first.
    fewer = torch.cat([low, basis.beyond(cells, low)], 1).T.reshape(-1, *maps.shape[1:])
    filtered = _filtered(fewer, image, guided)

    def samples(pixel: Annotated[Tensor, "N 2"]) -> tuple[Annotated[Tensor, "N D"], Annotated[Tensor, "N"]]:
        found = filtered(pixel)
        return found[:, :-1].contiguous(), found[:, -1].clamp_min(0)

    return samples


def _encode(encoder: Encoder, image: Annotated[Tensor, "H W 3"]) -> Annotated[Tensor, "C h w"]:
    with float32_convolutions(image.device):
        features: Tensor = encoder(image.permute(2, 0, 1)[None])
    return features[0].float()


def _filtered(
    maps: Annotated[Tensor, "C h w"], image: Annotated[Tensor, "H W 3"], guided: GuidedConfig
) -> Callable[[Annotated[Tensor, "N 2"]], Annotated[Tensor, "N C"]]:
    """The guided filter of a picture; what comes back applies it at pixels (x, y, int64)."""
    height, width = image.shape[:2]
    radius = round(guided.radius * min(height, width))
    cells = coefficients(maps, image, radius=radius, eps=guided.eps, stride=_FILTER_CELL_PIXELS)

    def at(pixel: Annotated[Tensor, "N 2"]) -> Annotated[Tensor, "N C"]:
        rows = []
        for part in torch.split(pixel, _FILTERED_ROWS):
            rows.append(apply(cells, part + 0.5, image[part[:, 1], part[:, 0]], (height, width)))
        return torch.cat(rows)

    return at


def _read_mask(path: Path, photo_path: Path, photo: Image, size: tuple[int, int]) -> Annotated[Tensor, "H W"]:
    """Read the mask of a photograph at a size (width, height), bool."""
    white = load_mask(path, upright=True)
    (height, width) = white.shape
    (own_height, own_width) = photo.shape[:2]
    if abs(width * own_height - height * own_width) > 0.5 * (width + height + own_width + own_height):
        raise DataError(
            f"{path}: a mask of {width}x{height} pixels does not fit {photo_path.name} of {own_width}x{own_height}; "
            "draw it on the photograph itself"
        )
    cover = np.asarray(cv2.resize(white.astype(np.float32), size, interpolation=cv2.INTER_AREA))
    selected = _mostly_covered(torch.from_numpy(cover))
    if not bool(selected.any()):
        raise DataError(
            f"{path}: the mask selects no pixel of {photo_path.name}; paint white what makes the style"
        )
    return selected


def _within_mask(
    selected: Annotated[Tensor, "H W"], opaque: Annotated[Tensor, "H W"] | None, mask: Path, photo: Path
) -> Annotated[Tensor, "H W"]:
    """Pixels that a mask selects and that are opaque."""
    both = selected if opaque is None else selected & opaque
    if not bool(both.any()):
        raise DataError(
            f"{mask}: the mask selects only what is transparent in {photo.name}; paint white what makes the style"
        )
    return both


class StyleDictionary(NamedTuple):
    """T style codes of all references together."""

    keys: Annotated[Tensor, "T D"]
    """Semantic centroid of each code, in the scene's semantic basis."""
    mean: Annotated[Tensor, "T C"]
    covariance: Annotated[Tensor, "T C C"]
    """Content statistics of each code; the local standard deviation is the root of the diagonal."""
    share: Annotated[Tensor, "T"]
    """Share of its reference's pixels."""
    reference: Annotated[Tensor, "T"]
    """int64 index of the reference that a code comes from."""
    weight: Annotated[Tensor, "T"]
    """User weight of its reference; above 0."""
    names: tuple[str, ...]
    """Names of the references, in dictionary order."""
    blend: float = 0.0
    """Share of the whole reference's statistics that is in each code; `whole_style` takes it out again."""
    colour_mean: Annotated[Tensor, "T 3"] | None = None
    """Mean colour of each code's pixels, blended as `mean` is; None where a reference came without
    colours.
    """
    colour_covariance: Annotated[Tensor, "T 3 3"] | None = None
    beyond: Annotated[Tensor, "T"] | None = None
    """Mean squared length of each code's semantics outside of the scene's basis; None = 0."""
    allowed: Annotated[Tensor, "K references"] | None = None
    """On one scene: which references each of its regions may take from, bool; None = all. Not saved."""
    origin: Annotated[Tensor, "D"] | None = None
    """The encoder's zero, projected on the scene's semantic basis; None = 0. Not saved: it follows from the
    basis.
    """
    placed: tuple[Pairs | None, ...] = ()
    """Colours at the very place, of each reference that shows it; () = nobody looked. Not saved."""


def build_dictionary(
    references: Sequence[Reference],
    *,
    clusters: int = CLUSTERS,
    blend: float = BLEND,
    seed: int = 0,
) -> StyleDictionary:
    """Cluster each reference by its semantics; a code is the mean and covariance of the content inside,
    float32.

    A code takes `blend` of its whole image's statistics, and more the further its members fall short of 32.
    The order of the references plays no part: they are sorted by what they hold. Statistics are computed on
    the samples' device; the tables, a few kB, are on the CPU, where stylizers are built. Raises DataError for
    no references, and for values that are not finite.
    """
    at_least("clusters", clusters, 1)
    between("blend", blend, 0.0, 1.0)
    if not references:
        raise DataError("references: none given; name at least one photograph")
    for r in references:
        if not 0 < len(r.content) == len(r.semantic):
            raise DataError(
                f"{r.name}: {len(r.content)} samples of content, {len(r.semantic)} of semantics; as many of both, at least 1"
            )
        if not bool(r.content.isfinite().all() & r.semantic.isfinite().all()):
            raise DataError(
                f"{r.name}: a feature is not finite; the image or the encoder's weights are damaged"
            )

    def content_hash(r: Reference) -> str:
        digest = hashlib.sha256()
        for part in (r.content, r.semantic):
            digest.update(str(tuple(part.shape)).encode())
            digest.update(part.detach().float().cpu().contiguous().numpy().tobytes())
        return digest.hexdigest()

    # By content, so that the order in which they were named does not show even in the rounding of sums.
    ordered = sorted(references, key=lambda r: (content_hash(r), r.name, r.weight))
    parts = [_codes_of(r, clusters, blend, seed) for r in ordered]
    return concatenate(parts, [r.name for r in ordered], [r.weight for r in ordered])


def concatenate(
    parts: Sequence[StyleDictionary], names: Sequence[str], weights: Sequence[float]
) -> StyleDictionary:
    """Join dictionaries of one reference each, under new names and weights."""
    counts = torch.tensor([len(part.keys) for part in parts])
    fields = []
    for name in (*_CODE_TABLES, *_OPTIONAL_TABLES):
        if all(getattr(part, name) is not None for part in parts):
            fields.append(name)
    tables = {}
    for name in fields:
        tables[name] = torch.cat([getattr(part, name) for part in parts])
    tables["weight"] = torch.tensor(weights, dtype=torch.float32).repeat_interleave(counts)
    reference = torch.arange(len(parts)).repeat_interleave(counts)
    placed = tuple(part.placed[0] if part.placed else None for part in parts)
    return StyleDictionary(
        **tables, reference=reference, names=tuple(names), blend=parts[0].blend, placed=placed
    )


def _codes_of(r: Reference, clusters: int, blend: float, seed: int) -> StyleDictionary:
    """Build the codes of one reference, float32, those of colours where it has some."""
    # Local codes are clusters of the semantics; without semantics there is one.
    label = r.semantic.new_zeros(len(r.semantic), dtype=torch.int64)
    keys = r.semantic[:1].float()
    if r.semantic.shape[1] > 0:
        keys, label = kmeans(r.semantic, clusters, seed=seed)
    # Codes with few members say little: the fewer, the more of the whole image they take. `whole_share` [T]
    # is that: `blend` for codes of _MIN_SURE_MEMBERS or more, rising to 1 for a code without any.
    member = double(torch.nn.functional.one_hot(label, len(keys)))
    share = member.sum(0) / len(label)
    whole_share = 1 - (1 - blend) * (share * len(label) / _MIN_SURE_MEMBERS).clamp_max(1.0)

    def statistics(
        features: Annotated[Tensor, "N C"],
    ) -> tuple[Annotated[Tensor, "T C"], Annotated[Tensor, "T C C"]]:
        """Mean M and covariance Sigma of each code (paper, Eq. 6), blended with those of the whole image."""
        whole = moments(features, features.new_ones(len(features)))
        mean, covariances, _ = group_moments(features, member)
        return blend_codes(mean, covariances, whole.mean, covariance(whole), whole_share)

    # Of content features always; of colours, and of what lies beyond, where the reference brings them.
    tables = dict(zip(("mean", "covariance"), statistics(r.content), strict=True))
    if r.colour is not None:
        tables |= dict(zip(_COLOUR_TABLES, statistics(r.colour), strict=True))
    if r.beyond is not None:
        tables["beyond"] = member.T @ double(r.beyond) / member.sum(0)
    tables |= {"keys": keys, "share": share, "weight": torch.full_like(share, r.weight)}
    return StyleDictionary(
        **{name: table.float().cpu() for name, table in tables.items()},
        reference=torch.zeros(len(keys), dtype=torch.int64),
        names=(r.name,),
        blend=float(blend),
        placed=(r.placed,),
    )


def blend_codes(
    mean: Annotated[Tensor, "T C"],
    covariances: Annotated[Tensor, "T C C"],
    whole_mean: Annotated[Tensor, "C"],
    whole_covariance: Annotated[Tensor, "C C"],
    blend: Annotated[Tensor, "T"],
) -> tuple[Annotated[Tensor, "T C"], Annotated[Tensor, "T C C"]]:
    """Local statistics x (1 - blend) + whole x blend, code by code (released code, `blending_ratio`)."""
    whole = blend[:, None]
    return (1 - whole) * mean + whole * whole_mean, (1 - whole[..., None]) * covariances + whole[
        ..., None
    ] * whole_covariance


def whole_style(d: StyleDictionary) -> tuple[Annotated[Tensor, "C"], Annotated[Tensor, "C C"]]:
    """Mean and covariance of all pixels of all references by user weight, float64: what global AdaIN aims at.

    Blending draws the codes' means together and thereby takes b (1 - b) of the scatter between them out of
    the total covariance, for blend b; it is given back, reference by reference, so that clusters and blend
    don't matter here (but for clusters of less than 32 members, which hold too few pixels to show).
    """
    means = []
    covariances = []
    weights = []
    for i in range(len(d.names)):
        own = d.reference == i
        mean, total = mix(d.mean[own], d.covariance[own], d.share[own])
        if d.blend < 1:
            # The blended means scatter (1 - b)^2 as much as the true ones, of whose scatter b (1 - b) is
            # missing in the total.
            share = double(d.share[own])
            apart = (double(d.mean[own]) - mean) * (share / share.sum()).sqrt()[:, None]
            total = total + d.blend / (1 - d.blend) * apart.T @ apart
        means.append(mean)
        covariances.append(total)
        weights.append(double(d.weight[own])[0])
    return mix(torch.stack(means), torch.stack(covariances), torch.stack(weights))


def code_odds(d: StyleDictionary) -> Annotated[Tensor, "T"]:
    """Share of each code when nothing is matched: its pixels, by user weight; float64, sums to 1."""
    odds = double(d.share) * double(d.weight)
    return odds / odds.sum()


def choose(
    d: StyleDictionary, references: Annotated[Tensor, "references"]
) -> tuple[StyleDictionary, Annotated[Tensor, "T"]]:
    """Select some of the references (bool, at least one); return their dictionary, and which of the codes
    these are (bool).
    """
    # References that stay are numbered anew, from 0.
    codes = references[d.reference]
    renumbered = references.cumsum(0) - 1
    part = d._replace(
        **{
            name: getattr(d, name)[codes]
            for name in (*_CODE_TABLES, *_OPTIONAL_TABLES)
            if getattr(d, name) is not None
        },
        reference=renumbered[d.reference[codes]],
        names=tuple(name for name, taken in zip(d.names, references.tolist(), strict=True) if taken),
        allowed=None,
        placed=tuple(d.placed[i] for i in references.nonzero()[:, 0].tolist() if d.placed),
    )
    return part, codes


def save_dictionary(path: Path, d: StyleDictionary) -> None:
    """Write the dictionary as safetensors, for people and other programs; a crash leaves the old file or the
    new one.
    """
    fields = []
    for name in (*_CODE_TABLES, "reference", *_OPTIONAL_TABLES):
        if getattr(d, name) is not None:
            fields.append(name)
    tensors = {}
    for name in fields:
        tensors[name] = getattr(d, name).detach().cpu().contiguous()
    write_bytes(path, save(tensors, metadata={"names": json.dumps(d.names), "blend": repr(d.blend)}))
