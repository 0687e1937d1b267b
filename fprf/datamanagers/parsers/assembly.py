"""From checked views to a `ParsedScene`: sizes and images checked against files, masks, copies left out.

A photograph that is there twice, with one camera, would train on what it is judged by: the second is left out.
Where all images are reduced by one factor against what their cameras say, the cameras are scaled.
"""

import filecmp
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...errors import DataError
from ...rendering.cameras import Cameras
from ...rendering.north import North
from ..images import ImageHeader, has_transparency, read_header
from ..masks import SKY, USED, FoundMasks, MaskKind, masks_beside
from ..photograph_files import COPIES, left_out_note, pixel_digest
from ..scene import ParsedScene
from .files import name_of
from .views import View

_MAX_DECODED_ALPHA = 4
"""Images with an alpha channel that are decoded to see whether it says anything: game engines and screenshots
write it opaque in all files alike.
"""
_MAX_TWIN_OFFSET = 1e-3
"""Share of the cameras' extent, and rotation matrices' entries, within which two cameras may be one. COLMAP gives
copies of a photograph poses 1.2e-4 of the extent apart (16 of a walk along a wall).
"""
_TEST_EVERY = 8
"""Every so many-th view is held out where a capture does not say which, as by LLFF."""


@dataclass(frozen=True, kw_only=True)
class CaptureContents:
    """Content of a scene folder, as a parser has read it."""

    views: Sequence[View]
    """At least one, in the scene's order."""
    split: tuple[Tensor, Tensor] | None = None
    """int64 indices for training and for testing; None = every 8th is for testing."""
    points: NDArray[np.float64] | None = None
    """Sparse points [P 3]."""
    seen: NDArray[np.int64] | None = None
    """Pairs [O 2] of a view and a point that it shows."""
    reduced: bool = False
    """Images are copies, of one shape with the cameras, that may each be reduced by a factor of its own."""
    up: tuple[float, float, float] | None = None
    """Direction up, if the capture says it."""
    north: North | None = None
    """Direction of north, if the capture says it."""
    notes: Sequence[str] = ()
    """Decisions that were taken while it was read."""


def index_tensor(members: Sequence[bool]) -> Tensor:
    """The int64 positions of the members."""
    parts = []
    for k, member in enumerate(members):
        if member:
            parts.append(k)
    return torch.tensor(parts, dtype=torch.int64)


def split_by(held: Sequence[bool]) -> tuple[Tensor, Tensor] | None:
    """Indices (train, test), int64, of views of which some are held out; None where all or none are."""
    if len({*held}) > 1:
        parts = []
        for each in held:
            parts.append(not each)
        return (index_tensor(parts), index_tensor(held))
    return None


def assemble_scene(data: Path, contents: CaptureContents, *, downscale: float) -> ParsedScene:
    """The scene of a folder at 1/downscale of its images. Raises DataError where images do not fit their
    cameras.
    """
    contents = without_copies(contents)
    views = contents.views
    headers = []
    for view in views:
        headers.append(read_header(view.path))
    sizes = []
    for header in headers:
        sizes.append((header.width, header.height))
    scaling = check_sizes(views, sizes, reduced=contents.reduced)
    cameras = _cameras(views).resized(torch.tensor(sizes))
    train, test = contents.split or _default_split(len(views))
    used = _masks(data, views, [view.mask for view in views], USED)
    sky = _masks(data, views, [view.sky_mask for view in views], SKY)
    return ParsedScene(
        name=name_of(data),
        paths=tuple(view.path for view in views),
        cameras=cameras.scaled(downscale) if downscale != 1 else cameras,
        train=train,
        test=test,
        points=_tensor(contents.points),
        seen=_tensor(contents.seen),
        depths=_of_all([view.depths for view in views]),
        exposure=_of_all([view.exposure for view in views]),
        masks=used.masks,
        sky_masks=sky.masks,
        alpha=_is_transparent(views, headers),
        up=contents.up,
        north=contents.north,
        notes=(*contents.notes, *scaling, *used.notes, *sky.notes),
    )


def _cameras(views: Sequence[View]) -> Cameras:
    """Cameras at the size that the capture states."""
    return Cameras(
        pose=torch.from_numpy(np.stack([view.pose for view in views])),
        focal=torch.tensor([view.focal for view in views], dtype=torch.float64),
        centre=torch.tensor([view.centre for view in views], dtype=torch.float64),
        size=torch.tensor([view.size for view in views], dtype=torch.int64),
        distortion=torch.tensor([view.distortion for view in views], dtype=torch.float64),
        lens=torch.tensor([view.lens for view in views], dtype=torch.int64),
    )


def _tensor(array: NDArray[np.float64] | NDArray[np.int64] | None) -> Tensor | None:
    if array is None or not len(array):
        return None
    return torch.from_numpy(array)


def _of_all(values: Sequence[object]) -> Tensor | None:
    """Numbers that every view has, float64; None where one has none."""
    if any(value is None for value in values):
        return None
    return torch.tensor(values, dtype=torch.float64)


def _default_split(count: int) -> tuple[Tensor, Tensor]:
    """Every 8th is for testing, the first one too; but a single view is for training: there must be something to
    learn.
    """
    held = []
    for k in range(count):
        held.append(k % _TEST_EVERY == 0 and count > 1)
    parts = []
    for each in held:
        parts.append(not each)
    return index_tensor(parts), index_tensor(held)


def _is_transparent(views: Sequence[View], headers: Sequence[ImageHeader]) -> bool:
    """True where one of a few images with an alpha channel is not opaque everywhere."""
    clear = []
    for view, header in zip(views, headers, strict=True):
        if header.alpha:
            clear.append(view.path)
    step = -(-len(clear) // _MAX_DECODED_ALPHA) or 1
    return any(map(has_transparency, clear[::step]))


def without_copies(contents: CaptureContents) -> CaptureContents:
    """The contents without views whose camera and pixels are those of another; one that is for testing stays
    before one for training, else that of the shorter name.
    """
    views = contents.views
    if contents.split is None:
        held = set()
    else:
        held = set(contents.split[1].tolist())
    copies = {}
    for group in _same_views(views):
        order = sorted(group, key=lambda k: (k not in held, len(views[k].name), views[k].name))
        copies.update(dict.fromkeys(order[1:], order[0]))
    if not copies:
        return contents
    kept = []
    for k in range(len(views)):
        if k not in copies:
            kept.append(k)
    place = torch.full((len(views),), -1, dtype=torch.int64)
    place[kept] = torch.arange(len(kept))
    split = None
    if contents.split is not None:
        train, test = (place[part][place[part] >= 0] for part in contents.split)
        split = train, test
    seen = contents.seen
    if seen is not None:
        seen = np.stack([place.numpy()[seen[:, 0]], seen[:, 1]], 1)
        seen = seen[seen[:, 0] >= 0]
    names = []
    for copy, original in sorted(copies.items()):
        names.append(f"{views[copy].name}, which is {views[original].name}")
    return replace(
        contents,
        views=[views[k] for k in kept],
        split=split,
        seen=seen,
        notes=(*contents.notes, left_out_note(COPIES, names)),
    )


def _same_views(views: Sequence[View]) -> list[list[int]]:
    """Groups of views of one camera and one picture."""
    group = {}
    for k in range(len(views)):
        group[k] = [k]
    digests: dict[Path, str] = {}
    for a, b in _near_pairs(np.stack([view.pose for view in views])):
        if group[a] is not group[b] and _same_picture(views[a].path, views[b].path, digests):
            group[a] += group[b]
            for k in group[b]:
                group[k] = group[a]
    unique = {}
    for members in group.values():
        unique[id(members)] = members
    found: list[list[int]] = []
    for members in unique.values():
        if len(members) > 1:
            found.append(members)
    return found


def _near_pairs(pose: NDArray[np.float64]) -> Iterator[tuple[int, int]]:
    """Pairs of poses [V 3 4] that may be one."""
    # Sorted along the axis of the largest extent, so that few others need to be looked at.
    centre = pose[:, :, 3]
    extent = np.ptp(centre, axis=0)
    axis = int(extent.argmax())
    limit = _MAX_TWIN_OFFSET * extent[axis]
    order = np.argsort(centre[:, axis], kind="stable")
    sorted_centre = centre[order]
    last = np.searchsorted(sorted_centre[:, axis], sorted_centre[:, axis] + limit, side="right")
    for at, a in enumerate(order.tolist()):
        others = order[at + 1 : last[at]]
        near = np.abs(centre[others] - centre[a]).max(1, initial=0) <= limit
        turned = np.abs(pose[others, :, :3] - pose[a, :, :3]).max((1, 2), initial=0) <= _MAX_TWIN_OFFSET
        for b in others[near & turned].tolist():
            yield a, b


def _same_picture(a: Path, b: Path, digests: dict[Path, str]) -> bool:
    """True for equal files, and for equal pixels in another encoding; hashes of those are kept in `digests`."""
    try:
        if os.path.getsize(a) == os.path.getsize(b) and filecmp.cmp(a, b, shallow=False):
            return True
        if read_header(a)[:2] != read_header(b)[:2]:
            return False
        for path in (a, b):
            if path not in digests:
                digests[path] = pixel_digest(path)
    except (OSError, DataError):  # training names what cannot be read
        return False
    return digests[a] == digests[b]


def check_sizes(views: Sequence[View], sizes: Sequence[tuple[int, int]], *, reduced: bool) -> list[str]:
    """A note where images are reduced against what their cameras say; `sizes` are those of the files.

    Raises DataError naming the images that differ, unless all are reduced by one factor, or where `reduced`, by
    any one that keeps their shape. Reducing rounds a side to a whole pixel.
    """
    parts = []
    for view in views:
        parts.append(view.size)
    stated = np.array(parts, dtype=np.float64)
    found = np.array(sizes, dtype=np.float64)
    exact = (stated == found).all(1)
    if exact.all():
        return []
    if reduced:
        fits = np.abs(stated[:, 0] * found[:, 1] - stated[:, 1] * found[:, 0]) <= stated.sum(1)
    else:
        fits = _of_one_scale(stated, found)
    if not fits.all():
        raise _wrong_sizes(views, sizes, np.flatnonzero(~fits).tolist())
    first = int(np.flatnonzero(~exact)[0])
    (width, height) = views[first].size
    factor = width / sizes[first][0]
    pixels = f"{sizes[first][0]}x{sizes[first][1]}"
    return [
        f"images have {pixels} pixels, their cameras {width}x{height}: cameras are scaled by 1/{factor:.4g}"
    ]


def _of_one_scale(stated: NDArray[np.float64], found: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Images that are scaled by the factor that fits most of them; a factor of 1 must fit to the pixel."""
    # Factors that give each image its size within a pixel.
    low = ((found - 1) / stated).max(1)
    high = ((found + 1) / stated).min(1)
    # The most intervals overlap where one of them begins.
    usable = low <= high
    begins = np.sort(low[usable])
    count = np.searchsorted(begins, begins, side="right") - np.searchsorted(np.sort(high[usable]), begins)
    exact: NDArray[np.bool_] = (stated == found).all(1)
    if not len(begins) or exact.sum() >= count.max():
        return exact
    factor = begins[count.argmax()]
    fits: NDArray[np.bool_] = (low <= factor) & (factor <= high)
    # Images that are a pixel off at their own size are cropped, not reduced.
    if (low[fits].max() <= 1) and (high[fits].min() >= 1):
        return exact
    return fits


def _wrong_sizes(views: Sequence[View], sizes: Sequence[tuple[int, int]], wrong: Sequence[int]) -> DataError:
    view = views[wrong[0]]
    width, height = sizes[wrong[0]]
    if len(wrong) > 1:
        more = f" and {len(wrong) - 1} more of {len(views)} likewise"
    else:
        more = ""
    return DataError(
        f"{view.path}: {width}x{height} pixels, but its camera has {view.size[0]}x{view.size[1]}{more}; cameras are scaled "
        "where all images are reduced by one factor: restore these (were they resized, rotated or cropped?) or calibrate again"
    )


def _masks(data: Path, views: Sequence[View], named: Sequence[Path | None], kind: MaskKind) -> FoundMasks:
    """Masks of the views: those that the capture names, or where it names none, those that lie beside the
    images.
    """
    if not any(named):
        return masks_beside(data, [view.path for view in views], kind)
    missing = []
    for path in named:
        if path is not None and not path.is_file():
            missing.append(path)
    if missing:
        told = f"{len(missing)} masks are missing, the first is {missing[0]}"
        raise DataError(f"{data}: {told}; copy them there or unname them")
    bare = []
    for view, path in zip(views, named, strict=True):
        if path is None:
            bare.append(view.name)
    notes = []
    if bare:
        count = f"{len(bare)} of {len(views)} images"
        notes.append(f"{kind.folder}: {count} name none and are used whole, like {bare[0]}")
    return FoundMasks(tuple(named), notes)
