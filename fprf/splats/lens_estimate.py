"""Estimate the radial distortion of captures whose cameras come without a lens.

Formats such as LLFF drop the lens that a reconstruction has found. Features that two posed views match then lie
beside each other's epipolar lines, the farther the nearer to the corners. k1 is where they lie nearest; nothing is
trained.

k1 is OpenCV's: tangents r from the axis are shown at r (1 + k1 r^2). Cameras have OpenCV's axes here. Distances are
in pixels of photographs of at most `_LONGEST` pixels.
"""

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from ..datamanagers.images import load_images
from ..datamanagers.scene import ParsedScene
from ..rendering.cameras import Cameras
from ..rendering.lens import OPENCV, PINHOLE
from .initial import mutual_matches, root_sift

_LONGEST = 640
"""Longest side in pixels at which features are matched; by eye."""
_GROUPS = 6
"""Groups of neighbouring views, spread evenly over a capture, within which all pairs are matched; by eye."""
_GROUP_VIEWS = 4
"""Views of a group: 36 pairs in all take a second."""
_MIN_MATCHES = 1000
"""Matches below which nothing is estimated; by eye."""
_MAX_DISTANCE = 4.0
"""Distance from its epipolar line, without a lens, up to which a match is believed; by eye."""
_MAX_K1 = 0.1
"""Largest distortion that is looked for: matches have to be found on the lines of no distortion; by eye."""
_RANGE_PARTS = 16
"""Parts of the range that are tried first; the best one is then cut finer twice by as many."""
_MAX_COST_RATIO = 0.99
"""Cost with a lens over that without one, up to which it is believed: llff_flower has 0.982 and llff_fern 0.976;
captures that their reconstructions have undistorted (garden_seattle, city_ochota, m360_bonsai, drone_caliterra) 0.996
and more (lens.json).
"""
_MIN_CORNER_SHIFT = 0.5
"""Pixels by which it must move the corners; by eye: less is not seen."""


class Matches(NamedTuple):
    """M matches of two views: unit-depth tangents in both, and the essential matrix from the first to the
    second.
    """

    first: Annotated[NDArray[np.float64], "M 2"]
    second: Annotated[NDArray[np.float64], "M 2"]
    essential: Annotated[NDArray[np.float64], "3 3"]
    focal: float
    """Pixels."""


def with_k1(cameras: Cameras, k1: float) -> Cameras:
    """Cameras, those without a lens with the radial distortion `k1`."""
    if k1 == 0:
        return cameras
    plain = cameras.lens == PINHOLE
    distortion = cameras.distortion.clone()
    distortion[plain] = 0
    distortion[plain, 0] = k1
    return replace(cameras, distortion=distortion, lens=torch.where(plain, OPENCV, cameras.lens))


def estimate_k1(scene: ParsedScene) -> float:
    """Radial distortion of a capture at its own size; 0 where its cameras have lenses, or matches ask for none.

    Reads some of the photographs. Raises as `load_images`.
    """
    views = scene.train.tolist()
    if len(views) < _GROUP_VIEWS or bool((scene.cameras.lens[scene.train] != PINHOLE).any()):
        return 0.0
    longest = float(scene.cameras.size[scene.train].max())
    small = replace(scene, cameras=scene.cameras.scaled(max(1.0, longest / _LONGEST)))
    matches = matched_views(small, neighbouring_views(small))
    # The farthest corner, in focal lengths and in pixels.
    corner = (small.cameras.size[scene.train] / 2 / small.cameras.focal[scene.train]).norm(dim=1).max()
    return best_k1(matches, float(corner))


def best_k1(matches: Sequence[Matches], corner: float) -> float:
    """The k1 that matches ask for, 0 where they ask for none; `corner` is the tangent of the widest angle that is
    seen.
    """
    believed: list[Matches] = []
    for each in matches:
        near = np.abs(distances(each, 0.0)) < _MAX_DISTANCE
        believed.append(each._replace(first=each.first[near], second=each.second[near]))
    if sum(len(each.first) for each in believed) < _MIN_MATCHES:
        return 0.0
    best = 0.0
    width = _MAX_K1
    for _ in range(3):
        tried = best + np.linspace(-width, width, _RANGE_PARTS + 1)
        best = float(tried[np.argmin([cost(believed, k1) for k1 in tried])])
        width *= 2 / _RANGE_PARTS
    focal = float(np.mean([each.focal for each in believed]))
    shift = abs(best) * corner**3 * focal
    if shift < _MIN_CORNER_SHIFT or cost(believed, best) > _MAX_COST_RATIO * cost(believed, 0.0):
        return 0.0
    return best


def cost(matches: Sequence[Matches], k1: float) -> float:
    """Mean of d² / (1 + d²) over the distances d from epipolar lines (Geman and McClure 1985)."""
    parts = []
    for each in matches:
        square = np.square(distances(each, k1))
        parts.append(square / (1 + square))
    return float(np.concatenate(parts).mean())


def distances(matches: Matches, k1: float) -> Annotated[NDArray[np.float64], "M"]:
    """Distances in pixels of matches from each other's epipolar lines, once their lens is taken away (Sampson's
    approximation, times the root of two: of one of the two points).
    """
    first = _straightened(matches.first, k1)
    second = _straightened(matches.second, k1)
    line_of_first = first @ matches.essential.T
    line_of_second = second @ matches.essential
    error = (second * line_of_first).sum(1)
    slope = np.square(line_of_first[:, :2]).sum(1) + np.square(line_of_second[:, :2]).sum(1)
    apart: NDArray[np.float64] = error / np.sqrt(np.maximum(slope, np.finfo(np.float64).tiny) / 2)
    return matches.focal * apart


def _straightened(shown: Annotated[NDArray[np.float64], "M 2"], k1: float) -> NDArray[np.float64]:
    """Homogeneous tangents [M 3] that a lens shows at others: three steps of the fixed point r = shown / (1 + k1
    r²), which leave k1^4 of what the lens moves.
    """
    plain = shown
    for _ in range(3):
        plain = shown / (1 + k1 * np.square(plain).sum(1, keepdims=True))
    return np.concatenate([plain, np.ones((len(plain), 1))], 1)


def neighbouring_views(scene: ParsedScene) -> list[list[int]]:
    """Groups of training views that stand near one another and look alike, spread evenly over the capture."""
    views = np.array(scene.train.tolist())
    pose = scene.cameras.pose[scene.train].numpy()
    centre = pose[:, :, 3]
    axis = pose[:, :, 2]
    spread = max(float(np.linalg.norm(centre - centre.mean(0), axis=1).mean()), np.finfo(np.float32).tiny)
    groups = []
    for at in np.unique(np.linspace(0, len(views) - 1, _GROUPS).round().astype(int)):
        apart = np.linalg.norm(centre - centre[at], axis=1) / spread + 2 * (1 - axis @ axis[at])
        groups.append(views[np.argsort(apart, kind="stable")[:_GROUP_VIEWS]].tolist())
    return groups


def matched_views(scene: ParsedScene, groups: Sequence[Sequence[int]]) -> list[Matches]:
    """Matches of all pairs of views within groups, each pair once."""
    views = sorted({view for group in groups for view in group})
    features = {}
    for view, image in zip(views, load_images(scene, (0.0, 0.0, 0.0), views), strict=True):
        features[view] = root_sift(
            np.asarray(cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY), np.uint8)
        )
    pairs: set[tuple[int, ...]] = set()
    for group in groups:
        pairs.update(itertools.combinations(sorted(group), 2))
    found = []
    for a, b in sorted(pairs):
        p, q = mutual_matches(features[a].descriptors, features[b].descriptors)
        if len(p):
            first = _tangents(scene.cameras, a, features[a].places[p])
            second = _tangents(scene.cameras, b, features[b].places[q])
            focal = float(scene.cameras.focal[a].mean())
            found.append(Matches(first, second, _essential(scene.cameras, a, b), focal))
    return found


def _tangents(
    cameras: Cameras, view: int, pixel: Annotated[NDArray[np.float64], "M 2"]
) -> Annotated[NDArray[np.float64], "M 2"]:
    tangents: NDArray[np.float64] = (pixel - cameras.centre[view].numpy()) / cameras.focal[view].numpy()
    return tangents


def _essential(cameras: Cameras, a: int, b: int) -> Annotated[NDArray[np.float64], "3 3"]:
    """E with x_b^T E x_a = 0 for what two views see of one point, E = [t]x R."""
    opencv = np.array([1.0, -1.0, -1.0])
    first = cameras.pose[a].numpy()
    second = cameras.pose[b].numpy()
    axes = second[:, :3] * opencv
    turn = axes.T @ (first[:, :3] * opencv)
    x, y, z = axes.T @ (first[:, 3] - second[:, 3])
    across = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    essential: NDArray[np.float64] = across @ turn
    return essential
