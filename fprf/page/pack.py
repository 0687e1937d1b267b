"""Gaussians as the page draws them: 16 bytes for the shape of each, and 4 for its colours in each style.

Letters: N Gaussians in Morton order, C chunks of 256 of them, K = (degree + 1)^2 harmonics a channel, of
degree 2 at most.

shape     N x 16 bytes: mean 3 x 16 bits and ln-scales 3 x 8 bits between the least and the most of the chunk, opacity 8 bits,
          quaternion 3 x 10 bits and 2 that say which component is left out, entry of the palette 16 bits
chunks    C x 12 floats: least and most of means and of ln-scales
palette   E x (K - 1) x 4 signed bytes: harmonics above the constant one, b -> largest sign(b) (b / 127)^2
colours   N x 4 bytes a style: mean colour between a least and a most, and which of the style's maps it takes
maps      M x 9 floats a style: what becomes of the captured harmonics above the constant one, h' = h A

A style changes colours by affine maps (`splats.restyle`), so its view dependence is that of the capture
through one of at most 256 matrices, and costs a byte. Compared with .sog, ranges by chunk keep 16 bits good
for scenes of any extent.
"""

import json
import math
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..ops.harmonics import HARMONIC
from ..splats.files.base import smallest_three, spatial_order, steps
from ..splats.gaussians import Gaussians

CHUNK = 256
"""Gaussians of a chunk; the last one is filled up with its last Gaussian."""
MAPS = 256
"""Matrices a style, at most."""
_PAGE_HARMONICS = 9
"""Harmonics a channel that the page evaluates: degree 2."""
_LLOYD_ROUNDS = 6
"""Rounds of Lloyd's algorithm that a palette is learned in; by eye."""
_MAX_PALETTE_ROWS = 1 << 14
"""Rows that a palette is learned from, at most; by eye: bounds the time."""
_COMPARED_ROWS = 1 << 15
"""Rows at a time where each is compared with a palette: bounds the memory."""


class Colours(NamedTuple):
    """One style."""

    rows: Annotated[NDArray[np.uint8], "N 4"]
    low: Annotated[NDArray[np.float32], "3"]
    high: Annotated[NDArray[np.float32], "3"]
    maps: Annotated[NDArray[np.float32], "M 9"]


@dataclass(frozen=True, eq=False)
class Packed:
    """The shapes of a scene; `colours` makes its styles."""

    order: Annotated[Tensor, "N"]
    """Rows of the packed Gaussians among those that were given."""
    harmonics: Annotated[Tensor, "N K 3"]
    """As captured, in that order."""
    shape: Annotated[NDArray[np.uint8], "N 16"]
    chunks: Annotated[NDArray[np.float32], "C 12"]
    palette: Annotated[NDArray[np.int8], "E K-1 4"]
    largest: float
    """Magnitude of the palette's largest harmonic."""

    def colours(
        self,
        harmonics: Annotated[Tensor, "n K' 3"],
        rounds: int = 6,
        progress: Callable[[float], None] = lambda share: None,
    ) -> Colours:
        """A style by the harmonics of all Gaussians that were given, in their order; harmonics that it lacks
        are 0.

        `rounds` of fitting its maps: fewer for one that is shown at once, and soon replaced. `progress` hears
        the share that is done.
        """
        # Means between the least and the most of the style, 8 bits a channel.
        styled = harmonics[self.order, :_PAGE_HARMONICS]
        mean = (0.5 + HARMONIC * styled[:, 0]).clamp(-1, 2).numpy()
        low = mean.min(0)
        high = mean.max(0)
        rows = np.zeros((len(mean), 4), np.uint8)
        rows[:, :3] = steps((mean - low) / np.maximum(high - low, 1e-6), 255)
        # Harmonics above: none, as captured, or as captured through the map that fits best.
        maps = np.eye(3, dtype=np.float32).reshape(1, 9)
        if styled.shape[1] < self.harmonics.shape[1]:
            maps = np.zeros((1, 9), np.float32)
        elif self.harmonics.shape[1] > 1 and not torch.equal(styled[:, 1:], self.harmonics[:, 1:]):
            rows[:, 3], maps = fit_maps(self.harmonics[:, 1:], styled[:, 1:], rounds, progress=progress)
        return Colours(rows, low, high, maps)


def pack(
    gaussians: Gaussians, entries: int = 4096, progress: Callable[[float], None] = lambda share: None
) -> Packed:
    """Pack finite Gaussians with at most `entries` (65536) harmonics in the palette; `progress` hears the share
    that is done.
    """
    order = torch.from_numpy(spatial_order(gaussians.means.numpy()))
    gaussians = gaussians.select(order)
    count = len(gaussians)
    means = gaussians.means.numpy()
    log_scales = gaussians.log_scales.numpy().clip(-20, 20)
    # A chunk holds neighbours, so that its own ranges make steps small where Gaussians lie close together.
    filled = np.minimum(np.arange(-(-count // CHUNK) * CHUNK), count - 1).reshape(-1, CHUNK)
    ranges = []
    for rows in (means, log_scales):
        ranges.append((rows[filled].min(1), rows[filled].max(1)))
    chunk = np.arange(count) // CHUNK
    parts = []
    for rows, (low, high), most in zip((means, log_scales), ranges, (65535, 255), strict=True):
        width = np.where(high > low, high - low, 1.0)
        parts.append(steps((rows - low[chunk]) / width[chunk], most))
    # Words of 32 bits: two axes of the place; its third axis and the entry; the rotation; the size and the
    # opacity.
    place, size = parts
    left_out, three = smallest_three(gaussians.quaternions.numpy())
    turn = steps(three / 2 + 0.5, 1023)
    harmonics = gaussians.harmonics[:, :_PAGE_HARMONICS]
    palette, label, largest = _palette(harmonics[:, 1:], entries, progress)
    words = np.zeros((count, 4), "<u4")
    words[:, 0] = place[:, 0] | place[:, 1] << 16
    words[:, 1] = place[:, 2] | label << 16
    words[:, 2] = turn[:, 0] | turn[:, 1] << 10 | turn[:, 2] << 20 | left_out << 30
    words[:, 3] = (
        size[:, 0] | size[:, 1] << 8 | size[:, 2] << 16 | steps(gaussians.opacities.numpy(), 255) << 24
    )
    (low_mean, high_mean), (low_size, high_size) = ranges
    chunks = np.concatenate([low_mean, high_mean, low_size, high_size], 1).astype(np.float32)
    return Packed(order, harmonics, words.view(np.uint8), chunks, palette, largest)


def _palette(
    rest: Annotated[Tensor, "N K-1 3"], entries: int, progress: Callable[[float], None]
) -> tuple[Annotated[NDArray[np.int8], "E K-1 4"], NDArray[np.int64], float]:
    """Entries, the one of each row, and the largest magnitude: k-means of k-means, or each row its own where
    there are few.
    """
    count = len(rest)
    coefficients = rest.shape[1]
    if coefficients == 0:
        return np.zeros((0, 0, 4), np.int8), np.zeros(count, np.int64), 0.0
    rows = rest.flatten(1).float()
    if count <= entries:
        book = rows
        label = torch.arange(count)
    else:
        # Two levels: each row is compared with 2 sqrt(E) entries and not with E.
        side = math.isqrt(entries)
        groups = _clustered(rows, side)[1]
        books: list[Tensor] = []
        label = torch.zeros(count, dtype=torch.int64)
        for group in range(side):
            progress(group / side)
            inside = (groups == group).nonzero()[:, 0]
            if len(inside):
                means, mine = _clustered(rows[inside], side)
                label[inside] = sum(len(each) for each in books) + mine
                books.append(means)
        book = torch.cat(books)
    largest = float(book.abs().max()) or 1.0
    # The square root spends the bytes on the many small harmonics.
    level = (127 * (book / largest).abs().sqrt() * book.sign()).round().to(torch.int8)
    out = np.zeros((len(book), coefficients, 4), np.int8)
    out[..., :3] = level.view(len(book), coefficients, 3).numpy()
    return out, label.numpy(), largest


def _clustered(
    rows: Annotated[Tensor, "N D"], count: int
) -> tuple[Annotated[Tensor, "k D"], Annotated[Tensor, "N"]]:
    """At most `count` means of a sample of the rows (Lloyd's algorithm), and the nearest one of each row."""
    sample = rows[:: max(1, len(rows) // _MAX_PALETTE_ROWS)]
    book = sample[torch.linspace(0, len(sample) - 1, min(count, len(sample))).long()]
    for _ in range(_LLOYD_ROUNDS):
        nearest = _nearest(sample, book)
        # An entry that nothing is nearest to stays where it is.
        inside = torch.bincount(nearest, minlength=len(book))
        moved = torch.zeros_like(book).index_add_(0, nearest, sample) / inside.clamp_min(1)[:, None]
        book = torch.where(inside[:, None] > 0, moved, book)
    return book, _nearest(rows, book)


def _nearest(rows: Annotated[Tensor, "N D"], book: Annotated[Tensor, "E D"]) -> Annotated[Tensor, "N"]:
    """The nearest entry of each row."""
    half = book.square().sum(1) / 2
    parts = []
    for part in torch.split(rows, _COMPARED_ROWS):
        parts.append((half - part @ book.T).argmin(1))
    return torch.cat(parts)


def fit_maps(
    before: Annotated[Tensor, "N K-1 3"],
    after: Annotated[Tensor, "N K-1 3"],
    rounds: int = 6,
    count: int = MAPS,
    progress: Callable[[float], None] = lambda share: None,
) -> tuple[NDArray[np.uint8], Annotated[NDArray[np.float32], "M 9"]]:
    """At most 256 matrices A, and for each row the one by which before A comes nearest to after, in least
    squares.

    The error of a row is <G, A A^T> - 2 <H, A> + const with G = before^T before and H = before^T after: a
    product of 18 numbers, whatever K is. `progress` hears the share of rounds that are done.
    """
    grams = torch.einsum("nki,nkj->nij", before, before).flatten(1)
    crosses = torch.einsum("nki,nkj->nij", before, after).flatten(1)
    rows = torch.cat([grams, -2 * crosses], 1)
    # Start from the least-squares map of single rows, those of much view dependence first.
    weight = grams[:, [0, 4, 8]].sum(1)
    some = weight.topk(min(len(weight), 64 * count)).indices[
        :: max(1, min(len(weight), 64 * count) // count)
    ][: count - 1]
    ridge = 1e-2 * weight[some, None, None].clamp_min(1e-8) * torch.eye(3)
    maps = torch.linalg.solve(grams[some].view(-1, 3, 3) + ridge, crosses[some].view(-1, 3, 3) + ridge)
    maps = torch.cat([torch.eye(3)[None], maps])
    for step in range(rounds + 1):
        progress(step / (rounds + 1))
        # Assign each row to the map of the least error, then solve each map's normal equations over its rows.
        book = torch.cat([(maps @ maps.transpose(1, 2)).flatten(1), maps.flatten(1)], 1)
        parts = []
        for part in torch.split(rows, _COMPARED_ROWS):
            parts.append((part @ book.T).argmin(1))
        label = torch.cat(parts)
        if step == rounds:
            break
        gram = torch.zeros(len(maps), 9).index_add_(0, label, grams).view(-1, 3, 3)
        cross = torch.zeros(len(maps), 9).index_add_(0, label, crosses).view(-1, 3, 3)
        # The ridge draws a map that few rows determine to what it was.
        ridge = (1e-4 * gram.diagonal(dim1=1, dim2=2).sum(1) + 1e-8)[:, None, None] * torch.eye(3)
        maps = torch.linalg.solve(gram + ridge, cross + ridge @ maps)
    return label.to(torch.uint8).numpy(), maps.flatten(1).float().numpy()


def sections(packed: Packed, level: int = 9) -> dict[str, bytes]:
    """The parts of the geometry by name, deflated; bytes of the shapes lie plane by plane."""
    parts = {"shape": packed.shape.T, "chunks": packed.chunks, "palette": packed.palette}
    found: dict[str, bytes] = {}
    for name, part in parts.items():
        found[name] = zlib.compress(np.ascontiguousarray(part).tobytes(), level)
    return found


def colour_section(colours: Colours, level: int = 9) -> bytes:
    """A style, deflated: planes of bytes, then the maps."""
    return zlib.compress(np.ascontiguousarray(colours.rows.T).tobytes() + colours.maps.tobytes(), level)


def header(packed: Packed) -> dict[str, Any]:
    """Header of the sections, for the page."""
    return {
        "count": len(packed.order),
        "harmonics": packed.palette.shape[1] + 1,
        "entries": len(packed.palette),
        "largest": packed.largest,
    }


def colour_header(colours: Colours) -> dict[str, Any]:
    """Header of a style, for the page."""
    return {"low": colours.low.tolist(), "high": colours.high.tolist(), "maps": len(colours.maps)}


def container(head: Mapping[str, Any], parts: Mapping[str, bytes]) -> bytes:
    """One body of sections for HTTP: length of the JSON (4 bytes), JSON with each section's size,
    sections.
    """
    text = json.dumps({**head, "sizes": {name: len(part) for name, part in parts.items()}}).encode()
    return len(text).to_bytes(4, "little") + text + b"".join(parts.values())
