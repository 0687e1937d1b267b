"""A parsed scene: where its images lie, how they were taken, what is for training, which sparse points its
views see.

Reconstructions say which views see a point. Where one does not, points are projected and only the nearest
layer counts: in each tile of an image those no farther than MAX_LAYER_RATIO times the nearest. It takes the wall before
the street behind it.

Exposure is measured where several views see the same point. A sighting's brightness is b = g(view) + a(point)
in the logarithm of sRGB; least squares gives both, twice: the second time without outliers (highlights,
points that something hides).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ..rendering.cameras import Cameras, project
from ..rendering.local_frame import local_origin
from ..rendering.north import North
from ..types import Origin


@dataclass(frozen=True, kw_only=True)
class ParsedScene:
    """V views of one place. Cameras are at the size that images are used at (after `downscale`)."""

    name: str
    paths: tuple[Path, ...]
    """One image a view, as delivered; loading resizes it to the camera's size."""
    cameras: Cameras
    train: Annotated[Tensor, "T"]
    """int64 indices of the training views."""
    test: Annotated[Tensor, "U"]
    """int64 indices of the held-out views (every 8th by name, unless the capture says)."""
    points: Annotated[Tensor, "P 3"] | None = None
    """Sparse points of the reconstruction, float64 world, for bounds."""
    depths: Annotated[Tensor, "V 2"] | None = None
    """Nearest and farthest depth along each view's axis, where the capture says."""
    seen: Annotated[Tensor, "O 2"] | None = None
    """int64 pairs of a view and a point that the reconstruction found in it, where the capture says."""
    exposure: Annotated[Tensor, "V"] | None = None
    """Exposure of each view, where the capture says: light is in proportion to it. float64, above 0."""
    masks: tuple[Path | None, ...] = ()
    """A mask of each view, black where pixels are left out; None = all are used. Empty where the capture has
    none.
    """
    sky_masks: tuple[Path | None, ...] = ()
    """The same of sky, which is white."""
    alpha: bool = False
    """Images carry transparency."""
    notes: tuple[str, ...] = ()
    """Decisions taken while the capture was read, a line each, for the user."""
    up: tuple[float, float, float] | None = None
    """Direction up of length 1, where the capture says it or cameras that are held alike look down; None = as they are
    held level.
    """
    north: North | None = None
    """Direction of north, if the capture says it or the positions of its photographs tell it."""
    origin: Origin = (0.0, 0.0, 0.0)
    """Subtracted from the capture's coordinates, along its own axes: cameras and points are relative to
    it.
    """


def in_local_frame(scene: ParsedScene) -> ParsedScene:
    """The scene about its `local_origin`: projected metres (UTM) and Earth-centred ones are beyond
    float32.
    """
    further = local_origin(scene.cameras.pose[:, :, 3], scene.points)
    return at_origin(
        scene, (scene.origin[0] + further[0], scene.origin[1] + further[1], scene.origin[2] + further[2])
    )


def at_origin(scene: ParsedScene, origin: Origin) -> ParsedScene:
    """The same scene relative to another origin, such as that of a run which goes on."""
    if origin == scene.origin:
        return scene
    move = torch.tensor(scene.origin, dtype=torch.float64) - torch.tensor(origin, dtype=torch.float64)
    points = None if scene.points is None else scene.points + move
    return replace(scene, cameras=scene.cameras.shifted(move.tolist()), points=points, origin=origin)


TILES = 16
"""Tiles across the longer side of an image: by eye."""
MAX_LAYER_RATIO = 1.15
"""Points up to so many times the nearest distance in their tile are seen: a wall that is seen at a slant is that
deep in a tile (by eye).
"""
MAX_PROJECTIONS = 1 << 26
"""Points are thinned so that no more projections than these are made: some ten seconds (by eye)."""
PAIRS_AT_ONCE = 1 << 20
"""Pairs that are projected at once: each takes about 250 bytes on the way, all of them 256 MiB."""


class Sightings(NamedTuple):
    """O sightings of points by training views, in the order of the views; float64."""

    view: Annotated[Tensor, "O"]
    """int64 index of the view in the scene."""
    point: Annotated[Tensor, "O 3"]
    """In the world."""
    pixel: Annotated[Tensor, "O 2"]
    """x, y, inside the image."""
    distance: Annotated[Tensor, "O"]
    """World distance from the camera, along the ray."""


def find_sightings(scene: ParsedScene) -> Sightings | None:
    """The sightings of the training views; None without sparse points or where none is in any view."""
    if scene.points is None or not len(scene.points):
        return None
    # Who saw what, where the reconstruction says so; else what each view may see.
    if scene.seen is not None:
        kept = scene.seen[torch.isin(scene.seen[:, 0], scene.train)]
        kept = kept[kept[:, 0].argsort(stable=True)]
        parts = []
        for view, point in torch.split(kept.T, PAIRS_AT_ONCE, 1):
            parts.append(_sighted(scene.cameras, view, scene.points[point]))
    else:
        points = scene.points[:: max(1, len(scene.points) * len(scene.train) // MAX_PROJECTIONS)]
        parts = []
        for view in scene.train.tolist():
            parts.append(_nearest(scene.cameras, view, points))
    sightings = Sightings(*(torch.cat(columns) for columns in zip(*parts, strict=True)))
    return sightings if len(sightings.view) else None


def tile_of(
    cameras: Cameras, view: Annotated[Tensor, "O"], pixel: Annotated[Tensor, "O 2"]
) -> Annotated[Tensor, "O 2"]:
    """Column and row of the tile that a pixel lies in: TILES along the longer side, square."""
    size = cameras.size[view]
    side = size.amax(-1, keepdim=True).double() / TILES
    return torch.minimum((pixel / side).long(), ((size.double() / side).ceil().long() - 1)).clamp_min(0)


def _sighted(cameras: Cameras, view: Tensor, points: Tensor) -> Sightings:
    """Those of the pairs whose point falls into its image."""
    # In front of the camera and inside of the image.
    pixel, depth = project(cameras, view, points)
    size = cameras.size[view].to(pixel)
    inside = (depth > 0) & ((pixel >= 0) & (pixel < size)).all(1)  # NaN is never inside
    distance = (points - cameras.pose[view, :, 3]).norm(dim=-1)
    return Sightings(view[inside], points[inside], pixel[inside], distance[inside])


def _nearest(cameras: Cameras, view: int, points: Tensor) -> Sightings:
    """The nearest layer of all points in a view."""
    # The least distance in each tile, and what is not much farther away.
    sightings = _sighted(cameras, torch.full((len(points),), view), points)
    column, row = tile_of(cameras, sightings.view, sightings.pixel).unbind(1)
    tile = row * TILES + column
    least = sightings.distance.new_full((TILES * TILES,), torch.inf).scatter_reduce(
        0, tile, sightings.distance, "amin"
    )
    front = sightings.distance <= MAX_LAYER_RATIO * least[tile]
    return Sightings(*(x[front] for x in sightings))


GAMMA = 1 / 2.2
"""Light is in proportion to exposure, sRGB to about this power of light."""
MIN_EXPOSURE_SPREAD = 0.08
"""Standard deviation of the views' brightness, in the logarithm of sRGB, above which exposures differ: by eye."""
MIN_SIGHTINGS = 16
"""Sightings of a view that its exposure is measured from, at least: by eye."""
MAX_EXPOSURE_PAIRS = 1 << 19
"""Pairs of a view and a point that exposures are measured from, about: half a second (by eye)."""
MIN_LEVEL = 0.03
"""sRGB below which a pixel says nothing of exposure: noise (by eye)."""
MAX_LEVEL = 0.97
"""sRGB above which it says nothing: clipped (by eye)."""


def exposures_differ(exposure: Annotated[Tensor, "V"] | None) -> bool:
    """True where views were taken so differently that each needs a factor of its own; not where nothing is
    known.
    """
    return (
        exposure is not None
        and len(exposure) > 1
        and GAMMA * float(exposure.log().std()) > MIN_EXPOSURE_SPREAD
    )


def with_exposure(scene: ParsedScene, image: Callable[[int], Annotated[Tensor, "H W 3"]]) -> ParsedScene:
    """The scene with the exposure of its views, measured where the capture does not say it; unchanged without
    points.

    `image(view)` is a training view, in [0, 1]. Held-out views take the mean of their neighbours in the order
    of names, as far as training views resemble theirs: pictures taken one after the other do, those of a
    collection do not.
    """
    if scene.exposure is not None or len(scene.train) < 2:
        return scene
    # g of the training views; their mean is what nobody knows, and 0.
    sightings = find_sightings(sparser(scene))
    gain = None
    if sightings is not None:
        gain = _gains(sightings, scene, image)
    if gain is None:
        return scene
    train = scene.train.sort().values
    gain[train] -= gain[train].mean()
    # Correlation of neighbours, from the squares of their differences: 0 where the order says nothing.
    alike = (1 - gain[train].diff().square().mean() / (2 * gain[train].var()).clamp_min(1e-12)).clamp(0, 1)
    # A held-out view is as bright as the ones before and after, as far as those resemble each other.
    after = torch.searchsorted(train, scene.test)
    before = train[(after - 1).clamp_min(0)]
    after = train[after.clamp_max(len(train) - 1)]
    gain[scene.test] = alike * (gain[before] + gain[after]) / 2
    return replace(scene, exposure=(gain / GAMMA).exp())


def sparser(scene: ParsedScene) -> ParsedScene:
    """The scene with every n-th point, so that about MAX_EXPOSURE_PAIRS pairs are left."""
    if scene.points is None:
        return scene
    step = (
        -(
            -(len(scene.points) * len(scene.train) if scene.seen is None else len(scene.seen))
            // MAX_EXPOSURE_PAIRS
        )
        or 1
    )
    seen = scene.seen
    if seen is not None:
        seen = seen[seen[:, 1] % step == 0] // torch.tensor([1, step])
    return replace(scene, points=scene.points[::step], seen=seen)


def _gains(
    sightings: Sightings, scene: ParsedScene, image: Callable[[int], Annotated[Tensor, "H W 3"]]
) -> Annotated[Tensor, "V"] | None:
    """g of the training views, 0 of those that too few sightings tell of; None where none is left.
    float64.
    """
    # Brightness b of each sighting, where its pixel is neither dark nor clipped.
    rgb = torch.full((len(sightings.view), 3), torch.nan, dtype=torch.float64)
    for view in scene.train.tolist():
        at = (sightings.view == view).nonzero()[:, 0]
        x, y = sightings.pixel[at].long().unbind(1)
        rgb[at] = image(view)[y, x].double()
    kept = ((rgb >= MIN_LEVEL) & (rgb <= MAX_LEVEL)).all(1)
    view = sightings.view[kept]
    bright = rgb[kept].log().mean(1)
    point = torch.unique(sightings.point[kept], dim=0, return_inverse=True)[1]
    # Twice: the second time without what the first fit calls outliers. Points that one view saw say nothing.
    gain = None
    for _ in range(2):
        known = torch.bincount(view, minlength=len(scene.paths))[view] >= MIN_SIGHTINGS
        shared = torch.bincount(point)[point] >= 2
        view = view[known & shared]
        point = point[known & shared]
        bright = bright[known & shared]
        if not len(view):
            break
        gain, error = _solve(view, point, bright, len(scene.paths))
        inlier = (
            error.abs() <= 3 * error.abs().median() / 0.6745
        )  # of a normal error three standard deviations
        view = view[inlier]
        point = point[inlier]
        bright = bright[inlier]
    return gain


def _solve(
    view: Annotated[Tensor, "O"], point: Annotated[Tensor, "O"], bright: Annotated[Tensor, "O"], views: int
) -> tuple[Annotated[Tensor, "V"], Annotated[Tensor, "O"]]:
    """g of the views and what it leaves of each sighting, by conjugate gradients on the equations without the
    points.
    """
    seen = torch.bincount(point).clamp_min(1).double()

    def centred(values: Tensor) -> Tensor:
        """Less their mean at each point."""
        return values - (values.new_zeros(len(seen)).index_add(0, point, values) / seen)[point]

    def gathered(values: Tensor) -> Tensor:
        return values.new_zeros(views).index_add(0, view, values)

    # With the mean over each point's sightings taken out of g and b alike, a drops out; conjugate gradients
    # on what is left.
    gain = bright.new_zeros(views)
    residual = gathered(centred(bright))
    direction = residual
    power = float(residual @ residual)
    limit = 1e-12 * power
    for _ in range(min(views, 200)):
        if power <= limit or not math.isfinite(power):
            break
        moved = gathered(centred(direction[view]))
        length = power / float(direction @ moved)
        gain = gain + length * direction
        residual = residual - length * moved
        last = power
        power = float(residual @ residual)
        direction = residual + power / last * direction
    return gain, centred(bright - gain[view])
