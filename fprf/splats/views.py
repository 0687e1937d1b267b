"""Cameras for a capture that came without any: around an object, or inside what surrounds them (rooms,
streets, gardens).

Where photographs were taken from tells the size of the Gaussians: training makes them about as large as
pixels, so that their size grows with the distance from the cameras. Where one place explains the sizes
plainly better than none, cameras stand around it and look at what lies about it, whatever points up.

Objects are seen from rings at several heights and distances. Where a capture was made from within, cameras
stand in free places and look around: there most directions end on something, as they do in a hollow object,
but what lies far out is made of larger Gaussians, or reaches far beyond the rest. Either way the better views
are kept: filled, and with nothing close before the camera.
"""

import math
from dataclasses import fields, replace
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ..errors import DataError
from ..ops.harmonics import HARMONIC, spherical_harmonics
from ..ops.rasterise.reference import project_reference
from ..ops.rasterise.rendering import Pinhole, Rasterised, lift, rasterise
from ..rendering.cameras import Cameras
from ..rendering.local_frame import extent_of
from ..rendering.paths import look_at, pinhole
from .gaussians import Gaussians, bulk_of
from .photographs import camera_of, covering

_LIFTS = (-8.0, 12.0, 32.0, 55.0)
"""Heights of the rings, in degrees above the middle."""
_DISTANCES = (1.2, 1.7)
"""Distances of the rings; at 1 the object just fits into the view."""
OUTLYING = 128.0
"""Extents of the bulk from it, beyond which Gaussians are stray."""
_FOV = 45.0
_WIDE = 70.0
"""Vertical angles of views around and inside, in degrees."""
_PROBE = 8
"""Candidates are judged on pictures reduced by this."""
_CELLS = 24
"""Cells a side of the grid in which free places are looked for."""
_FREE = 0.02
_PLACES = 12
_TURNS = 8
"""Opacity of a free cell, as a share of that of all occupied ones in the mean; places tried; directions
looked in at each.
"""
_PROBED = 30_000
"""Gaussians, those of most opacity times area, of which candidates are drawn."""
_ENCLOSED = 0.8
"""Opacity of the surroundings, seen from the better places, from which on a capture is looked at from
within.
"""
_COARSE = 2.5
_TAIL = 6.0
"""Size of the outer fifth of the Gaussians relative to the inner half, and distance of the outermost
thousandth relative to the median, from which on a capture is taken for one from within. Eight captures of
objects have at most 1.8 and 3.7.
"""
_SIZED = 0.8
_SIZED_WITHIN = 0.9
_SAMPLE = 1500
"""Median deviation of the logarithms of size over distance from the place that explains sizes best, relative
to that of the sizes alone, below which the photographs were taken about there, and where the capture is from
within; Gaussians that are asked. Eight captures of objects have 0.89 or more.
"""
_GRIDS = ((17, 3.0), (9, 0.375))
"""Places tried along an axis, and how far out in half spans of the capture: all over, then about the best."""
_AROUND = (0.08, 0.2)
"""Distances of the cameras from that place, relative to the median distance of what they see."""
_BACK = (0.0, 0.25)
"""Distances behind that place, against the mean direction of what is seen, in the same unit."""
_TARGETS = 12
_NARROW = 55.0
"""Directions looked in from there, and the vertical angle in degrees."""
_CLOSE = 0.15
_BLUR = 3.0
"""Share of the median distance within which things are in the way; logarithm of the size in angle, relative
to the median one as seen from the place, at which Gaussians are as bad as none.
"""
_NEAR = 3.0
"""What a pixel with something close before the camera costs, in filled ones."""
_MEAN_VIEWS = 32
_UNSEEN = 1e-4
"""Views that means are taken from, at most; weight, in pixels, of those that do not show a Gaussian."""
_CLIP = 0.01
_CLIPPED = (1e-4, 2e-2)
"""Distance from a camera from which on a capture is drawn, and its bounds as shares of the capture's
extent.
"""


def draw(
    gaussians: Gaussians,
    camera: Pinhole,
    *,
    antialiased: bool = False,
    features: Annotated[Tensor, "N C"] | None = None,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Rasterised:
    """A view of Gaussians; harmonics above degree 3, which files may hold, are not drawn."""
    parts = (
        gaussians.means,
        gaussians.quaternions,
        gaussians.log_scales,
        gaussians.logits,
        gaussians.harmonics[:, :16],
    )
    behind = torch.tensor(background, device=gaussians.means.device)
    return rasterise(*parts, camera, features=features, background=behind, antialiased=antialiased)


def clip_distance(gaussians: Gaussians) -> float:
    """Nothing of a capture is drawn nearer to a camera than this, along z, in whatever units it is."""
    extent = extent_of(gaussians.means)[1]
    if extent > 0:
        return min(max(_CLIP, _CLIPPED[0] * extent), _CLIPPED[1] * extent)
    return _CLIP


class SeenMeans(NamedTuple):
    """Means over the views that show each Gaussian: what comes nearest to them where a renderer knows one
    colour a Gaussian and no compensation of opacities (Mip-Splatting), as in browsers and .splat files.
    """

    functions: Annotated[Tensor, "N K"]
    """Means of the functions of the harmonics, at most those of degree 3."""
    opacities: Annotated[Tensor, "N"]
    weights: Annotated[Tensor, "N"]
    """Of each Gaussian in the pixels of the views: those of the least weight show least."""

    def plain(self, gaussians: Gaussians) -> Gaussians:
        """The Gaussians with mean opacities."""
        return replace(gaussians, logits=torch.logit(self.opacities, 1e-6))

    def gaussians(self, gaussians: Gaussians) -> Gaussians:
        """The Gaussians with mean colours, which may leave [0, 1], and opacities."""
        mean = 0.5 + torch.einsum(
            "nk,nkc->nc", self.functions, gaussians.harmonics[:, : self.functions.shape[1]]
        )
        return self.plain(gaussians.recoloured((mean - 0.5)[:, None] / HARMONIC))


@torch.inference_mode()
def seen_means(gaussians: Gaussians, cameras: Cameras, *, antialiased: bool) -> SeenMeans:
    """Means of what views show of each Gaussian, by its weights in their pixels.

    The mean over all directions is another colour where photographs are from one side. What no view shows
    takes the mean over all of them; what is not finite keeps its constant harmonic.
    """
    bands = min(gaussians.degree, 3) + 1
    shape = (gaussians.means, gaussians.quaternions, gaussians.log_scales, gaussians.logits)
    functions = torch.zeros(len(gaussians), bands**2)
    opacities = torch.zeros(len(gaussians), 1)
    weights = torch.zeros(len(gaussians), 1)
    near = clip_distance(gaussians)
    # Sums over views, each by the Gaussian's weight in its pixels; what none shows weighs the same in all of
    # them.
    for view in torch.linspace(0, len(cameras) - 1, min(_MEAN_VIEWS, len(cameras))).round().long().tolist():
        camera = covering(cameras, view, near)
        direction = torch.nn.functional.normalize(gaussians.means - cameras.pose[view, :, 3].float(), dim=1)
        pixels = torch.ones(camera.height, camera.width, 1)
        weight = _UNSEEN + lift(*shape, camera, pixels, antialiased=antialiased)
        functions += weight * spherical_harmonics(direction, bands)
        opacities += weight * project_reference(*shape, camera, antialiased=antialiased).opacity[:, None]
        weights += weight
    # A Gaussian without finite numbers has no weight either.
    constant = torch.zeros(bands**2)
    constant[0] = HARMONIC
    functions, finite = functions / weights, functions.isfinite().all(1, keepdim=True)
    return SeenMeans(torch.where(finite, functions, constant), (opacities / weights)[:, 0], weights[:, 0])


@torch.inference_mode()
def find_views(
    gaussians: Gaussians,
    *,
    count: int,
    size: tuple[int, int],
    up: Annotated[Tensor, "3"],
    inside: bool | None = None,
    antialiased: bool = False,
    camera: Cameras | None = None,
) -> Cameras:
    """At most `count` views of `size` (width, height), the nearer ones around an object first.

    `inside` says whether cameras stand within the capture; None = found out. Where the `camera` is known that
    the capture was made from, it is the first view, and the others stand about it. Gaussians very far from
    the others play no part. Raises DataError where nothing can be seen from anywhere.
    """
    near = torch.from_numpy(bulk_of(gaussians.means.numpy()).apart <= OUTLYING)
    if bool(near.all()):
        gaussians = gaussians
    else:
        gaussians = gaussians.select(near)
    search = _Search(gaussians, size, up.double() / up.double().norm(), antialiased)
    within = search.made_from_within() if inside is None else inside
    # About where sizes say that photographs were taken; else within what surrounds a free place; else around
    # the object.
    chosen = None
    others = count - (camera is not None)
    if inside is not False:
        place = None
        if camera is not None:
            place = camera.pose[0, :, 3].double()
        chosen = search.around_place(others, _SIZED_WITHIN if within else _SIZED, place)
    if chosen is None:
        candidates = None
        if within:
            candidates = search.from_free_places(0.0 if inside else _ENCLOSED)
        cameras, worth = candidates or search.rings(others)
        # The best ones, in the order in which they were tried: the nearer ones first.
        best = worth.topk(min(others, len(worth))).indices.sort().values
        chosen = cameras.select(best[worth[best] > 0])
    if camera is None:
        if not len(chosen):
            raise DataError(
                "no view shows anything of the capture; give the axis that points up (--up), or clean the file"
            )
        return chosen
    # On the grid of the others, so that all of its picture lies within.
    share = float((torch.tensor(size) / camera.size[0]).min())
    centre = torch.tensor(size) / 2 + share * (camera.centre - camera.size / 2)
    first = replace(camera.resized(torch.tensor([size])), focal=camera.focal * share, centre=centre)
    return Cameras(
        *(torch.cat([getattr(each, field.name) for each in (first, chosen)]) for field in fields(Cameras))
    )


class _Search:
    """Candidates for views of `size` (width, height) of a capture, and what they are worth; `up` has length
    1, float64.
    """

    def __init__(
        self, gaussians: Gaussians, size: tuple[int, int], up: Annotated[Tensor, "3"], antialiased: bool
    ) -> None:
        self.gaussians = gaussians
        self.size = size
        self.up = up
        self.antialiased = antialiased
        opacity = gaussians.opacities
        self.ends = torch.stack(
            [_quantiles(axis, opacity, (0.02, 0.98)) for axis in gaussians.means.T]
        ).double()
        """Lowest and highest corner [3 2] of the box that most opacity lies in."""
        self.coarse = gaussians
        """Gaussians that show most: candidates are judged on pictures of these."""
        if len(gaussians) > _PROBED:
            area = gaussians.log_scales.topk(2, dim=1).values.sum(1) + opacity.log()
            self.coarse = gaussians.select(area.topk(_PROBED).indices)

    def looking(self, eye: Annotated[Tensor, "V 3"], target: Annotated[Tensor, "V 3"], fov: float) -> Cameras:
        """Cameras at `eye` that look at `target`, with a vertical angle in degrees."""
        return pinhole(look_at(eye, target, self.up), width=self.size[0], height=self.size[1], fov=fov)

    def made_from_within(self) -> bool:
        """True where what lies far out is coarser than the rest, or reaches far beyond it."""
        # Distances from the median, and sizes, of what can be seen.
        seen = self.gaussians.opacities > 0.3
        if int(seen.sum()) < 100:
            return False
        means = self.gaussians.means[seen]
        size = self.gaussians.log_scales[seen].topk(2, dim=1).values.mean(1)
        away = torch.linalg.vector_norm(means - means.median(0).values, dim=1)
        order = away.argsort()
        half = order[round(0.5 * (len(order) - 1))]
        fifth = order[round(0.8 * (len(order) - 1))]
        last = order[round(0.999 * (len(order) - 1))]
        if away[half] == 0:
            return False
        coarser = size[away > away[fifth]].median() - size[away < away[half]].median()
        return bool(coarser.exp() >= _COARSE) or bool(away[last] >= _TAIL * away[half])

    def around_place(self, count: int, sized: float, known: Annotated[Tensor, "3"] | None) -> Cameras | None:
        """Views from about where the photographs were taken, if known; None where sizes do not tell as well
        as `sized`.
        """
        # The place from which the sizes of some solid Gaussians are most alike in angle, and that usual
        # angle.
        gaussians = self.gaussians
        solid = (gaussians.opacities > 0.2).nonzero()[:, 0]
        if len(solid) < 100:
            return None
        some = solid[:: max(1, len(solid) // _SAMPLE)]
        points = gaussians.means.double()
        extent = gaussians.log_scales.double().topk(2, dim=1).values.mean(1)
        if known is None:
            place, share = _size_centre(points[some], extent[some], self.ends)
        else:
            place, share = (known, 0.0)
        if share > sized:
            return None
        away = torch.linalg.vector_norm(points[some] - place, dim=1)
        middle = float(away.median())
        usual = float((extent[some] - away.log()).median())
        # Directions far from each other, of what is not in the far surroundings.
        ahead = torch.nn.functional.normalize(points[some][away < away.quantile(0.8)] - place, dim=1)
        if not len(ahead):  # all are in one place
            return None
        mean = torch.nn.functional.normalize(ahead.mean(0), dim=0)
        picked = [int((ahead @ mean).argmax())]
        for _ in range(_TARGETS - 1):
            picked.append(int((ahead @ ahead[picked].T).amax(1).argmin()))
        # Cameras at that place, a little behind it and to the sides, each looking in all of these directions.
        ring = _around(self.up, 4)
        back = torch.tensor(_BACK, dtype=torch.float64)[:, None] * -mean
        offsets = middle * torch.cat([back, *(far * ring for far in _AROUND)])
        eye = (place + offsets).repeat_interleave(_TARGETS, 0)
        cameras = self.looking(eye, (place + middle * ahead[picked]).repeat(len(offsets), 1), _NARROW)
        # Their worth on small pictures of those that show most there: how much is filled, less what is close
        # or looks blurred.
        seen = 2 * (extent - torch.linalg.vector_norm(points - place, dim=1).clamp_min(0.05 * middle).log())
        shown = (seen + gaussians.opacities.log()).topk(min(_PROBED, len(seen))).indices
        coarse = gaussians.select(shown)
        points = points[shown].float()
        extent = extent[shown].float()
        small = cameras.scaled(_PROBE)
        worth = torch.zeros(len(cameras))
        near = clip_distance(gaussians)
        for view in range(len(small)):
            apart = torch.linalg.vector_norm(points - eye[view].float(), dim=1).clamp_min(1e-9)
            blurred = ((extent - apart.log() - usual) / _BLUR).clamp(0, 1)[:, None]
            drawn = draw(coarse, camera_of(small, view, near), antialiased=self.antialiased, features=blurred)
            close = (drawn.opacity > 0.5) & (drawn.depth < _CLOSE * middle)
            worth[view] = drawn.opacity.mean() - _NEAR * close.float().mean() - drawn.features.mean()
        # The best of each direction before the second of any, as long as they are about as good.
        rank = worth.view(len(offsets), _TARGETS).argsort(0, descending=True).argsort(0).flatten()
        return cameras.select((worth - 0.05 * rank).topk(min(count, len(worth))).indices.sort().values)

    def from_free_places(self, enclosed: float) -> tuple[Cameras, Annotated[Tensor, "V"]] | None:
        """Views in all directions from free places that are enclosed, with their worth; None where few
        are.
        """
        # Opacity in each cell of a grid; a cell is free where neither it nor a neighbour holds more than next
        # to nothing.
        gaussians = self.gaussians
        up = self.up
        ends = self.ends
        low = ends[:, 0]
        span = (ends[:, 1] - ends[:, 0]).clamp_min(1e-9)
        at = ((gaussians.means.double() - low) / span * _CELLS).floor().long()
        kept = ((at >= 0) & (at < _CELLS)).all(1)
        flat = at[kept] @ torch.tensor([_CELLS * _CELLS, _CELLS, 1])
        mass = torch.zeros(_CELLS**3).index_add_(0, flat, gaussians.opacities[kept])
        full = (mass > _FREE * mass[mass > 0].mean()).float().view(1, 1, _CELLS, _CELLS, _CELLS)
        clear = torch.nn.functional.max_pool3d(full, 3, 1, 1)[0, 0] == 0
        # Not at the box's faces, and not in the upper third, where nobody holds a camera.
        clear[[0, 1, -2, -1]] = clear[:, [0, 1, -2, -1]] = clear[:, :, [0, 1, -2, -1]] = False
        places = low + (clear.nonzero().double() + 0.5) / _CELLS * span
        bottom = (ends * up[:, None]).amin(1).sum()
        top = (ends * up[:, None]).amax(1).sum()
        places = places[places @ up <= bottom + 0.67 * (top - bottom)]
        if not len(places):
            return None
        # The one nearest to the middle, then always the one farthest from all that were picked.
        picked: list[int] = []
        apart = torch.full((len(places),), math.inf, dtype=torch.float64)
        for _ in range(min(_PLACES, len(places))):
            if picked:
                nearest = int(apart.argmax())
            else:
                nearest = int((places - ends.mean(1)).norm(dim=1).argmin())
            picked.append(nearest)
            apart = apart.minimum((places - places[nearest]).norm(dim=1))
        places = places[picked]
        # Of the directions half overlap enough to tell: a place is enclosed where something fills the view in
        # most of them.
        eye = places.repeat_interleave(_TURNS, 0)
        ahead = _around(up, _TURNS) - 0.1 * up
        cameras = self.looking(eye, eye + ahead.repeat(len(places), 1), _WIDE)
        every = torch.arange(0, len(cameras), 2)
        near = torch.full(
            (len(cameras),), 0.05 * float(self.coarse.means.double().var(0, correction=0).sum().sqrt())
        )
        _, filled = self.probed(cameras.select(every), near[every])
        share = filled.view(len(places), _TURNS // 2).mean(1)
        if float(share.quantile(0.75)) < enclosed:
            return None
        chosen = (share >= enclosed).repeat_interleave(_TURNS)
        cameras = cameras.select(chosen)
        return cameras, self.probed(cameras, near[chosen])[0]

    def rings(self, count: int) -> tuple[Cameras, Annotated[Tensor, "V"]]:
        """Views around the middle, more than are needed, with their worth."""
        centre = self.ends.mean(1)
        opacities = self.gaussians.opacities
        away = torch.linalg.vector_norm(self.gaussians.means.double() - centre, dim=1)
        # Where all are at one place, their own size is that of the object.
        away = away.clamp_min(
            float(_quantiles(self.gaussians.log_scales.amax(1).exp(), opacities, (0.5,))[0])
        )
        reach = float(_quantiles(away.float(), opacities, (0.95,))[0]) / math.sin(math.radians(_FOV / 2))
        # Rings of cameras, each turned against the one before, so that none stands behind another.
        rings = [(math.radians(height), far) for far in _DISTANCES for height in _LIFTS]
        each = max(4, round(1.6 * count / len(rings)))
        eyes = []
        for ring, (height, far) in enumerate(rings):
            flat = _around(self.up, each, 0.38 * ring)
            eyes.append(centre + (math.cos(height) * flat + math.sin(height) * self.up) * far * reach)
        eye = torch.cat(eyes)
        cameras = self.looking(eye, centre.expand_as(eye), _FOV)
        return cameras, self.probed(cameras, 0.3 * torch.linalg.vector_norm(eye - centre, dim=1))[0]

    def probed(
        self, cameras: Cameras, near: Annotated[Tensor, "V"]
    ) -> tuple[Annotated[Tensor, "V"], Annotated[Tensor, "V"]]:
        """Worth of views, how much of a small picture is filled less what is nearer than `near`, and the
        former alone.
        """
        small = cameras.scaled(_PROBE)
        worth = torch.zeros(len(cameras))
        filled = torch.zeros(len(cameras))
        clip = clip_distance(self.coarse)
        for view in range(len(small)):
            drawn = draw(self.coarse, camera_of(small, view, clip), antialiased=self.antialiased)
            close = (drawn.opacity > 0.5) & (drawn.depth < float(near[view]))
            filled[view] = drawn.opacity.mean()
            worth[view] = filled[view] - _NEAR * close.float().mean()
        return worth, filled


def _size_centre(
    points: Annotated[Tensor, "N 3"], extent: Annotated[Tensor, "N"], ends: Tensor
) -> tuple[Annotated[Tensor, "3"], float]:
    """The place from which sizes (logarithms) are most alike in angle, and how much more alike than the sizes
    themselves.
    """
    place = ends.mean(1)
    half = float((ends[:, 1] - ends[:, 0]).max()) / 2
    spread = deviation = float((extent - extent.median()).abs().median())
    middle = points.mean(0)  # taken off: float32 tells distances in captures far from the origin
    for count, reach in _GRIDS:
        line = torch.linspace(-reach, reach, count, dtype=torch.float64) * half
        tried = place + torch.cartesian_prod(line, line, line)
        # Median absolute deviation of log(size / distance) from each place.
        each = []
        for part in torch.split(tried, 512):
            apart = torch.cdist((part - middle).float(), (points - middle).float()).clamp_min(1e-9)
            left = extent.float() - apart.log()
            each.append((left - left.median(1, keepdim=True).values).abs().median(1).values)
        deviations = torch.cat(each)
        place = tried[int(deviations.argmin())]
        deviation = float(deviations.min())
    return place, deviation / max(spread, 1e-9)


def _around(up: Annotated[Tensor, "3"], count: int, begin: float = 0.0) -> Annotated[Tensor, "count 3"]:
    """Directions across `up`, spread evenly, turned by `begin` of the angle between them."""
    # An orthonormal basis whose first axis is `up`, from the two axes of the world that are least along it.
    basis = torch.linalg.qr(
        torch.cat([up[:, None], torch.eye(3, dtype=up.dtype)[:, up.abs().argsort()[:2]]], 1)
    )[0]
    turn = (torch.arange(count, dtype=torch.float64) + begin) * (2 * math.pi / count)
    ring: Tensor = turn.cos()[:, None] * basis[:, 1] + turn.sin()[:, None] * basis[:, 2]
    return ring


def _quantiles(values: Tensor, weights: Tensor, shares: tuple[float, ...]) -> Tensor:
    """Quantiles of weighted values."""
    ordered, at = values.sort()
    mass = weights[at].double().cumsum(0)
    wanted = torch.tensor(shares, dtype=torch.float64) * mass[-1]
    return ordered[torch.searchsorted(mass, wanted).clamp_max(len(mass) - 1)]
