"""Finding the very place that a photograph shows among views of a scene: local features that agree on one
affine map from a view to the photograph, and colours on both sides.

Letters: P keypoints, M samples of a view, N pairs of colours, D semantic channels. Colours are sRGB in [0, 1],
positions pixels (x to the right, y down, centres at +0.5).

Keypoints are SIFT (Lowe, IJCV 2004) on evened contrast, which finds façades again by night; matches are mutual
nearest neighbours by Lowe's ratio; the map is found by RANSAC (Fischler and Bolles 1981), as a similarity, then
refined to an affine one. Of 5348 pairs of unrelated photographs 7 matches agree at most.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from ..errors import CheckpointError
from .matching import unit

_VIEW_KEYPOINTS = 500
"""Keypoints of a view, at most: matching those of 32 views with a photograph takes 0.06 s."""
_PHOTOGRAPH_KEYPOINTS = 800
"""Keypoints of a photograph, at most."""
_CONTRAST_THRESHOLD = 0.01
"""Least contrast of a keypoint: a quarter of OpenCV's, since nights have little."""
_EVENED_TILES = 4
"""Parts of a side within which contrast is evened."""
_EVENED_LIMIT = 4.0
"""Limit of the evened contrast: above, noise gets keypoints."""
_DESCRIPTOR_SCALE = 512.0
"""Roots of descriptors of unit sum, times this, are whole numbers below 256."""
_MAX_RATIO = 0.8
"""Lowe's ratio of squared distances, below which a match is told from the next best."""
_TOLERANCE_SHARE = 0.0125
"""Share of the photograph's longer side within which a match agrees with the map."""
_MIN_AGREEING = 10
"""Matches that agree, at least: unrelated photographs have 7 at most."""
_MIN_AGREEING_SHARE = 0.42
"""Their share of all matches that the map brings into the photograph: façades that are built alike agree, while
what is around them does not. Towns of the same houses reach 0.1 to 0.52, one place in two lights 0.43 to 0.98.
"""
_MIN_SURE_AGREEING = 25
"""Matches that agree in the best view, from which on nobody looks closer: towns of the same houses reach 17."""
_MIN_HINT = 5
"""Matches that agree, with which a view is looked at more closely, where no view has so many."""
_MAX_HINTS = 3
"""Views that are looked at more closely: each is drawn again."""
_CLOSE_SIDE_PIXELS = 640
"""Longer side of views and photographs at a closer look: at twice 160 pixels towns of the same houses have 0.35 of
their matches agree, at four times 0.23.
"""
_CLOSE_KEYPOINTS = 1500
"""Keypoints of a view and of a photograph at a closer look, at most."""
_MIN_CLOSE_AGREEING = 12
"""Matches that agree at a closer look, at least: of unrelated photographs 8 do at most."""
_MIN_CLOSE_SHARE = 0.25
"""Their share of all matches that the map brings into the photograph: 48 pictures of towns of the same houses reach
0.23, one place from two sides 0.23 to 0.51.
"""
_MIN_VIEW_SHARE = 0.5
"""Share of the best view's agreeing matches that other views need: fewer mean another side of the place, where
one affine map does not hold.
"""
_MAX_VIEWS = 2
"""Views that colours are compared in: each is drawn, in 0.04 s at 90 000 Gaussians; a third brings nothing."""
_HYPOTHESES = 1000
"""Maps that RANSAC tries."""
_MAX_SCALE = 5.0
"""Largest and, inverted, smallest scale of a map."""
_REFINEMENTS = 3
"""Fits of the affine map, each to the matches that agree with the one before."""
VIEW_SAMPLES = 4096
"""Pixels of a view whose colours are compared, about."""
_MAX_OTHER_COSINE = 0.3
"""Cosine of semantics of scene and photograph up to which these show two things."""
_MIN_SAME_COSINE = 0.5
"""Cosine from which on they show one."""
_BLURRED_SHARE = 0.01
"""Half a side of the box that colours are means of on both sides, as a share of the longer side of a picture:
about what the map is off by.
"""


class Keypoints(NamedTuple):
    """Local features of one picture."""

    position: Annotated[Tensor, "P 2"]
    """float32."""
    descriptor: Annotated[Tensor, "P 128"]
    """Roots of SIFT descriptors of unit sum, times 512, uint8."""


class ViewSamples(NamedTuple):
    """Pixels of a view of a scene as captured."""

    pixel: Annotated[Tensor, "M 2"]
    colour: Annotated[Tensor, "M 3"]
    semantic: Annotated[Tensor, "M D"]
    """In the scene's basis."""
    eye: Annotated[Tensor, "3"]
    """Position of the camera, world units."""
    rays: Callable[[Annotated[Tensor, "N 2"]], Annotated[Tensor, "N 3"]]
    """Unit directions in the world through pixels, inside of the view or beyond."""


class Landmarks(NamedTuple):
    """Views of a scene by which photographs of the very place are told."""

    keypoints: tuple[Keypoints, ...]
    samples: Callable[[int], ViewSamples]
    """Samples of a view by its number: asked for where it shows what a photograph does."""
    closer: Callable[[int], Keypoints] | None = None
    """`close_keypoints` of a view by its number, drawn larger: asked for where matches are too few to tell; None =
    nobody looks.
    """


class Pairs(NamedTuple):
    """Colours of a scene, and what a photograph of the very place shows there."""

    own: Annotated[Tensor, "N 3"]
    shown: Annotated[Tensor, "N 3"]
    semantic: Annotated[Tensor, "N D"]
    """Of the scene."""
    agreeing: int
    """Matches that agree in the best view."""
    eye: Annotated[Tensor, "3"]
    """Position of the camera of the best view, world units."""
    toward: Annotated[Tensor, "N 3"]
    """Unit directions from there."""
    pixel: Annotated[Tensor, "N 2"]
    """Pixels of the photograph (x, y, int64)."""
    weight: Annotated[Tensor, "N"]
    """Likeness of what the photograph shows there to what the scene has, in [0, 1]; 0 of something else before it."""


class Registration(NamedTuple):
    """An affine map between pictures, and how many matches agree with it."""

    matrix: Annotated[Tensor, "2 3"]
    """(x, y, 1) of the first to (x, y) of the second picture, float64."""
    agreeing: int
    share: float
    """Their share of the matches that the map brings into the second picture."""


def view_keypoints(image: Annotated[Tensor, "H W 3"]) -> Keypoints:
    """The keypoints of a view that are kept."""
    return find_keypoints(image, _VIEW_KEYPOINTS)


def close_size(size: tuple[int, int]) -> tuple[int, int]:
    """Width and height of a view or photograph of a size at a closer look: never smaller."""
    scale = max(1.0, _CLOSE_SIDE_PIXELS / max(size))
    return round(scale * size[0]), round(scale * size[1])


def close_keypoints(
    image: Annotated[Tensor, "H W 3"], size: tuple[int, int], where: Annotated[Tensor, "H W"] | None = None
) -> Keypoints:
    """The keypoints of a picture of a `close_size`, at positions of the picture at its `size` (width, height)."""
    found = find_keypoints(image, _CLOSE_KEYPOINTS, where)
    smaller = torch.tensor([size[0] / image.shape[1], size[1] / image.shape[0]])
    return found._replace(position=found.position * smaller)


def find_keypoints(
    image: Annotated[Tensor, "H W 3"], count: int, where: Annotated[Tensor, "H W"] | None = None
) -> Keypoints:
    """At most so many keypoints of a picture, the strongest; `where` (bool) leaves others out."""
    pixels = (image.detach().cpu() * 255).round().clamp(0, 255).byte().numpy()
    grey = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
    even = cv2.createCLAHE(_EVENED_LIMIT, (_EVENED_TILES, _EVENED_TILES)).apply(grey)
    mask = None if where is None else where.cpu().numpy().astype(np.uint8)
    sift = cv2.SIFT.create(nfeatures=count, contrastThreshold=_CONTRAST_THRESHOLD)
    found, descriptors = sift.detectAndCompute(even, mask)
    if descriptors is None:
        return Keypoints(torch.zeros(0, 2), torch.zeros(0, 128, dtype=torch.uint8))
    # OpenCV's pixel centres are whole numbers.
    position = torch.tensor([each.pt for each in found[:count]], dtype=torch.float32) + 0.5
    table = torch.from_numpy(np.asarray(descriptors[:count], dtype=np.float32))
    root = (table / table.sum(1, keepdim=True).clamp_min(1e-6)).sqrt()
    return Keypoints(position, (root * _DESCRIPTOR_SCALE).round().clamp_max(255).byte())


def matches(
    a: Annotated[Tensor, "P 128"], b: Annotated[Tensor, "Q 128"]
) -> tuple[Annotated[Tensor, "N"], Annotated[Tensor, "N"]]:
    """Indices of descriptors (of `Keypoints`, as floats) that are each other's nearest, and much nearer than
    the next.
    """
    if len(a) == 0 or len(b) < 2:
        none = torch.zeros(0, dtype=torch.int64)
        return none, none
    # Descriptors have the length of their scale, all but for rounding.
    alike = a @ b.T
    best, nearest = alike.topk(2, dim=1)
    distance = 2 - 2 * best / _DESCRIPTOR_SCALE**2
    back = alike.argmax(0)
    mutual = back[nearest[:, 0]] == torch.arange(len(a))
    chosen = (mutual & (distance[:, 0] < _MAX_RATIO * distance[:, 1])).nonzero()[:, 0]
    return chosen, nearest[chosen, 0]


def register(
    a: Annotated[Tensor, "N 2"], b: Annotated[Tensor, "N 2"], size: tuple[int, int], least: int
) -> Registration | None:
    """The affine map that most matched positions agree with; None where less than `least` do.

    `size` is width and height of the second picture.
    """
    tolerance = _TOLERANCE_SHARE * max(size)
    if len(a) < least:
        return None
    similar, agrees = cv2.estimateAffinePartial2D(
        a.numpy(),
        b.numpy(),
        method=cv2.RANSAC,
        ransacReprojThreshold=tolerance,
        maxIters=_HYPOTHESES,
        confidence=0.999,
    )
    if similar is None or int(agrees.sum()) < least:
        return None
    best = torch.from_numpy(np.asarray(similar, dtype=np.float64))
    if not _sound(best):
        return None
    agreeing = int(agrees.sum())
    # A façade is seen from another side: six numbers instead of four, where they hold for as many matches.
    near = torch.from_numpy(agrees[:, 0] > 0)
    x = torch.cat([a.double(), a.new_ones(len(a), 1).double()], 1)
    for _ in range(_REFINEMENTS):
        matrix = torch.linalg.lstsq(x[near], b[near].double(), driver="gelsd").solution.T
        near = (x @ matrix.T - b.double()).norm(dim=1) < tolerance
        # Matches along a line say nothing of the scale across it.
        if int(near.sum()) < agreeing or not _sound(matrix):
            break
        best = matrix
        agreeing = int(near.sum())
    landed = _within(x @ best.T, size)
    return Registration(best, agreeing, agreeing / max(1, int(landed.sum())))


def _sound(matrix: Annotated[Tensor, "2 3"]) -> bool:
    """True for an affine map of a scale in the range of scales; it has an inverse then."""
    scale = math.sqrt(abs(float(torch.linalg.det(matrix[:, :2]))))
    return 1 / _MAX_SCALE < scale < _MAX_SCALE


def _within(at: Annotated[Tensor, "N 2"], size: tuple[int, int]) -> Annotated[Tensor, "N"]:
    """Mask (bool) of the positions that lie in a picture of a size (width, height)."""
    return ((at >= 0) & (at < at.new_tensor(size))).all(1)


def find_place(
    landmarks: Landmarks,
    image: Annotated[Tensor, "H W 3"],
    where: Annotated[Tensor, "H W"] | None = None,
    closer: Callable[[], Keypoints] | None = None,
) -> Pairs | None:
    """Colours of a scene and of a photograph that shows the very place; None where it shows another.

    Only pixels that are `where` (bool; None = all) count. `closer` are the `close_keypoints` of the photograph, asked
    for where views have some matches, but too few to be sure; None = nobody looks.
    """
    size = (image.shape[1], image.shape[0])
    known = _registered(landmarks, find_keypoints(image, _PHOTOGRAPH_KEYPOINTS, where), size)
    found = []
    for each, view in known:
        if each.agreeing >= _MIN_AGREEING and each.share >= _MIN_AGREEING_SHARE:
            found.append((each, view))
    sure = bool(found) and found[0][0].agreeing >= _MIN_SURE_AGREEING
    if known and not sure and closer is not None and landmarks.closer is not None:
        found = _closely_registered(
            landmarks.closer, [view for _, view in known[:_MAX_HINTS]], closer(), size
        )
    if not found:
        return None
    least = _MIN_VIEW_SHARE * found[0][0].agreeing
    parts = []
    smooth = blurred(image)
    best = landmarks.samples(found[0][1])
    for each, view in found[:_MAX_VIEWS]:
        if each.agreeing >= least:
            samples = best if view == found[0][1] else landmarks.samples(view)
            parts.append(_seen_in(samples, each, smooth, where))
    own, shown, semantic, at = (torch.cat(each) for each in zip(*parts, strict=True))
    if len(own) == 0:
        return None
    # What several views show lies where the best one would see it.
    matrix = found[0][0].matrix
    pixel = torch.linalg.solve(matrix[:, :2], (at - matrix[:, 2]).T).T
    ones = torch.ones(len(own))
    return Pairs(own, shown, semantic, found[0][0].agreeing, best.eye, best.rays(pixel), at.long(), ones)


def weighed(pairs: Pairs, there: Annotated[Tensor, "N D"], centre: Annotated[Tensor, "D"]) -> Pairs | None:
    """The pairs, each by how alike semantics of the scene and of the photograph are: `there` at their pixels, `centre` is
    that of the scene's. None where nothing is alike.

    A branch before the sky, people on stairs and all else that only the photograph has are seen by that.
    """
    alike = (unit(pairs.semantic, centre) * unit(there.to(pairs.semantic), centre)).sum(1)
    weight = (alike - _MAX_OTHER_COSINE) / (_MIN_SAME_COSINE - _MAX_OTHER_COSINE)
    return pairs._replace(weight=weight.clamp(0, 1)) if bool((weight > 0).any()) else None


def _registered(
    landmarks: Landmarks, photograph: Keypoints, size: tuple[int, int]
) -> list[tuple[Registration, int]]:
    """Maps from views to a photograph of a size (width, height) that some matches agree with, and the views' numbers:
    those with most first.
    """
    there = photograph.descriptor.float()
    found = []
    for view, keypoints in enumerate(landmarks.keypoints):
        first, second = matches(keypoints.descriptor.float(), there)
        known = register(keypoints.position[first], photograph.position[second], size, _MIN_HINT)
        if known is not None:
            found.append((known, view))
    return sorted(found, key=lambda each: -each[0].agreeing)


def _closely_registered(
    closer: Callable[[int], Keypoints], views: Sequence[int], photograph: Keypoints, size: tuple[int, int]
) -> list[tuple[Registration, int]]:
    """The same of some views at a closer look, of those that show the place.

    A place from another side, or by night, has a few matches that agree, as towns of the same houses have; the larger
    both are drawn, the more of its matches do, and the fewer of theirs.
    """
    there = photograph.descriptor.float()
    found = []
    for view in views:
        keypoints = closer(view)
        first, second = matches(keypoints.descriptor.float(), there)
        known = register(keypoints.position[first], photograph.position[second], size, _MIN_CLOSE_AGREEING)
        if known is not None and known.share >= _MIN_CLOSE_SHARE:
            found.append((known, view))
    return sorted(found, key=lambda each: -each[0].agreeing)


def _seen_in(
    view: ViewSamples,
    known: Registration,
    image: Annotated[Tensor, "H W 3"],
    where: Annotated[Tensor, "H W"] | None,
) -> tuple[
    Annotated[Tensor, "N 3"], Annotated[Tensor, "N 3"], Annotated[Tensor, "N D"], Annotated[Tensor, "N 2"]
]:
    """Colours of the view and of the photograph, semantics of the view and pixels (x, y) of the photograph, of the
    samples that lie in the photograph.
    """
    height, width = image.shape[:2]
    at = view.pixel.double() @ known.matrix[:, :2].T + known.matrix[:, 2]
    inside = _within(at, (width, height))
    at = at[inside]
    x, y = at.long().unbind(1)
    shown = image.cpu()[y, x]
    own = view.colour[inside]
    semantic = view.semantic[inside]
    if where is None:
        return own, shown, semantic, at
    counts = where.cpu()[y, x]
    return own[counts], shown[counts], semantic[counts], at[counts]


def blurred(image: Annotated[Tensor, "H W C"]) -> Annotated[Tensor, "H W C"]:
    """Means over a small box around each pixel."""
    reach = round(_BLURRED_SHARE * max(image.shape[:2]))
    pixels = np.ascontiguousarray(image.detach().cpu().float().numpy())
    return torch.from_numpy(np.asarray(cv2.blur(pixels, (2 * reach + 1, 2 * reach + 1))).reshape(image.shape))


def keypoint_tensors(views: Sequence[Keypoints]) -> dict[str, Tensor]:
    """Keypoints for a file of tensors: those of all views, and how many each has."""
    return {
        "position": torch.cat([view.position for view in views]),
        "descriptor": torch.cat([view.descriptor for view in views]),
        "count": torch.tensor([len(view.position) for view in views]),
    }


def keypoints_from(tensors: Mapping[str, Tensor]) -> tuple[Keypoints, ...]:
    """Read the tensors of `keypoint_tensors`; none where there are none.

    Raises CheckpointError where tables are missing or do not fit each other.
    """
    if not tensors:
        return ()
    try:
        counts = tensors["count"].tolist()
        tables = (tensors["position"].float(), tensors["descriptor"].byte())
    except KeyError as error:
        raise CheckpointError(f"keypoints of a scene: {error} is missing; find them again") from error
    for table, channels in zip(tables, (2, 128), strict=True):
        if tuple(table.shape) != (sum(counts), channels) or min(counts, default=0) < 0:
            raise CheckpointError(
                f"keypoints of a scene: {tuple(table.shape)} for {sum(counts)}; find them again"
            )
    views = []
    for position, descriptor in zip(*(torch.split(table, counts) for table in tables), strict=True):
        views.append(Keypoints(position, descriptor))
    return tuple(views)
