"""Ground truth of restyling: a trained town, its true looks in other palettes, references from other towns,
and scores.

The truth of a palette is the same town rendered in it through the same cameras. Shadows and lit windows
follow from the palette's sun and the town's geometry; no photograph of another town tells them, so that part
of the distance cannot be closed.

References: `one` is a view along a street of another town. `three` are views of three towns, of which one
shows mostly façades, one plants, one road and sky; each is the view of a walk (façades and plants through a
longer lens) that shows most of its part.

Match rates: a style code's class is the most frequent one among the reference's pixels nearest to its key. A
pixel of a view is right if the code that it takes most of has its own true class. Classes that no reference
shows do not count.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from fprf.errors import DataError, UsageError
from fprf.ops.config import GuidedConfig
from fprf.rendering.cameras import Cameras
from fprf.run_config import RunConfig
from fprf.scenes import Scene, SceneView
from fprf.style.dictionary import Encoders, StyleDictionary
from fprf.style.statistics import monge
from fprf.training.prepare import read_scene
from fprf.training.run import Known

from ..single_image import encoded
from ..style_metrics import mean_scores
from .layout import Town, build_town
from .palettes import palette
from .render import View, geometry, render, walk
from .surface import CAR, CLASSES, DOOR, FACADE, FOLIAGE, LAMP, LAWN, ROAD, ROOF, SIDEWALK, SKY, TRUNK, WINDOW
from .write import TownSettings, is_town

_STEP = 0.12
"""Metres between frames of the path: 7 frames on, near things have moved by a quarter of a small picture."""
_TURN = math.radians(0.8)
"""Between frames, to the left."""
_OFF = 0.01
"""By what share focal lengths and centres may differ from those of a town's camera."""


Row = dict[str, float | None]


class Truth(NamedTuple):
    """Class of what a pixel shows; palettes change none of it."""

    depth: Annotated[Tensor, "H W"]
    """Metres along the unit ray, inf = sky."""
    labels: Annotated[Tensor, "H W"]
    """int64, see `benchmarks.town.surface`."""


class Stage(NamedTuple):
    """A trained town and the cameras that it is judged from."""

    scene: Scene
    settings: TownSettings
    town: Town
    views: Cameras
    shown: Sequence[SceneView]
    """The judged views."""
    truth: Sequence[Truth]
    path: Cameras
    passed: Sequence[SceneView]
    """The frames of the path."""
    path_truth: Sequence[Truth]


def set_stage(
    scene: Scene,
    known: Known,
    settings: TownSettings,
    *,
    views: int,
    frames: int,
    longest: int,
    stride: float = 1.0,
) -> Stage:
    """Held-out views, evenly spread, and a path that begins at one of them (no frames, no path; longer steps
    with `stride`).
    """
    town = build_town(settings.seed, settings.extra)
    held_out = known.test or known.train
    count = min(views, len(held_out))
    chosen = torch.tensor([held_out[i * len(held_out) // count] for i in range(count)])
    cameras = known.cameras.scaled(max(1.0, float(known.cameras.size.amax()) / longest))
    judged = cameras.select(chosen)
    path = short_path(judged.select(torch.tensor([count // 2])), frames, stride)

    def cached(of: Cameras) -> list[SceneView]:
        return [scene.cached(of, i) for i in range(len(of))]

    def true(of: Cameras) -> list[Truth]:
        geometries = [geometry(town, town_view(of, i)) for i in range(len(of))]
        return [
            Truth(torch.from_numpy(depth), torch.from_numpy(labels.astype("int64")))
            for depth, labels in geometries
        ]

    return Stage(scene, settings, town, judged, cached(judged), true(judged), path, cached(path), true(path))


def town_folder(config: RunConfig) -> Path | None:
    """Folder of the town that a run was trained on; None where it was another scene."""
    folder = read_scene(config).paths[0].parents[1]
    return folder if is_town(folder) else None


def town_settings(config: RunConfig) -> TownSettings:
    """The town that a run was trained on. Raises UsageError where there is none, DataError for a bad
    record.
    """
    folder = town_folder(config)
    if folder is None:
        raise UsageError(
            f"the run was trained on {config.data}, whose looks in other light nobody knows; "
            "train a town: `python -m benchmarks town FOLDER`, `fprf train fprf-lite --data FOLDER`"
        )
    record = folder / "town.json"
    try:
        return TownSettings(**json.loads(record.read_text(encoding="utf-8"))["settings"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(
            f"{record}: {error}; remove the folder {folder} and let it be rendered again"
        ) from error


def town_view(cameras: Cameras, view: int) -> View:
    """The town's own camera of a view. Raises DataError for one that is no centred pinhole."""
    width, height = (int(v) for v in cameras.size[view])
    focal = cameras.focal[view].tolist()
    centre = cameras.centre[view].tolist()
    off = max(abs(focal[1] / focal[0] - 1), abs(2 * centre[0] / width - 1), abs(2 * centre[1] / height - 1))
    if int(cameras.lens[view]) != 0 or off > _OFF:
        raise DataError(
            f"view {view}: no centred pinhole with square pixels at {width}x{height}; choose another --longest"
        )
    return View(cameras.pose[view].cpu().numpy(), (focal[0] + focal[1]) / 2, width, height)


def true_views(stage: Stage, light: str) -> list[Annotated[Tensor, "H W 3"]]:
    """The judged views as they are in the palette, in [0, 1]."""
    look = palette(light)
    pictures = [render(stage.town, town_view(stage.views, i), look).rgb for i in range(len(stage.views))]
    return [torch.from_numpy(picture).float() / 255 for picture in pictures]


def short_path(start: Cameras, frames: int, stride: float = 1.0) -> Cameras:
    """A few steps onward from a camera, slowly turning to the left: neighbouring frames see nearly the
    same.
    """
    path = start.select(torch.zeros(frames, dtype=torch.int64))
    pose = path.pose.clone()
    ahead = -start.pose[0, :2, 2]
    ahead = ahead / ahead.norm().clamp_min(1e-9)
    for step in range(frames):
        k = stride * step
        turn = pose.new_tensor(
            [
                [math.cos(k * _TURN), -math.sin(k * _TURN), 0],
                [math.sin(k * _TURN), math.cos(k * _TURN), 0],
                [0, 0, 1],
            ]
        )
        pose[step, :, :3] = turn @ pose[step, :, :3]
        pose[step, :2, 3] += k * _STEP * ahead
    return replace(path, pose=pose)


PARTS = {"facades": (FACADE, WINDOW, DOOR), "plants": (FOLIAGE, LAWN, TRUNK), "street": (ROAD, SIDEWALK, SKY)}
"""Main colour of each of three references."""
_WALK = 20
_STREET_VIEW = 9
"""The view of the walk that stands for a whole street."""
_LENS = {"facades": 2.4, "plants": 2.4, "street": 1.0}
"""Focal length of the searching views, relative to the usual: façades and plants fill the frame."""
_SEARCHED = 40
"""Pixels across a view while its classes are counted."""


class Place(NamedTuple):
    """Viewpoint of a reference."""

    name: str
    seed: int
    view: View


class Reference(NamedTuple):
    """A photograph of a place in some light."""

    name: str
    image: Annotated[Tensor, "H W 3"]
    classes: Annotated[Tensor, "H W"]


def places(seeds: Sequence[int], size: tuple[int, int]) -> dict[str, tuple[Place, ...]]:
    """The places of `one` and `three` in towns of these seeds; size is (width, height)."""
    width, height = size
    street = walk(seed=seeds[0], views=_WALK, width=width, height=height)[_STREET_VIEW]
    references = {"one": (Place("street", seeds[0], street),), "three": ()}
    return references | {
        "three": tuple(_most(part, seed, size) for part, seed in zip(PARTS, seeds, strict=False))
    }


def photograph(place: Place, light: str) -> Reference:
    """The place in a palette. Raises DataError for a palette that does not exist."""
    picture = render(build_town(place.seed), place.view, palette(light))
    image = torch.from_numpy(picture.rgb).float() / 255
    return Reference(f"{light}-{place.name}", image, torch.from_numpy(picture.labels.astype("int64")))


def shows(labels: NDArray[np.uint8], part: str) -> float:
    """Share of a view that its part fills; of several things that must all be seen, counts the one seen
    least.
    """
    shares = [float(np.mean(labels == kind)) for kind in PARTS[part]]
    return sum(shares) if part != "street" else 2 * min(shares[0] + shares[1], shares[2])


def _most(part: str, seed: int, size: tuple[int, int]) -> Place:
    width, height = size
    town = build_town(seed)
    best = -1.0
    place = None
    for view in walk(seed=seed, views=_WALK, width=width, height=height):
        long = view._replace(focal=view.focal * _LENS[part])
        ratio = _SEARCHED / width
        small = View(long.pose, long.focal * ratio, _SEARCHED, max(1, round(height * ratio)))
        seen = shows(geometry(town, small)[1], part)
        if seen > best:
            best = seen
            place = Place(part, seed, long)
    assert place is not None
    return place


KINDS = {
    SKY: 0,
    LAWN: 1,
    FOLIAGE: 1,
    TRUNK: 1,
    ROAD: 2,
    SIDEWALK: 2,
    FACADE: 3,
    ROOF: 3,
    WINDOW: 3,
    DOOR: 3,
    LAMP: 4,
    CAR: 5,
}
"""Classes that belong together: sky, plants, ground, buildings, lamps, cars."""
CUT = {"sky": 0, "plants": 1, "ground": 2, "houses": 3}
"""Kinds that references can be without."""
_SHOWN = 0.005
"""Share of a reference from which on it shows a class."""
_REACH = 2
"""Pixels around one that must be of its class for it to lie inside."""


def without(reference: Reference, kind: str) -> Annotated[Tensor, "H W"]:
    """Pixels of a reference that show no such kind of thing, bool: the mask of a reference that lacks it."""
    return kinds_of(reference.classes) != CUT[kind]


def kinds_of(labels: Annotated[Tensor, "H W"]) -> Annotated[Tensor, "H W"]:
    """Kinds of classes (see KINDS), int64; -1 where a class has none."""
    kind = torch.full((max(KINDS) + 2,), -1)  # the last one stands for pixels without a class
    kind[list(KINDS)] = torch.tensor(list(KINDS.values()))
    return kind[labels]


def psnr_of_kind(
    pictures: Sequence[Annotated[Tensor, "H W 3"]], stage: Stage, truth: Sequence[Tensor], kind: str
) -> Row:
    """PSNR in dB over all pixels of a kind together (`inside`), and over all others (`elsewhere`)."""
    inside = torch.cat([(kinds_of(each.labels) == CUT[kind]).flatten() for each in stage.truth])
    apart = torch.cat(
        [(a - b).double().square().mean(-1).flatten() for a, b in zip(pictures, truth, strict=True)]
    )
    return {
        name: -10 * math.log10(max(float(apart[where].mean()), 1e-10)) if bool(where.any()) else None
        for name, where in (("inside", inside), ("elsewhere", ~inside))
    }


class Matched(NamedTuple):
    """Rates in [0, 1]; None where no pixel could be right."""

    match: float | None
    """Pixels that take a code of their own class."""
    match_inside: float | None
    """The same of pixels that are no nearer than two pixels to another class: encoders see cells, not
    pixels.
    """
    match_border: float | None
    """The same of the other pixels: how sharply what is told apart is told apart."""
    match_kind: float | None
    """Pixels that take a code of their own kind (see KINDS)."""


@torch.no_grad()
def code_classes(
    dictionary: StyleDictionary, references: Mapping[str, Reference], encoders: Encoders, guided: GuidedConfig
) -> Annotated[Tensor, "T"]:
    """Class of each code, int64. References go by the dictionary's names. Raises DataError where semantics
    are missing.
    """
    if encoders.semantic is None or encoders.basis is None:
        raise DataError("match rates: the scene has no semantics; train it with a semantic encoder")
    code_labels = torch.full((len(dictionary.keys),), -1, dtype=torch.int64)
    for i, name in enumerate(dictionary.names):
        own = (dictionary.reference == i).nonzero().squeeze(1)
        semantic = encoded(
            references[name].image.to(encoders.device), encoders.semantic, guided, encoders.basis
        )
        nearest = torch.cdist(semantic, dictionary.keys[own].to(semantic)).argmin(1).cpu()
        for place, code in enumerate(own.tolist()):
            kinds = references[name].classes.flatten()[nearest == place]
            if len(kinds):
                code_labels[code] = int(kinds.mode().values)
    return code_labels


def winners(share: Annotated[Tensor, "N T"], classes: Annotated[Tensor, "T"]) -> Annotated[Tensor, "N"]:
    """Class of the code that each pixel takes most of; the first of several that are alike."""
    return classes[share.argmax(1)]


def interior(labels: Annotated[Tensor, "H W"]) -> Annotated[Tensor, "H W"]:
    """Pixels whose surroundings are all of their own class, bool."""
    side = 2 * _REACH + 1
    padded = F.pad(labels[None, None].double(), (_REACH,) * 4, mode="replicate")
    highest = F.max_pool2d(padded, side, 1)
    lowest = -F.max_pool2d(-padded, side, 1)
    return (highest == lowest)[0, 0]


def match_rates(
    found: Sequence[Annotated[Tensor, "H W"]],
    truth: Sequence[Annotated[Tensor, "H W"]],
    references: Sequence[Reference],
) -> Matched:
    """Rates over all pixels of the views together."""
    counted = [torch.bincount(reference.classes.flatten()) for reference in references]
    shown = sorted(
        {k for each in counted for k in (each >= _SHOWN * each.sum()).nonzero().flatten().tolist()}
    )
    taken = torch.cat([x.flatten() for x in found])
    true = torch.cat([x.flatten() for x in truth])
    counts = torch.isin(true, torch.tensor(shown))
    inside = torch.cat([interior(x).flatten() for x in truth])
    return Matched(
        _rate(taken == true, counts),
        _rate(taken == true, counts & inside),
        _rate(taken == true, counts & ~inside),
        _rate(kinds_of(taken) == kinds_of(true), counts),
    )


def _rate(right: Tensor, counts: Tensor) -> float | None:
    return float(right[counts].double().mean()) if bool(counts.any()) else None


Picture = Annotated[Tensor, "H W 3"]
Labelled = Sequence[tuple[Picture, Annotated[Tensor, "H W"]]]
"""Pictures with the true class of every pixel."""
_RIDGE = 1e-4
"""Variance added before a class's colours are inverted: a class of one colour is only moved."""
_GAIN = 3.0
"""No direction of colour is amplified more, as in `style.colours`."""


def score(
    pictures: Sequence[Picture], truth: Sequence[Picture], labels: Sequence[Annotated[Tensor, "H W"]]
) -> tuple[Row, dict[str, float]]:
    """`psnr`, `ssim` (means over the views) and `delta_e` (over all pixels); and the latter by class."""
    row, apart = mean_scores(pictures, truth)
    kinds = torch.cat([each.flatten() for each in labels])
    return {**row}, {CLASSES[k]: float(apart[kinds == k].mean()) for k in sorted(set(kinds.tolist()))}


def best_class_maps(plain: Labelled, truth: Sequence[Picture]) -> list[Picture]:
    """The plain pictures after the affine map of colours of each true class that is nearest to the truth
    (least squares).

    It knows the truth: a bound on what moving the colours of classes as wholes can reach, with this
    reconstruction.
    """
    here, kinds = _flat(plain)
    there = torch.cat([image.reshape(-1, 3) for image in truth]).double()
    moved = torch.empty_like(here)
    for kind in set(kinds.tolist()):
        inside = kinds == kind
        a = here[inside]
        b = there[inside]
        middle = a.mean(0)
        target = b.mean(0)
        spread = (a - middle).T @ (a - middle) / len(a) + _RIDGE * torch.eye(3, dtype=torch.float64)
        matrix = torch.linalg.solve(spread, (a - middle).T @ (b - target) / len(a))
        moved[inside] = (a - middle) @ matrix + target
    return _pictures(moved, plain)


def true_class_maps(plain: Labelled, references: Labelled) -> list[Picture]:
    """The plain pictures with the colours of each true class carried to those of the same class in the
    references.

    What perfect matching would give. Classes that no reference shows take all colours of the references.
    """
    here, kinds = _flat(plain)
    there, known = _flat(references)
    floor = _RIDGE * torch.eye(3, dtype=torch.float64)
    moved = torch.empty_like(here)
    for kind in set(kinds.tolist()):
        a = here[kinds == kind]
        b = there[known == kind] if bool((known == kind).any()) else there
        spread, wide = (torch.cov(x.T, correction=0).reshape(3, 3) + floor for x in (a, b))
        moved[kinds == kind] = (a - a.mean(0)) @ monge(spread[None], wide[None], gain=_GAIN)[0] + b.mean(0)
    return _pictures(moved, plain)


def mean_rows(tables: Sequence[Mapping[str, Row]]) -> dict[str, Row]:
    """Mean of every figure of every method over tables; where a table does not have it, or has None, it is
    left out there.
    """
    gathered: dict[str, dict[str, list[float]]] = {}
    for table in tables:
        for method, row in table.items():
            for key, value in row.items():
                kept = gathered.setdefault(method, {}).setdefault(key, [])
                kept += [] if value is None else [value]
    return {
        method: {key: math.fsum(values) / len(values) if values else None for key, values in row.items()}
        for method, row in gathered.items()
    }


def _flat(pictures: Labelled) -> tuple[Annotated[Tensor, "N 3"], Annotated[Tensor, "N"]]:
    colours = torch.cat([image.reshape(-1, 3) for image, _ in pictures]).double()
    return colours, torch.cat([labels.flatten() for _, labels in pictures])


def _pictures(colours: Annotated[Tensor, "N 3"], like: Labelled) -> list[Picture]:
    parts = torch.split(colours.clamp(0, 1).float(), [image.shape[0] * image.shape[1] for image, _ in like])
    return [part.reshape(image.shape) for part, (image, _) in zip(parts, like, strict=True)]
