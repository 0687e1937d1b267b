"""Images that were taken with one lens, where no EXIF block says so, as after a messenger.

All images of one size share a lens at first. Then every image gets a focal length of its own in a bundle
adjustment of some points: two phones show as two clusters of focal lengths. Images are grouped by these clusters,
and by what else tells them apart (folders, names, how their JPEGs were encoded); each grouping is adjusted again,
and one with more lenses is taken where the points then lie clearly nearer to where the images see them.

Focal lengths are in pixels, errors are mean distances of points from where they are seen, in pixels.
"""

import itertools
import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Annotated, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Images: TypeAlias = Mapping[str, Mapping[str, Any]]
"""Images by name: width, height, lens (model, focal length, focal length on 35 mm film), encoder."""
Labels: TypeAlias = dict[str, str]
"""The lens of each image, by any word."""

MIN_IMAGES_OF_LENS = 3
"""Images that a lens of its own is believed of: one or two may be badly placed. By eye."""
MAX_LENSES = 4
"""Lenses of one size that are told apart. By eye: people and their phones on one walk."""
MIN_ERROR_DROP_SHARE = 0.03
"""Share of the error by which it must fall for more lenses. Another lens by 7 % takes 5 to 16 % off; groups at
random of one lens take off less than 0.2 %."""
MIN_DROP_FOR_EACH_SHARE = 0.4
"""Share of the error by which it must fall for a lens an image, as in a video that zooms: a focal length for
each image fits noise too, most over flat ground. Five captures of one lens fall by 1 to 19 %."""
MIN_SEPARATION = 5.0
"""Distance of neighbouring clusters, in deviations within them: halves of an even spread reach 3.5, halves of a
normal one 2.7, two lenses by 7 % 6 and more."""
MIN_GAP_RATIO = 1.5
"""The gap between neighbouring clusters, in the largest gaps within them: one of 6000 draws of 60 images from an even or
a normal spread passes then, one of 60 of 20 images, which residuals refuse."""
MIN_FOCAL_RATIO = 1.02
"""Ratio of the focal lengths of two lenses: a lens that focuses breathes by as much. By eye."""
MIN_LOST_SHARE = 0.1
"""Share of the images that find matches but no pose from which a lens for each of them is tried: a lens that is
twice as long is not posed at all by that of the others. By eye: fewer are lost in most captures."""
_MEDIAN_TO_DEVIATION = 1.4826
"""Deviation of a normal distribution, in medians of its absolute values."""


@dataclass(frozen=True, kw_only=True)
class Grouping:
    """Images by lens, and what told them apart."""

    lenses: Labels
    reason: str

    @property
    def count(self) -> int:
        """Count of lenses."""
        return len(set(self.lenses.values()))


@dataclass(frozen=True, kw_only=True)
class Trial:
    """A grouping after bundle adjustment."""

    grouping: Grouping
    error: float
    focal: Mapping[str, float]
    """Of each image."""


def shared_lenses(images: Images) -> Labels:
    """Images of one size, model and focal length share a lens."""
    labels = {}
    for name, image in images.items():
        labels[name] = f"{image['width']}x{image['height']} {list(image['lens'])}"
    return labels


def unsaid_lenses(images: Images) -> list[str]:
    """Images whose file says no focal length, of sizes that have enough of them for two lenses."""
    labels = shared_lenses(images)
    unsaid = []
    for name, image in images.items():
        _, focal, focal_35 = image["lens"]
        if not focal and not focal_35:
            unsaid.append(name)
    count = Counter(labels[name] for name in unsaid)
    found: list[str] = []
    for name in unsaid:
        if count[labels[name]] >= 2 * MIN_IMAGES_OF_LENS:
            found.append(name)
    return found


def unsaid_sentence(images: Images) -> str:
    """Unknowns about the lenses of images without EXIF, in one line; empty where all say theirs."""
    unsaid = unsaid_lenses(images)
    if not unsaid:
        return ""
    hints = []
    for grouping in hinted_groupings(images):
        hints.append(grouping.reason)
    told = f"{len(unsaid)} of {len(images)} photographs say no focal length"
    if hints:
        return f"{told}, and their {' and '.join(hints)} hint at several cameras: residuals will tell"
    return f"{told}: those of one size share a lens, unless residuals tell them apart"


def own_lenses(images: Images) -> Grouping:
    """A lens for each image whose file says no focal length."""
    labels = shared_lenses(images)
    for name in unsaid_lenses(images):
        labels[name] = f"{labels[name]} {name}"
    return Grouping(lenses=labels, reason="each image")


def hinted_groupings(images: Images) -> list[Grouping]:
    """Groupings by folder, by name without numbers, and by how JPEGs were encoded, where these make few groups."""
    folders = {}
    stems = {}
    encoders = {}
    for name in unsaid_lenses(images):
        path = PurePosixPath(name)
        folders[name] = path.parent.as_posix()
        stems[name] = re.sub("[0-9]+", "#", path.stem)
        encoders[name] = str(images[name].get("encoder", ""))
    found = []
    for reason, hints in (("folders", folders), ("names", stems), ("encoders", encoders)):
        count = Counter(hints.values())
        if 2 <= len(count) <= MAX_LENSES and min(count.values()) >= MIN_IMAGES_OF_LENS:
            labels = shared_lenses(images)
            for name, hint in hints.items():
                labels[name] = f"{labels[name]} {hint}"
            found.append(Grouping(lenses=labels, reason=reason))
    return found


def clustered_groupings(images: Images, focal: Mapping[str, float]) -> list[Grouping]:
    """Groupings by clusters of the images' own focal lengths, of each size for itself, where these lie apart."""
    shared = shared_lenses(images)
    sizes: dict[str, list[str]] = {}
    for name in unsaid_lenses(images):
        if focal.get(name, 0) > 0:
            sizes.setdefault(shared[name], []).append(name)
    found = []
    for count in range(2, MAX_LENSES + 1):
        labels = dict(shared)
        for names in sizes.values():
            values = np.log([focal[name] for name in names])
            cluster = cluster_values(values, count)
            if cluster is not None:
                for name, number in zip(names, cluster.tolist(), strict=True):
                    labels[name] = f"{shared[name]} {number}"
        if labels != shared:
            found.append(Grouping(lenses=labels, reason="focal lengths"))
    return found


def cluster_values(
    values: Annotated[NDArray[np.float64], "N"], count: int
) -> Annotated[NDArray[np.int64], "N"] | None:
    """The cluster of each logarithm of a focal length, by size; None where `count` clusters do not lie apart.

    The clusters whose values lie nearest to their medians in all, of at least MIN_IMAGES_OF_LENS each.
    """
    total = len(values)
    if total < count * MIN_IMAGES_OF_LENS:
        return None
    order = np.argsort(values, kind="stable")
    edges = _best_edges(values[order], count)
    cluster = np.empty(total, dtype=np.int64)
    centres = []
    within = []
    gaps = []
    for number, (low, high) in enumerate(itertools.pairwise(edges)):
        part = values[order[low:high]]
        cluster[order[low:high]] = number
        centres.append(float(np.median(part)))
        within.append(np.abs(part - centres[-1]))
        gaps.append(float(np.diff(part).max()))
    deviation = _MEDIAN_TO_DEVIATION * float(np.median(np.concatenate(within)))
    least = min(np.diff(centres))
    if least < max(MIN_SEPARATION * deviation, math.log(MIN_FOCAL_RATIO)):
        return None
    between = []
    for edge in edges[1:-1]:
        between.append(float(values[order[edge]] - values[order[edge - 1]]))
    if min(between) < MIN_GAP_RATIO * max(gaps):
        return None
    return cluster


def _best_edges(ordered: Annotated[NDArray[np.float64], "N"], count: int) -> list[int]:
    """Beginnings of the clusters of sorted values, and the end of the last, by dynamic programming."""
    total = len(ordered)
    sums = np.concatenate([[0.0], np.cumsum(ordered)])
    # costs[j]: of the best clusters of the first j values; starts[k][j]: where the last of k + 1 of them begins.
    costs = np.array([0.0] + [math.inf] * total)
    starts = []
    for _ in range(count):
        longer = np.full(total + 1, math.inf)
        begin = np.zeros(total + 1, dtype=np.int64)
        for end in range(MIN_IMAGES_OF_LENS, total + 1):
            low = np.arange(end - MIN_IMAGES_OF_LENS + 1)
            middle = (low + end) // 2
            # Distances from the median: what lies above less what lies below, without the middle of odd ones.
            above = sums[end] - sums[(low + end + 1) // 2]
            below = sums[middle] - sums[low]
            cost = costs[low] + above - below
            begin[end] = int(np.argmin(cost))
            longer[end] = cost[begin[end]]
        costs = longer
        starts.append(begin)
    edges = [total]
    for begin in reversed(starts):
        edges.append(int(begin[edges[-1]]))
    return edges[::-1]


def choose_trial(trials: Sequence[Trial]) -> Trial:
    """The first trial, or one with more lenses, each step of which lowers the error clearly.

    Of groupings with as many lenses the one with the smallest error counts; a lens an image needs more.
    """
    best = trials[0]
    for trial in sorted(trials[1:], key=lambda each: (each.grouping.count, each.error)):
        share = MIN_ERROR_DROP_SHARE
        if trial.grouping.count > MAX_LENSES * trials[0].grouping.count:
            share = MIN_DROP_FOR_EACH_SHARE
        if trial.error <= (1 - share) * best.error:
            best = trial
    return best


def better_models(first: Sequence[Mapping[str, Any]], second: Sequence[Mapping[str, Any]]) -> bool:
    """True where the second reconstruction poses more images than the first, or as many with clearly smaller
    error.
    """
    if not second or not first:
        return bool(second)
    before = first[0]
    after = second[0]
    if len(after["images"]) != len(before["images"]):
        return len(after["images"]) > len(before["images"])
    return bool(after["error_pixels"] <= (1 - MIN_ERROR_DROP_SHARE) * before["error_pixels"])


def lens_sentence(trial: Trial, before: Mapping[str, Any], after: Mapping[str, Any]) -> str:
    """Decision about lenses, in one line; `before` and `after` are reconstructions."""
    focal: dict[str, list[float]] = {}
    for name, lens in trial.grouping.lenses.items():
        if name in trial.focal:
            focal.setdefault(lens, []).append(trial.focal[name])
    told = []
    for values in sorted(focal.values(), key=lambda each: float(np.median(each))):
        told.append(f"{np.median(values):.0f} px in {len(values)} images")
    if len(told) > MAX_LENSES:
        told = [f"{told[0].split(' in ')[0]} to {told[-1].split(' in ')[0]}"]
    posed = f"{len(after['images'])} instead of {len(before['images'])} posed, "
    if len(after["images"]) == len(before["images"]):
        posed = ""
    return (
        f"lenses: {len(focal)}, told apart by {trial.grouping.reason} and by residuals (focal lengths {', '.join(told)}): "
        f"{posed}{after['error_pixels']:.2f} instead of {before['error_pixels']:.2f} pixels off"
    )
