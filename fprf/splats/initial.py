"""First Gaussians: at the reconstruction's points, else at points matched between posed views, else
anywhere in view.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Annotated, NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..datamanagers.images import Image
from ..datamanagers.scene import ParsedScene
from ..rendering.cameras import project
from .gaussians import morton_order
from .pinholes import covering, undistorted

Doubles = NDArray[np.float64]
_SMALLEST_DIVISOR = float(np.finfo(np.float32).tiny)
"""Keeps what is divided by above 0, in whatever units a capture is."""
_MIN_START_POINTS = 100
"""Points that are worth starting from; by eye."""
_MAX_SCATTERED_POINTS = 10_000
"""Random points, at most, where views have no matches; by eye."""
_NEAREST_PLACES = 100
"""Places to either side on the curve among which the nearest points are looked for; by eye."""
_MAX_SIFT_FEATURES = 1500
"""SIFT features of a view; by eye."""
_SIFT_CONTRAST = 0.01
"""Least contrast of a feature: a fourth of OpenCV's, as photographs are small; by eye."""
_MAX_MATCHED_VIEWS = 4
"""Views that one is matched with; by eye."""
_MAX_MATCH_RATIO = 0.85
"""Distance of the best match over that of the second best, at most (Lowe's ratio); by eye."""
_MAX_ERROR_PIXELS = 1.5
"""Largest error of a triangulated point; by eye."""
_MIN_RAY_ANGLE = math.radians(1.5)
"""Least angle between the rays of one; by eye: below it a pixel's error moves it far."""
_SURROUNDINGS_RADIUS = 10.0
"""Radius of the surroundings, in that of the cameras and of 95 % of the points; by eye."""
_BLURRED_SIDE_PIXELS = 8
"""Pixels of a photograph's shorter side once its colours are blurred for the surroundings; by eye."""
_NEIGHBOURING_DIRECTIONS = 8
"""Directions that views show, nearest to one that none shows, whose mean colour it gets; by eye."""


class Points(NamedTuple):
    """P coloured points in the world."""

    position: Annotated[Doubles, "P 3"]
    colour: Annotated[NDArray[np.float32], "P 3"]


def initial_points(
    scene: ParsedScene, images: Mapping[int, Image], count: int, rng: np.random.Generator
) -> tuple[Points, str]:
    """At most `count` points, and where they are from; images as they lie, at the size of the cameras."""
    if scene.points is not None and len(scene.points) >= _MIN_START_POINTS:
        position = scene.points.double().numpy()
        position = position[np.isfinite(position).all(1)]
        position = position[np.sort(rng.permutation(len(position))[:count])]
        return Points(
            position, _mean_colours(scene, images.__getitem__, position)[0]
        ), "points of the reconstruction"
    points = _matched(scene, images)
    kind = "points matched between views"
    if len(points.position) < _MIN_START_POINTS:
        points = _scattered(scene, images, min(count, _MAX_SCATTERED_POINTS), rng)
        kind = "random points"
    chosen = np.sort(rng.permutation(len(points.position))[:count])
    return Points(points.position[chosen], points.colour[chosen]), kind


def surroundings(scene: ParsedScene, images: Mapping[int, Image], points: Points, count: int) -> Points:
    """`count` points spread evenly over a distant sphere, in the blurred colours of the photographs that show
    their directions.

    Where no view looks, the colours of the nearest seen directions go on.
    """
    # A sphere around the cameras, far outside of what they see.
    centres = scene.cameras.pose[scene.train][:, :, 3].numpy()
    centre = centres.mean(0)
    away = np.linalg.norm(points.position - centre, axis=1)
    radius = max(np.linalg.norm(centres - centre, axis=1).max(), np.quantile(away, 0.95), _SMALLEST_DIVISOR)
    # Fibonacci's spiral: directions as evenly apart as can be.
    height = 1 - (2 * np.arange(count) + 1) / count
    turn = np.arange(count) * math.pi * (3 - math.sqrt(5))
    level = np.sqrt(1 - height**2)
    direction = np.stack([level * np.cos(turn), level * np.sin(turn), height], 1)
    position = centre + _SURROUNDINGS_RADIUS * float(radius) * direction

    # Blurred, since what is far is drawn by few Gaussians, and a sharp pixel would become a blot.
    def blurred(view: int) -> Image:
        tall, wide = images[view].shape[:2]
        shrink = _BLURRED_SIDE_PIXELS / min(tall, wide)
        reduced = cv2.resize(
            images[view], (round(wide * shrink), round(tall * shrink)), interpolation=cv2.INTER_AREA
        )
        return np.asarray(cv2.resize(reduced, (wide, tall), interpolation=cv2.INTER_LINEAR), np.uint8)

    colour, seen = _mean_colours(scene, blurred, position)
    if seen.any():
        alike = direction[~seen] @ direction[seen].T
        nearest = np.argsort(-alike, axis=1)[:, :_NEIGHBOURING_DIRECTIONS]
        colour[~seen] = colour[seen][nearest].mean(1)
    return Points(position, colour)


def spacing(position: Annotated[Doubles, "P 3"]) -> Annotated[Doubles, "P"]:
    """Mean distance to the three nearest of the points around on a Morton curve; cut at that of all but 1 %
    of the points.
    """
    count = len(position)
    if count < 4:
        return np.ones(count)
    # Of each point the three least distances so far, to those that lie so many places apart on the curve, on
    # either side.
    order = curve_order(position)
    sorted_ = position[order]
    near = np.full((3, count), np.inf)
    for step in range(1, min(_NEAREST_PLACES, count - 1) + 1):
        apart = np.linalg.norm(sorted_[step:] - sorted_[:-step], axis=1)
        for part in (slice(step, None), slice(None, -step)):
            left = apart
            for row in near[:, part]:
                farther = np.maximum(row, left)
                row[:] = np.minimum(row, left)
                left = farther
    mean = np.empty(count)
    mean[order] = near.mean(0)
    widest = np.percentile(mean, 99) or 1.0
    return np.clip(mean, 1e-6 * widest, widest)  # points in one place have a logarithm, too


def curve_order(position: Annotated[NDArray[np.floating], "P 3"]) -> NDArray[np.int64]:
    """Indices along a Morton curve: what is near in space is then near in memory."""
    low = np.percentile(position, 2, axis=0)
    high = np.percentile(position, 98, axis=0)
    cell = np.clip((position - low) / np.maximum(high - low, _SMALLEST_DIVISOR) * 1023, 0, 1023).astype(
        np.int64
    )
    return morton_order(cell)


def projected(
    scene: ParsedScene, points: Annotated[Tensor, "P 3"]
) -> Iterator[tuple[int, Tensor, Tensor, Tensor]]:
    """For each training view: its number, pixels and depths of points, and which of them it has in the
    picture.
    """
    for view in scene.train.tolist():
        pixel, depth = project(scene.cameras, torch.full((len(points),), view), points)
        yield (
            view,
            pixel,
            depth,
            (depth > 0) & (pixel >= 0).all(-1) & (pixel < scene.cameras.size[view]).all(-1),
        )


def _mean_colours(
    scene: ParsedScene, image: Callable[[int], Image], position: Doubles
) -> tuple[Annotated[NDArray[np.float32], "P 3"], Annotated[NDArray[np.bool_], "P"]]:
    """Mean colours over the training views that have points in the picture, grey where none has; and where
    one has.
    """
    total = np.zeros((len(position), 3))
    count = np.zeros(len(position))
    for view, pixel, _, inside in projected(scene, torch.from_numpy(position)):
        x, y = pixel[inside].long().numpy().T
        total[inside.numpy()] += image(view)[y, x]
        count[inside.numpy()] += 1
    colour = np.where(count[:, None] > 0, total / np.maximum(count, 1)[:, None] / 255, 0.5)
    return colour.astype(np.float32), count > 0


def _matched(scene: ParsedScene, images: Mapping[int, Image]) -> Points:
    """Points triangulated from SIFT matches between neighbouring training views."""
    # Pictures without their lenses: triangulation is that of pinholes.
    views = scene.train.tolist()
    cameras = {}
    for view in views:
        cameras[view] = covering(scene.cameras, view, 1e-6)
    pictures = {}
    for view in views:
        pictures[view] = undistorted(scene.cameras, view, images[view], cameras[view])[0]
    places: dict[int, Doubles] = {}
    features: dict[int, NDArray[np.float32]] = {}
    for view in views:
        found = root_sift(np.asarray(cv2.cvtColor(pictures[view], cv2.COLOR_RGB2GRAY), np.uint8))
        if len(found.places) < 2:
            continue
        places[view] = found.places
        features[view] = found.descriptors
    # Each view is matched with the few that stand near and look the same way.
    centre = {}
    for v in views:
        centre[v] = scene.cameras.pose[v][:, 3].numpy()
    axis = {}
    for v in views:
        axis[v] = -scene.cameras.pose[v][:, 2].numpy()
    middle = np.mean([*centre.values()], axis=0)
    spread = max(float(np.mean([np.linalg.norm(c - middle) for c in centre.values()])), _SMALLEST_DIVISOR)
    positions = [np.zeros((0, 3))]
    colours = [np.zeros((0, 3), np.float32)]
    done = set()
    for i in features:
        apart: dict[int, float] = {}
        for j in features:
            if j != i:
                between = np.linalg.norm(centre[j] - centre[i]) / spread
                apart[j] = float(between + 2 * (1 - axis[i] @ axis[j]))
        for j in sorted(apart, key=apart.__getitem__)[:_MAX_MATCHED_VIEWS]:
            if (j, i) in done:
                continue
            done.add((i, j))
            p, q = mutual_matches(features[i], features[j])
            if not len(p):
                continue
            # Points of both, in the colours of the first.
            rays = []
            for v in (i, j):
                rays.append((cameras[v].intrinsics @ cameras[v].world_to_camera[:3]).numpy())
            a = places[i][p]
            b = places[j][q]
            position = _triangulated(rays, (a, b), (centre[i], centre[j]))
            fine = np.isfinite(position).all(1)
            pixel = a[fine].astype(int)
            height, width = pictures[i].shape[:2]
            seen = pictures[i][np.clip(pixel[:, 1], 0, height - 1), np.clip(pixel[:, 0], 0, width - 1)]
            positions.append(position[fine])
            colours.append(seen.astype(np.float32) / 255)
    return Points(np.concatenate(positions), np.concatenate(colours))


class Features(NamedTuple):
    """F features of a picture."""

    places: Annotated[Doubles, "F 2"]
    """Pixels, whose centres lie at +0.5."""
    descriptors: Annotated[NDArray[np.float32], "F 128"]
    """Of unit length."""


def root_sift(grey: Annotated[NDArray[np.uint8], "H W"]) -> Features:
    """SIFT features with square roots of their descriptors (Arandjelovic and Zisserman 2012)."""
    detector = cv2.SIFT.create(nfeatures=_MAX_SIFT_FEATURES, contrastThreshold=_SIFT_CONTRAST)
    keypoints, described = detector.detectAndCompute(grey, None)
    if described is None or not len(keypoints):
        return Features(np.zeros((0, 2)), np.zeros((0, 128), np.float32))
    parts = []
    for each in keypoints:
        parts.append(each.pt)
    share = described / np.maximum(described.sum(1, keepdims=True), 1e-9)
    return Features(np.array(parts, np.float64) + 0.5, np.sqrt(share).astype(np.float32))


def mutual_matches(
    first: NDArray[np.float32], second: NDArray[np.float32]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Mutual best matches whose second best is clearly worse (Lowe's ratio, 0.85); none of less than two
    features.
    """
    if min(len(first), len(second)) < 2:
        none = np.zeros(0, np.int64)
        return none, none
    alike = first @ second.T
    rows = np.arange(len(first))
    # The two best matches of each; distances of unit vectors follow from their cosines.
    backwards = alike.argmax(0)
    best = alike.argmax(1)
    likeness = alike[rows, best]
    alike[rows, best] = -np.inf
    near = np.sqrt(np.maximum(2 - 2 * likeness, 0))
    next_ = np.sqrt(np.maximum(2 - 2 * alike.max(1), 0))
    kept = (near < _MAX_MATCH_RATIO * next_) & (backwards[best] == rows)
    return rows[kept], best[kept]


def _triangulated(
    rays: list[Doubles], pixels: tuple[Doubles, Doubles], centres: tuple[Doubles, Doubles]
) -> Doubles:
    """World points [M 3]; NaN where the error is too large, the point lies behind a view, or the rays are
    nearly parallel.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        homogeneous = cv2.triangulatePoints(rays[0], rays[1], pixels[0].T, pixels[1].T)
        position = (homogeneous[:3] / homogeneous[3]).T
        # Points lie before both views and project to within some pixels of where they were seen ...
        good = np.isfinite(position).all(1)
        for matrix, pixel in zip(rays, pixels, strict=True):
            shown = position @ matrix[:, :3].T + matrix[:, 3]
            good &= (shown[:, 2] > 0) & (
                np.linalg.norm(shown[:, :2] / shown[:, 2:] - pixel, axis=1) < _MAX_ERROR_PIXELS
            )
        # ... and the angle between their rays says how far away they are.
        u = position - centres[0]
        v = position - centres[1]
        cosine = (u * v).sum(1) / np.linalg.norm(u, axis=1) / np.linalg.norm(v, axis=1)
    return np.where((good & (cosine < math.cos(_MIN_RAY_ANGLE)))[:, None], position, np.nan)


def _scattered(
    scene: ParsedScene, images: Mapping[int, Image], count: int, rng: np.random.Generator
) -> Points:
    """Points on random rays, their distances spread evenly over the logarithm: from a third to 30 times the
    cameras' spread.
    """
    # Random pixels of random views, and their colours.
    views = rng.choice(scene.train.numpy(), count)
    centre = scene.cameras.pose[:, :, 3].numpy()
    spread = max(float(np.linalg.norm(centre - centre.mean(0), axis=1).mean()), _SMALLEST_DIVISOR)
    size = scene.cameras.size[views].numpy()
    pixel = rng.random((count, 2)) * size
    parts = []
    for v, (x, y) in zip(views, pixel, strict=True):
        parts.append(images[v][int(y), int(x)])
    colour = np.stack(parts)
    # Points at random depths on their rays, lenses left out: from OpenGL's camera axes into the world.
    depth = spread * np.exp(rng.uniform(math.log(1 / 3), math.log(30), count))
    plane = (pixel - scene.cameras.centre[views].numpy()) / scene.cameras.focal[views].numpy()
    local = np.stack([plane[:, 0], -plane[:, 1], -np.ones(count)], 1) * depth[:, None]
    pose = scene.cameras.pose[views].numpy()
    return Points(
        np.einsum("nij,nj->ni", pose[:, :, :3], local) + pose[:, :, 3],
        np.divide(colour, 255, dtype=np.float32),
    )
