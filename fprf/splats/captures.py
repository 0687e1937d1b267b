"""Finished captures, one or many and of any size: seen as one scene, recoloured file by file.

What is found out about a capture (views, semantics) is kept in a cache, by the content of its file.

What a style needs to know is found from a sample of the Gaussians of all files together, so that all take the
same maps of colours. A Gaussian that is not in the sample takes the features of those of the sample in the
smallest cell around it that holds any. Then each file is read and written once; of the others nothing is in
memory.
"""

import functools
import hashlib
import math
import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated

import torch
from torch import Tensor

from ..errors import CheckpointError, DataError, UsageError
from ..interfaces import Encoder
from ..io.cache import cache_folder
from ..io.images import to_uint8, write_image
from ..io.tensorfiles import load_sealed, save_kept
from ..ops.rasterise import MIN_ALPHA
from ..rendering.cameras import Cameras
from ..scenes import Scene
from ..style.dictionary import code_odds
from ..style.look import ColourMaps, Restyle
from ..style.restyle import Styled
from ..training.loading import open_run
from .config import LookConfig
from .drawing import clip_distance
from .files import Capture, read_capture, release
from .files.base import pieces
from .gaussians import Gaussians, bulk_of, cells_of
from .restyle import restyled_harmonics
from .scene import SplatScene
from .semantics import Semantics, find_semantics, load_semantics, semantics_tensors, tensor_group
from .views import find_views

_UP = (0.0, -1.0, 0.0)
"""Direction that points up where nothing says so."""
_CACHED = 24
"""Captures of which the cache keeps what was found out."""
SAMPLE = 2_000_000
"""Gaussians that are looked at, at most: what is in memory of captures of any size, beside the file at
hand.
"""
_FINEST = 1024
_LEVELS = 12
"""Cells along the longest side of the bulk at the finest level; levels, each of cells twice as wide."""
_STRAY = 500.0
"""Extents of the bulk from it, beyond which Gaussians do not say where cells begin: twice that fits into 2^20
finest ones.
"""
_BLACK = 0.055
"""Added to sRGB, it is a power of linear light."""
_VIEW = (480, 360)
_SOLID = 0.95
"""Size of views in the place of photographs; opacity from which on their pixels count."""
MAX_REFERENCE_VIEWS = 16
"""Views of a capture that are references, at most."""
_GAP = 0.1
"""Distance between captures that would overlap, as a share of their width, where they are put in a row."""
_SHARED = 24
_ENOUGH = 64
_ALIKE = 0.4
"""Cells that captures share, at least and enough, and correlation of their brightness there: then they are of
one place.
"""


def look_at_capture(
    gaussians: Gaussians,
    antialiased: bool,
    encoder: Encoder,
    config: LookConfig,
    progress: Callable[[int, int], None] = lambda done, total: None,
    camera: Cameras | None = None,
) -> SplatScene:
    """Find views of Gaussians that are all finite, sizes included. What they show is found when it is first
    asked for.

    `camera` is the view that the capture was made from, where it is known. Raises DataError where nothing can
    be seen.
    """
    # Mistakes are told before views are sought, which takes seconds.
    up = torch.tensor(config.up or _UP)
    if not bool(up.isfinite().all() & (up.norm() > 0)):
        raise DataError(f"up {config.up}: no direction; give three numbers, not all 0")
    if float(gaussians.opacities.max()) < MIN_ALPHA:
        raise DataError(
            f"all {len(gaussians)} Gaussians are transparent; nothing of the capture can be seen or restyled"
        )
    cameras = find_views(
        gaussians,
        count=config.views,
        size=config.size,
        up=up,
        inside=config.inside,
        antialiased=antialiased,
        camera=camera,
    )

    def found() -> Semantics:
        near = clip_distance(gaussians)
        return find_semantics(
            gaussians, antialiased, encoder, cameras, config.regions, near=near, progress=progress
        )

    return _scene_of(gaussians, antialiased, cameras, functools.cache(found), encoder)


def _scene_of(
    gaussians: Gaussians,
    antialiased: bool,
    cameras: Cameras,
    found: Callable[[], Semantics],
    encoder: Encoder,
) -> SplatScene:
    """The scene of a capture; its views are numbered."""
    names = tuple(f"{view:02d}" for view in range(len(cameras)))
    longest = int(cameras.size.amax())
    near = clip_distance(gaussians)
    return SplatScene(gaussians, antialiased, cameras, names, found, lambda: encoder, longest, near)


def open_capture(
    capture: Capture,
    look: LookConfig,
    *,
    cache: Path | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
    say: Callable[[str], None] = lambda text: None,
) -> SplatScene:
    """A capture as a scene: its Gaussians that can be drawn, with views and features from the cache.

    What points up is as `look` says, else as the file does. Where views and features are absent, views are
    found here, and features, which are then stored, when they are first asked for. `cache` is the folder; by
    default the user's own.
    """
    look = replace(look, up=look.up or capture.up)
    folder = cache or cache_folder("captures")
    encoder = look.semantic.encoder.build()
    # What is found follows from the file, the encoder and how it is looked at. The first number counts the
    # versions of it.
    digest = hashlib.sha256(capture.data)
    digest.update(
        f"10 {encoder.identity} {look.up} {look.inside} {look.views} {look.size} {look.regions}".encode()
    )
    path = folder / f"{digest.hexdigest()[:32]}.safetensors"
    gaussians = capture.gaussians.drawable()
    antialiased = capture.antialiased
    if os.path.isfile(path):  # False also where the folder is closed to us
        try:
            tensors = load_sealed(path)
            cameras = Cameras(**tensor_group(tensors, "camera"))
            semantics = load_semantics(tensors, len(gaussians))
        except (CheckpointError, TypeError) as error:
            say(f"looking again: {error}")
        else:
            with suppress(OSError):  # another process may just have removed it
                os.utime(path)
            return replace(
                _scene_of(gaussians, antialiased, cameras, lambda: semantics, encoder), origin=capture.origin
            )
    scene = look_at_capture(gaussians, antialiased, encoder, look, progress, capture.camera)

    def found() -> Semantics:
        semantics = scene.found()
        views = {}
        for field in fields(Cameras):
            views[f"camera.{field.name}"] = getattr(scene.views, field.name)
        save_kept(path, {**views, **semantics_tensors(semantics)})
        with suppress(OSError):  # another process removes files, too: what is left the next one finds
            files = []
            for each in folder.glob("*.safetensors"):
                if each.is_file():
                    files.append(each)
            for old in sorted(files, key=lambda each: each.stat().st_mtime)[:-_CACHED]:
                old.unlink(missing_ok=True)
        return semantics

    return replace(scene, found=functools.cache(found), origin=capture.origin)


@dataclass(frozen=True, eq=False)
class Captures:
    """Captures that are seen as one scene."""

    scene: SplatScene
    """A sample of all of them, about the origin of the first one."""
    rows: tuple[slice, ...]
    """Where the Gaussians of each capture are among those of the scene."""
    moved: tuple[Annotated[Tensor, "3"], ...]
    """What was added to the means of each capture, so that none lies in another's place."""
    first: Capture
    """The first capture, as it was read."""
    count: int
    """Gaussians of all captures."""

    def harmonics(self, index: int, capture: Capture, look: Restyle) -> Annotated[Tensor, "N K 3"]:
        """Harmonics in a look of all Gaussians of capture number `index` that can be drawn."""
        gaussians = capture.gaussians
        rows = self.rows[index]
        finite = gaussians.finite
        if bool(finite.all()):
            gaussians = gaussians
        else:
            gaussians = gaussians.select(finite)
        here = tuple(a - b for a, b in zip(capture.origin, self.scene.origin, strict=True))
        if any(here):
            means = gaussians.means + torch.tensor(here)
        else:
            means = gaussians.means
        features = self.scene.found().features[rows]
        if len(features) == len(gaussians):
            return restyled_harmonics(gaussians.harmonics, means, features, look)
        # The sample stands where its own capture was moved to: back in its place.
        near = Neighbours(self.scene.gaussians.means[rows] - self.moved[index], features)
        out = torch.empty_like(gaussians.harmonics)
        for some in pieces(len(out)):
            out[some] = restyled_harmonics(gaussians.harmonics[some], means[some], near(means[some]), look)
        return out


def open_captures(
    paths: Sequence[Path],
    look: LookConfig,
    *,
    first: Capture | None = None,
    sample: int = SAMPLE,
    cache: Path | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
    say: Callable[[str], None] = lambda text: None,
) -> Captures:
    """Read captures and see them as one scene; arguments as those of `open_capture`.

    Of several captures each gives a like share of the sample. `first` is the first one, where it was read
    already. Raises DataError where nothing can be seen.
    """
    first = first or _read(paths[0], say)
    if len(paths) == 1 and len(first.gaussians) <= sample:
        scene = open_capture(first, look, cache=cache, progress=progress, say=say)
        return Captures(
            scene, (slice(0, len(scene.gaussians)),), (torch.zeros(3),), first, len(first.gaussians)
        )
    parts = list[Gaussians]()
    key = hashlib.sha256(f"{sample} {len(paths)}".encode())
    compensated = first.antialiased
    count = 0
    for path in paths:
        capture = first if path == paths[0] else _read(path, say)
        key.update(hashlib.sha256(capture.data).digest())
        release(capture.data)
        count += len(capture.gaussians)
        here = torch.tensor([a - b for a, b in zip(capture.origin, first.origin, strict=True)])
        part = sampled(capture.gaussians.drawable(), max(1, sample // len(paths)))
        if bool(here.any()):
            key.update(f"{here.tolist()}".encode())  # an offset beside a file moves it among the others
            part = replace(part, means=part.means + here)
        parts.append(part)
        compensated = compensated or capture.antialiased
    moved = _apart(parts)
    together = _joined([replace(part, means=part.means + by) for part, by in zip(parts, moved, strict=True)])
    # What lies in one row is looked at as an object; a known camera is that of one capture alone.
    alone = len(paths) == 1
    whole = replace(
        first,
        gaussians=together,
        antialiased=compensated,
        data=key.digest(),
        camera=first.camera if alone else None,
    )
    scene = open_capture(whole, look, cache=cache, progress=progress, say=say)
    ends = torch.tensor([len(part) for part in parts]).cumsum(0).tolist()
    rows = tuple(slice(end - len(part), end) for end, part in zip(ends, parts, strict=True))
    return Captures(scene, rows, tuple(moved), first, count)


def _read(path: Path, say: Callable[[str], None]) -> Capture:
    """A capture, with what its file was taken for."""
    capture = read_capture(path)
    for note in capture.notes:
        say(f"{capture.path}: {note}")
    return capture


def sampled(gaussians: Gaussians, most: int) -> Gaussians:
    """At most so many of the Gaussians, at equal steps, and wider by as many as each stands for."""
    count = len(gaussians)
    if count <= most:
        return gaussians
    some = gaussians.select(torch.arange(most) * count // most)
    # What is seen are surfaces: areas grow as the numbers shrink.
    return replace(some, log_scales=some.log_scales + 0.5 * math.log(count / most))


def _apart(parts: Sequence[Gaussians]) -> list[Annotated[Tensor, "3"]]:
    """What takes captures apart, in a row along x, where some lie in one place; nothing where they are
    neighbours.
    """
    boxes = []
    for part in parts:
        # Stray Gaussians do not make neighbours of captures that are apart.
        inner = part.means[torch.from_numpy(bulk_of(part.means.numpy()).apart <= 0.5)]
        boxes.append((inner.amin(0), inner.amax(0)))
    overlap = False
    for i, (low, high) in enumerate(boxes):
        for other_low, other_high in boxes[:i]:
            shared = (torch.minimum(high, other_high) - torch.maximum(low, other_low)).clamp_min(0)
            least = torch.minimum(high - low, other_high - other_low)
            overlap = overlap or bool((shared > 0.5 * least).all())
    moves = []
    at = 0.0
    for low, high in boxes:
        moves.append(torch.tensor([at - float(low[0]), 0.0, 0.0]) if overlap else torch.zeros(3))
        at += (1 + _GAP) * float(high[0] - low[0])
    return moves


def _joined(parts: Sequence[Gaussians]) -> Gaussians:
    """All Gaussians of several, with as many harmonics as the most of them have."""
    if len(parts) == 1:
        return parts[0]
    bands = max(part.harmonics.shape[1] for part in parts)
    same = []
    for part in parts:
        # Harmonics of a higher degree are 0 where a file has none.
        missing = part.harmonics.new_zeros(len(part), bands - part.harmonics.shape[1], 3)
        same.append(part.recoloured(torch.cat([part.harmonics, missing], 1)))
    return Gaussians(*(torch.cat(each) for each in zip(*(vars(part).values() for part in same), strict=True)))


def neighbouring_light(captures: Captures, references: Sequence[Path]) -> Annotated[Tensor, "3"] | None:
    """Gains of colours + 0.055 that take captures to the light of other captures which they overlap or border
    on.

    Found where both have Gaussians in one cell, so that what only one of them shows has no part in it: the
    median over cells. None where they share too few cells, or where their colours in these have nothing in
    common: then they are not of one place.
    """
    own = captures.scene.gaussians
    means = own.means.clone()
    for rows, by in zip(captures.rows, captures.moved, strict=True):
        means[rows] -= by
    others = [read_capture(path) for path in references]
    parts = []
    for other in others:
        parts.append(sampled(other.gaussians.drawable(), SAMPLE // len(others)))
    shifts = []
    for other in others:
        shifts.append([a - b for a, b in zip(other.origin, captures.scene.origin, strict=True)])
    theirs = torch.cat([part.means + torch.tensor(shift) for part, shift in zip(parts, shifts, strict=True)])
    places = torch.cat([means, theirs])
    colours = (
        torch.cat([own.colours, *(part.colours for part in parts)]).double().clamp(0, 1) + _BLACK
    ).log()
    # What can be seen counts, by its opacity.
    weight = torch.cat([own.opacities, *(part.opacities for part in parts)]).double()
    low, edge = _grid(means)
    gain = None
    most = _SHARED - 1
    for level in range(_LEVELS - 2):
        cell = torch.unique(cells_of(places, low, edge * 2**level), return_inverse=True)[1]
        count = int(cell.max()) + 1
        # Of each cell the mean colour of either side.
        sides = []
        for rows in (slice(0, len(means)), slice(len(means), None)):
            share = torch.zeros(count).double().index_add_(0, cell[rows], weight[rows])
            sums = (
                torch.zeros(count, 3).double().index_add_(0, cell[rows], weight[rows, None] * colours[rows])
            )
            sides.append((share, sums))
        both = (sides[0][0] > 0.5) & (sides[1][0] > 0.5)
        if int(both.sum()) <= most:
            continue
        before, after = (sums[both] / share[both, None] for share, sums in sides)
        alike = torch.corrcoef(torch.stack([before.mean(1), after.mean(1)]))[0, 1]
        if not alike > _ALIKE:
            continue
        gain = (after - before).median(0).values.exp()
        most = int(both.sum())
        # The smaller the cells, the more alike are the things in them.
        if most >= _ENOUGH:
            break
    return gain


def light_alone(styled: Styled, gain: Annotated[Tensor, "3"] | None = None) -> Styled:
    """A style as its exposure and white balance alone: one gain a channel, in linear light, for the whole
    scene.

    Without a known `gain` it takes the scene's mean colour, of logarithms, to that of the references: right
    where both are of the same materials.
    """
    style = styled.scene_style
    dictionary = styled.dictionary
    regions = len(styled.scene_style.keys)
    if dictionary.colour_mean is None:
        raise UsageError("--match-light: the style has no colours of photographs; name references")
    # sRGB is a power of linear light but for the black end: a gain is a factor of colours plus 0.055.
    sides = ((style.region_mean, style.share), (dictionary.colour_mean, code_odds(dictionary)))
    before, after = (
        (share.double() / share.double().sum()) @ (colour.double().clamp(0, 1) + _BLACK).log()
        for colour, share in sides
    )
    gain = (after - before).exp() if gain is None else gain
    maps = ColourMaps(style, gain.diag().expand(regions, 3, 3), (_BLACK * (gain - 1)).expand(regions, 3), 1.0)
    return styled._replace(restyle=replace(styled.restyle, colours=maps, light=None, places=()))


def reference_views(
    path: Path, look: LookConfig, folder: Path
) -> tuple[tuple[Path, ...], tuple[Path, ...], tuple[float, ...]]:
    """Write pictures of views of a capture or of a run into a folder: in the place of photographs, as
    references.

    Returns them, masks of what they show, and the shares of them that show anything. Raises DataError where
    none does.
    """
    if (path / "config.json").is_file():
        scene: Scene = open_run(path, device="cpu").scene
    else:
        capture = read_capture(path)
        encoder = look.semantic.encoder.build()
        gaussians = sampled(capture.gaussians.drawable(), SAMPLE)
        # As many views as a capture that takes the style is looked at from: of one place both show alike
        # shares.
        look = replace(look, size=_VIEW, up=look.up or capture.up)
        scene = look_at_capture(gaussians, capture.antialiased, encoder, look, camera=capture.camera)
    chosen = (
        torch.linspace(0, len(scene.names) - 1, min(MAX_REFERENCE_VIEWS, len(scene.names))).round().long()
    )
    cameras = scene.cameras.select(chosen)
    pictures = list[Path]()
    masks = list[Path]()
    weights = list[float]()
    for view in range(len(cameras)):
        shown = scene.render(cameras, view)
        solid = shown.opacity > _SOLID
        if bool(solid.any()):
            pictures.append(folder / f"{view:02d}.png")
            masks.append(folder / f"{view:02d}.mask.png")
            weights.append(float(solid.double().mean()))
            # What is not solid is transparent: no encoder sees the backdrop.
            layers = torch.cat([shown.rgb, solid[..., None].to(shown.rgb)], 2)
            write_image(pictures[-1], to_uint8(layers))
            write_image(masks[-1], to_uint8(solid[..., None].expand(-1, -1, 3).float()))
    if not pictures:
        raise DataError(f"{path}: nothing in it is opaque enough to be a reference")
    return tuple(pictures), tuple(masks), tuple(weights)


def _grid(points: Annotated[Tensor, "N 3"]) -> tuple[Annotated[Tensor, "3"], float]:
    """Lowest corner of the cells around points, and the edge of the finest. Strays are left out: the grid
    cannot reach both.
    """
    bulk = bulk_of(points.numpy())
    return points[torch.from_numpy(bulk.apart <= _STRAY)].amin(0), (bulk.side or 1.0) / _FINEST


class Neighbours:
    """Features at places, as the mean of those of the points in the smallest cell around that holds any."""

    def __init__(self, points: Annotated[Tensor, "M 3"], features: Annotated[Tensor, "M D"]) -> None:
        self.low, self.edge = _grid(points)
        self.fallback = features.float().mean(0)
        self.levels = []
        for level in range(_LEVELS):
            keys, cell = torch.unique(cells_of(points, self.low, self.edge * 2**level), return_inverse=True)
            # A level has the means of its cells, by the sorted numbers of these.
            sums = torch.zeros(len(keys), features.shape[1]).index_add_(0, cell, features.float())
            self.levels.append((keys, (sums / cell.bincount()[:, None]).half()))

    def __call__(self, places: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N D"]:
        """Half precision, as semantics are."""
        out = self.fallback.half().expand(len(places), -1).clone()
        left = torch.arange(len(places))
        for level, (keys, means) in enumerate(self.levels):
            cells = cells_of(places[left], self.low, self.edge * 2**level)
            # Those without a cell at this level ask the next, where cells are twice as wide.
            at = torch.searchsorted(keys, cells).clamp_max(len(keys) - 1)
            found = keys[at] == cells
            out[left[found]] = means[at[found]]
            left = left[~found]
        return out
