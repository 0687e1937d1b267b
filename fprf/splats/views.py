"""Cameras for a capture that came without any: around an object, or inside what surrounds them (rooms,
streets, gardens).

Where photographs were taken from tells the size of the Gaussians: training makes them about as large as
pixels, so that their size grows with the distance from the cameras. Where one place explains the sizes
plainly better than none, cameras stand around it and look at what lies about it, whatever points up.

Objects are seen from rings at several heights and distances. A capture that was made from within is called a
room here (`is_room`): cameras stand in free places and look around. There most directions end on something,
as they do in a hollow object, but what lies far out is made of larger Gaussians, or reaches far beyond the
rest. Either way the better views are kept: filled, and with nothing close before the camera.

Sizes of Gaussians are logarithms of standard deviations, the mean of the two largest axes. Numbers whose
docstring names no measurement were chosen by eye.
"""

import math
from collections.abc import Callable
from dataclasses import fields, replace
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ..errors import DataError
from ..rendering.cameras import Cameras
from ..rendering.paths import look_at, pinhole
from .config import LookConfig
from .drawing import clip_distance, draw
from .gaussians import MAX_BULK_DISTANCE, Gaussians, bulk_of
from .ground import USUAL_UP
from .pinholes import camera_of

# When a capture counts as a room.

MIN_ROOM_SIZE_RATIO = 2.5
"""Size of the Gaussians of the outer fifth over that of the inner half, from which on a capture is a room.
Eight objects have 0.8 to 1.8, four scenes from within 2.7 to 4.1 (capture_kinds.json).
"""
MIN_ROOM_TAIL_RATIO = 6.0
"""Distance of the outermost thousandth from the middle over the median distance, from which on a capture is a
room. Eight objects have 1.8 to 3.7, four scenes from within 23 to 50 (capture_kinds.json).
"""
_MIN_ROOM_OPACITY = 0.3
"""Opacity from which on Gaussians count in these two."""
_MIN_ROOM_GAUSSIANS = 100
"""Gaussians below which neither says anything, so that the capture is an object."""

# Where the photographs were taken.

_MAX_DEVIATION_SHARE = 0.8
"""Median deviation of size less logarithm of the distance from the place that explains sizes best, as a share
of that of the sizes alone, up to which photographs were taken about that place. Eight objects, photographed
from all around, have 0.89 or more; four scenes from within 0.79 to 0.92 (capture_kinds.json).
"""
_MAX_ROOM_DEVIATION_SHARE = 0.9
"""The same of a room, whose cameras stand within in any case."""
_MIN_SOLID_OPACITY = 0.2
"""Opacity from which on Gaussians are asked."""
_MIN_SOLID_GAUSSIANS = 100
"""Gaussians below which no place is looked for."""
_MAX_ASKED_GAUSSIANS = 1500
"""Gaussians that are asked, about: bounds the time, as each is compared with thousands of places."""
_PLACES_AT_ONCE = 512
"""Places that are compared with all of these at a time: bounds the memory."""


class _PlaceGrid(NamedTuple):
    """Places that are tried about another one."""

    per_axis: int
    reach: float
    """Distance of the last one along an axis, in half spans of the capture."""


_COARSE_GRID = _PlaceGrid(per_axis=17, reach=3.0)
"""Places all over the capture and as far again on either side."""
_FINE_GRID = _PlaceGrid(per_axis=9, reach=0.375)
"""Places about the best one of these: up to its neighbours, which lie 0.375 half spans apart."""

# Views from about that place; lengths in the median distance of what is seen from there.

_SIDE_OFFSETS = (0.08, 0.2)
"""Distances of cameras to its sides."""
_SIDES = 4
"""Cameras to its sides at each of these."""
_BACK_OFFSETS = (0.0, 0.25)
"""Distances of cameras behind it, against the mean direction of what is seen."""
_TARGETS = 12
"""Directions that they look in."""
_MAX_TARGET_QUANTILE = 0.8
"""Share of the Gaussians, the nearer ones, that directions are taken of: none is into the far surroundings."""
_PLACE_FOV_DEGREES = 55.0
"""Vertical angle of these views: narrower than a room's, as what photographs show lies ahead."""
_MAX_CLOSE_DISTANCE = 0.15
"""Distance within which things are in the way."""
_MAX_SIZE_EXCESS = 3.0
"""Logarithm of the size in angle, relative to the median one as seen from the place, at which a Gaussian is
as bad as none: e^3 = 20 times as wide as usual.
"""
_MIN_SHOWN_DISTANCE = 0.05
"""Distance that nearer Gaussians are taken to have when those that show most are chosen."""
_RANK_COST = 0.05
"""Worth by which the second-best view of a direction must exceed the best of another, in filled views."""

# Views from free places within a room.

_CELLS_PER_AXIS = 24
"""Cells of the grid over the capture's box in which free places are looked for."""
_MAX_FREE_SHARE = 0.02
"""Opacity of a free cell, as a share of the mean of all occupied ones."""
_MAX_EYE_HEIGHT = 0.67
"""Share of the box's height in which a camera stands: nobody holds one in the upper third."""
_MAX_PLACES = 12
"""Places that are tried."""
_DIRECTIONS_PER_PLACE = 8
"""Directions looked in at each."""
_ROOM_DROP = 0.1
"""Slope by which these point down."""
_ROOM_FOV_DEGREES = 70.0
"""Vertical angle of these views: wide, as in rooms one stands close to things."""
_MIN_ENCLOSED_SHARE = 0.8
"""Share of the views from a place that something fills, from which on the place is within a room."""
_ENCLOSED_QUANTILE = 0.75
"""Share of the places that may be less enclosed, in a capture that is looked at from within."""
_ROOM_CLOSE_SHARE = 0.05
"""Distance within which things are in the way, as a share of the spread of the Gaussians."""

# Views around an object.

_RING_ELEVATIONS_DEGREES = (-8.0, 12.0, 32.0, 55.0)
"""Heights of the rings above the middle, as angles."""
_RING_DISTANCES = (1.2, 1.7)
"""Distances of the rings; at 1 the object just fits into the view."""
_RING_FOV_DEGREES = 45.0
"""Vertical angle of these views."""
_MIN_RING_VIEWS = 4
"""Candidates of a ring, at least."""
_RING_CANDIDATES = 1.6
"""Candidates for each view that is wanted."""
_RING_TURN = 0.38
"""Turn of a ring against the one before, in the angle between cameras: about the golden section, so that none
stands behind another.
"""
_OBJECT_QUANTILE = 0.95
"""Share of the opacity that lies within what has to fit into the view."""
_RING_CLOSE_SHARE = 0.3
"""Distance within which things are in the way, as a share of that to the middle."""

# What any view is worth.

_BOX_QUANTILES = (0.02, 0.98)
"""Ends of the box that most opacity lies in, along each axis."""
_PICTURE_REDUCTION = 8
"""Candidates are judged on pictures reduced by this."""
_MAX_JUDGED_GAUSSIANS = 30_000
"""Gaussians that these pictures are drawn of: those that show most."""
_MIN_FILLED_OPACITY = 0.5
"""Opacity from which on a pixel is taken to show what lies at its depth."""
_CLOSE_COST = 3.0
"""Cost of a pixel with something close before the camera, in filled ones."""


@torch.inference_mode()
def find_views(
    gaussians: Gaussians,
    look: LookConfig,
    *,
    antialiased: bool = False,
    camera: Cameras | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Cameras:
    """At most as many views as `look` asks for, the nearer ones around an object first.

    Where the `camera` is known that the capture was made from, it is the first view, and the others stand
    about it. Gaussians very far from the others play no part. `progress` hears how many candidates of a search
    are judged. Raises DataError where nothing can be seen from anywhere.
    """
    size = look.size
    inside = look.inside
    up = torch.tensor(look.up or USUAL_UP).double()
    near = torch.from_numpy(bulk_of(gaussians.means.numpy()).apart <= MAX_BULK_DISTANCE)
    if not bool(near.all()):
        gaussians = gaussians.select(near)
    search = _ViewSearch(gaussians, size, up / up.norm(), antialiased, progress)
    room = is_room(gaussians) if inside is None else inside
    # About where sizes say that photographs were taken; else within what surrounds a free place; else around
    # the object.
    chosen = None
    others = look.views if camera is None else look.views - 1
    if inside is not False:
        place = None
        if camera is not None:
            place = camera.pose[0, :, 3].double()
        if room:
            max_share = _MAX_ROOM_DEVIATION_SHARE
        else:
            max_share = _MAX_DEVIATION_SHARE
        chosen = search.around_place(others, max_share, place)
    if chosen is None:
        candidates = None
        if room:
            # Where the user says that it is one, any place will do.
            candidates = search.from_free_places(0.0 if inside else _MIN_ENCLOSED_SHARE)
        cameras, worth = candidates or search.rings(others)
        # The best ones, in the order in which they were tried: the nearer ones first.
        best = worth.topk(min(others, len(worth))).indices.sort().values
        chosen = cameras.select(best[worth[best] > 0])
    if camera is not None:
        return _joined(_fitted(camera, size), chosen)
    if not len(chosen):
        raise DataError(
            "no view shows anything of the capture; give the axis that points up (--up), or clean the file"
        )
    return chosen


def is_room(gaussians: Gaussians) -> bool:
    """True for a capture that was made from within: what lies far out is coarser than the rest, or reaches
    far beyond it.
    """
    seen = gaussians.opacities > _MIN_ROOM_OPACITY
    if int(seen.sum()) < _MIN_ROOM_GAUSSIANS:
        return False
    means = gaussians.means[seen]
    size = gaussians.log_scales[seen].topk(2, dim=1).values.mean(1)
    away = torch.linalg.vector_norm(means - means.median(0).values, dim=1)
    ordered = away.sort().values
    last = len(ordered) - 1
    half = ordered[round(0.5 * last)]
    outer = ordered[round(0.8 * last)]
    tail = ordered[round(0.999 * last)]
    if half == 0:
        return False
    ratio = (size[away > outer].median() - size[away < half].median()).exp()
    return bool(ratio >= MIN_ROOM_SIZE_RATIO) or bool(tail >= MIN_ROOM_TAIL_RATIO * half)


def _fitted(camera: Cameras, size: tuple[int, int]) -> Cameras:
    """The camera at a size, so that all of its picture lies within."""
    share = float((torch.tensor(size) / camera.size[0]).min())
    centre = torch.tensor(size) / 2 + share * (camera.centre - camera.size / 2)
    return replace(camera.resized(torch.tensor([size])), focal=camera.focal * share, centre=centre)


def _joined(first: Cameras, others: Cameras) -> Cameras:
    """Both, one after the other."""
    parts = {}
    for field in fields(Cameras):
        parts[field.name] = torch.cat([getattr(first, field.name), getattr(others, field.name)])
    return Cameras(**parts)


class _ViewSearch:
    """Candidates for views of `size` (width, height) of a capture, and what they are worth; `up` has length
    1, float64.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        size: tuple[int, int],
        up: Annotated[Tensor, "3"],
        antialiased: bool,
        progress: Callable[[int, int], None],
    ) -> None:
        self.gaussians = gaussians
        self.size = size
        self.up = up
        self.antialiased = antialiased
        self.progress = progress
        opacity = gaussians.opacities
        ends = []
        for axis in gaussians.means.T:
            ends.append(_quantiles(axis, opacity, _BOX_QUANTILES))
        self.ends = torch.stack(ends).double()
        """Lowest and highest corner [3 2] of the box that most opacity lies in."""
        self.coarse = gaussians
        """Gaussians that show most: candidates are judged on pictures of these."""
        if len(gaussians) > _MAX_JUDGED_GAUSSIANS:
            area = gaussians.log_scales.topk(2, dim=1).values.sum(1) + opacity.log()
            self.coarse = gaussians.select(area.topk(_MAX_JUDGED_GAUSSIANS).indices)

    def looking(
        self, eye: Annotated[Tensor, "V 3"], target: Annotated[Tensor, "V 3"], fov_degrees: float
    ) -> Cameras:
        """Cameras at `eye` that look at `target`, with a vertical angle."""
        width, height = self.size
        return pinhole(look_at(eye, target, self.up), width=width, height=height, fov=fov_degrees)

    def around_place(
        self, count: int, max_share: float, known: Annotated[Tensor, "3"] | None
    ) -> Cameras | None:
        """Views from about where the photographs were taken, if `known`; None where sizes tell that place
        less well than `max_share` (`_MAX_DEVIATION_SHARE`).
        """
        # The place from which the sizes of some solid Gaussians are most alike in angle, and that usual
        # angle.
        gaussians = self.gaussians
        solid = (gaussians.opacities > _MIN_SOLID_OPACITY).nonzero()[:, 0]
        if len(solid) < _MIN_SOLID_GAUSSIANS:
            return None
        asked = solid[:: max(1, len(solid) // _MAX_ASKED_GAUSSIANS)]
        points = gaussians.means.double()
        sizes = gaussians.log_scales.double().topk(2, dim=1).values.mean(1)
        if known is None:
            place, share = _size_centre(points[asked], sizes[asked], self.ends)
            if share > max_share:
                return None
        else:
            place = known
        away = torch.linalg.vector_norm(points[asked] - place, dim=1)
        middle = float(away.median())
        usual = float((sizes[asked] - away.log()).median())
        # Directions of what is not in the far surroundings.
        nearer = away < away.quantile(_MAX_TARGET_QUANTILE)
        ahead = torch.nn.functional.normalize(points[asked][nearer] - place, dim=1)
        if not len(ahead):  # all are in one place
            return None
        mean = torch.nn.functional.normalize(ahead.mean(0), dim=0)
        targets = ahead[_spread_out(ahead, mean)]
        # Cameras at that place, a little behind it and to the sides, each looking in all of these directions.
        ring = _around(self.up, _SIDES)
        back = torch.tensor(_BACK_OFFSETS, dtype=torch.float64)[:, None] * -mean
        offsets = middle * torch.cat([back, *(offset * ring for offset in _SIDE_OFFSETS)])
        eye = (place + offsets).repeat_interleave(_TARGETS, 0)
        target = (place + middle * targets).repeat(len(offsets), 1)
        cameras = self.looking(eye, target, _PLACE_FOV_DEGREES)
        worth = self.judged_from(place, cameras, sizes, middle, usual)
        # The best of each direction before the second of any, as long as they are about as good.
        rank = worth.view(len(offsets), _TARGETS).argsort(0, descending=True).argsort(0).flatten()
        best = (worth - _RANK_COST * rank).topk(min(count, len(worth))).indices
        return cameras.select(best.sort().values)

    def judged_from(
        self,
        place: Annotated[Tensor, "3"],
        cameras: Cameras,
        sizes: Annotated[Tensor, "N"],
        middle: float,
        usual: float,
    ) -> Annotated[Tensor, "V"]:
        """Worth of views about a place: how much of a small picture is filled, less what is close or looks
        blurred.

        `middle` is the median distance of Gaussians from the place, `usual` the logarithm of their size in
        angle.
        """
        # Pictures of those that show most there: opacity times area in the picture.
        gaussians = self.gaussians
        points = gaussians.means.double()
        distance = torch.linalg.vector_norm(points - place, dim=1).clamp_min(_MIN_SHOWN_DISTANCE * middle)
        shows = 2 * (sizes - distance.log()) + gaussians.opacities.log()
        shown = shows.topk(min(_MAX_JUDGED_GAUSSIANS, len(shows))).indices
        coarse = gaussians.select(shown)
        points = points[shown].float()
        sizes = sizes[shown].float()
        small = cameras.scaled(_PICTURE_REDUCTION)
        worth = torch.zeros(len(cameras))
        clip = clip_distance(gaussians)
        for view in range(len(small)):
            self.progress(view, len(small))
            eye = cameras.pose[view, :, 3].float()
            apart = torch.linalg.vector_norm(points - eye, dim=1).clamp_min(1e-9)
            blurred = ((sizes - apart.log() - usual) / _MAX_SIZE_EXCESS).clamp(0, 1)[:, None]
            drawn = draw(coarse, camera_of(small, view, clip), antialiased=self.antialiased, features=blurred)
            close = (drawn.opacity > _MIN_FILLED_OPACITY) & (drawn.depth < _MAX_CLOSE_DISTANCE * middle)
            worth[view] = drawn.opacity.mean() - _CLOSE_COST * close.float().mean() - drawn.features.mean()
        return worth

    def from_free_places(self, min_enclosed: float) -> tuple[Cameras, Annotated[Tensor, "V"]] | None:
        """Views in all directions from free places that are enclosed, with their worth; None where few
        are.
        """
        free = self.free_places()
        if not len(free):
            return None
        places = _farthest_apart(free, self.ends.mean(1), _MAX_PLACES)
        eye = places.repeat_interleave(_DIRECTIONS_PER_PLACE, 0)
        ahead = _around(self.up, _DIRECTIONS_PER_PLACE) - _ROOM_DROP * self.up
        cameras = self.looking(eye, eye + ahead.repeat(len(places), 1), _ROOM_FOV_DEGREES)
        spread = float(self.coarse.means.double().var(0, correction=0).sum().sqrt())
        close = torch.full((len(cameras),), _ROOM_CLOSE_SHARE * spread)
        # Of the directions half overlap enough to tell: a place is enclosed where something fills the view in
        # most of them.
        every_other = torch.arange(0, len(cameras), 2)
        _, filled = self.judged(cameras.select(every_other), close[every_other])
        enclosed = filled.view(len(places), _DIRECTIONS_PER_PLACE // 2).mean(1)
        if float(enclosed.quantile(_ENCLOSED_QUANTILE)) < min_enclosed:
            return None
        chosen = (enclosed >= min_enclosed).repeat_interleave(_DIRECTIONS_PER_PLACE)
        cameras = cameras.select(chosen)
        worth, _ = self.judged(cameras, close[chosen])
        return cameras, worth

    def free_places(self) -> Annotated[Tensor, "P 3"]:
        """Centres of the cells of a grid over the capture that hold next to nothing, as all around them do,
        at heights at which cameras are held.
        """
        # Opacity in each cell of the grid.
        side = _CELLS_PER_AXIS
        low = self.ends[:, 0]
        span = (self.ends[:, 1] - low).clamp_min(1e-9)
        cell = ((self.gaussians.means.double() - low) / span * side).floor().long()
        within = ((cell >= 0) & (cell < side)).all(1)
        number = cell[within] @ torch.tensor([side * side, side, 1])
        mass = torch.zeros(side**3).index_add_(0, number, self.gaussians.opacities[within])
        full = (mass > _MAX_FREE_SHARE * mass[mass > 0].mean()).float().view(1, 1, side, side, side)
        # A cell is free where neither it nor a neighbour is full.
        free = torch.nn.functional.max_pool3d(full, 3, 1, 1)[0, 0] == 0
        # Not at the box's faces, and not in the upper third.
        faces = [0, 1, -2, -1]
        free[faces] = False
        free[:, faces] = False
        free[:, :, faces] = False
        places = low + (free.nonzero().double() + 0.5) / side * span
        bottom = (self.ends * self.up[:, None]).amin(1).sum()
        top = (self.ends * self.up[:, None]).amax(1).sum()
        return places[places @ self.up <= bottom + _MAX_EYE_HEIGHT * (top - bottom)]

    def rings(self, count: int) -> tuple[Cameras, Annotated[Tensor, "V"]]:
        """Views around the middle, more than are needed, with their worth."""
        centre = self.ends.mean(1)
        opacities = self.gaussians.opacities
        away = torch.linalg.vector_norm(self.gaussians.means.double() - centre, dim=1)
        # Where all are at one place, their own size is that of the object.
        own = _quantiles(self.gaussians.log_scales.amax(1).exp(), opacities, (0.5,))
        away = away.clamp_min(float(own[0]))
        radius = float(_quantiles(away.float(), opacities, (_OBJECT_QUANTILE,))[0])
        fits = radius / math.sin(math.radians(_RING_FOV_DEGREES / 2))
        # Rings of cameras, each turned against the one before.
        rings = len(_RING_DISTANCES) * len(_RING_ELEVATIONS_DEGREES)
        each = max(_MIN_RING_VIEWS, round(_RING_CANDIDATES * count / rings))
        eyes: list[Tensor] = []
        for distance in _RING_DISTANCES:
            for degrees in _RING_ELEVATIONS_DEGREES:
                elevation = math.radians(degrees)
                flat = _around(self.up, each, _RING_TURN * len(eyes))
                direction = math.cos(elevation) * flat + math.sin(elevation) * self.up
                eyes.append(centre + direction * distance * fits)
        eye = torch.cat(eyes)
        cameras = self.looking(eye, centre.expand_as(eye), _RING_FOV_DEGREES)
        close = _RING_CLOSE_SHARE * torch.linalg.vector_norm(eye - centre, dim=1)
        worth, _ = self.judged(cameras, close)
        return cameras, worth

    def judged(
        self, cameras: Cameras, close: Annotated[Tensor, "V"]
    ) -> tuple[Annotated[Tensor, "V"], Annotated[Tensor, "V"]]:
        """Worth of views, how much of a small picture is filled less what is nearer than `close`, and the
        former alone.
        """
        small = cameras.scaled(_PICTURE_REDUCTION)
        worth = torch.zeros(len(cameras))
        filled = torch.zeros(len(cameras))
        clip = clip_distance(self.coarse)
        for view in range(len(small)):
            self.progress(view, len(small))
            drawn = draw(self.coarse, camera_of(small, view, clip), antialiased=self.antialiased)
            in_the_way = (drawn.opacity > _MIN_FILLED_OPACITY) & (drawn.depth < float(close[view]))
            filled[view] = drawn.opacity.mean()
            worth[view] = filled[view] - _CLOSE_COST * in_the_way.float().mean()
        return worth, filled


def _size_centre(
    points: Annotated[Tensor, "N 3"], sizes: Annotated[Tensor, "N"], ends: Annotated[Tensor, "3 2"]
) -> tuple[Annotated[Tensor, "3"], float]:
    """The place from which sizes are most alike in angle, and their deviation from there as a share of that
    of the sizes themselves.
    """
    place = ends.mean(1)
    half_span = float((ends[:, 1] - ends[:, 0]).max()) / 2
    spread = float((sizes - sizes.median()).abs().median())
    deviation = spread
    middle = points.mean(0)  # taken off: float32 tells distances in captures far from the origin
    for grid in (_COARSE_GRID, _FINE_GRID):
        line = torch.linspace(-grid.reach, grid.reach, grid.per_axis, dtype=torch.float64) * half_span
        tried = place + torch.cartesian_prod(line, line, line)
        # Median absolute deviation of log(size / distance) from each place.
        each = []
        for part in torch.split(tried, _PLACES_AT_ONCE):
            apart = torch.cdist((part - middle).float(), (points - middle).float()).clamp_min(1e-9)
            angles = sizes.float() - apart.log()
            each.append((angles - angles.median(1, keepdim=True).values).abs().median(1).values)
        deviations = torch.cat(each)
        place = tried[int(deviations.argmin())]
        deviation = float(deviations.min())
    return place, deviation / max(spread, 1e-9)


def _spread_out(directions: Annotated[Tensor, "N 3"], first: Annotated[Tensor, "3"]) -> list[int]:
    """Indices of directions far from each other, beginning with the one nearest to `first`."""
    picked = [int((directions @ first).argmax())]
    for _ in range(_TARGETS - 1):
        picked.append(int((directions @ directions[picked].T).amax(1).argmin()))
    return picked


def _farthest_apart(
    places: Annotated[Tensor, "P 3"], middle: Annotated[Tensor, "3"], count: int
) -> Annotated[Tensor, "p 3"]:
    """The place nearest to the middle, then always the one farthest from all that were picked."""
    picked: list[int] = []
    apart = torch.full((len(places),), math.inf, dtype=torch.float64)
    for _ in range(min(count, len(places))):
        if picked:
            following = int(apart.argmax())
        else:
            following = int((places - middle).norm(dim=1).argmin())
        picked.append(following)
        apart = apart.minimum((places - places[following]).norm(dim=1))
    return places[picked]


def _around(up: Annotated[Tensor, "3"], count: int, begin: float = 0.0) -> Annotated[Tensor, "count 3"]:
    """Directions across `up`, spread evenly, turned by `begin` of the angle between them."""
    # An orthonormal basis whose first axis is `up`, from the two axes of the world that are least along it.
    least_along = torch.eye(3, dtype=up.dtype)[:, up.abs().argsort()[:2]]
    basis = torch.linalg.qr(torch.cat([up[:, None], least_along], 1))[0]
    turn = (torch.arange(count, dtype=torch.float64) + begin) * (2 * math.pi / count)
    ring: Tensor = turn.cos()[:, None] * basis[:, 1] + turn.sin()[:, None] * basis[:, 2]
    return ring


def _quantiles(values: Tensor, weights: Tensor, shares: tuple[float, ...]) -> Tensor:
    """Quantiles of weighted values."""
    ordered, at = values.sort()
    mass = weights[at].double().cumsum(0)
    wanted = torch.tensor(shares, dtype=torch.float64) * mass[-1]
    return ordered[torch.searchsorted(mass, wanted).clamp_max(len(mass) - 1)]
