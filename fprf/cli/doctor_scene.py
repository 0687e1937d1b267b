"""Findings of `fprf doctor` in a scene folder that training would not say, each with what is decided.

At most LOOKED views, evenly through the scene, have their files opened and their pixels looked at.
"""

import hashlib
import io
import shlex
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from PIL import ImageCms

from ..datamanagers.blur import blurred_views
from ..datamanagers.images import Image, exif_orientation, load_images, load_mask, open_image, opened, uniform_colour
from ..datamanagers.parsers.config import DataParserConfig, parse_scene, recognise
from ..datamanagers.scene import Scene, exposures_differ, find_sightings, sparser, with_exposure
from ..errors import DataError
from ..plugins import registry
from .findings import Finding

LOOKED = 48
"""Views whose files are opened."""
_SIDE = 960
"""Longest side in pixels at which images are looked at."""
_FEW_POINTS = 100
"""Points below which the first Gaussians are not placed at them."""
_TAIL = 1 << 16
"""Bytes by which files of equal size are compared first."""


def scene_folder(data: Path) -> Iterator[Finding]:
    """Format, views, sizes, splits and content of a scene. Raises DataError where it cannot be parsed."""
    parser = recognise(data)
    yield Finding("format", registry.name_of(DataParserConfig.group, type(parser)))
    scene = parse_scene(data, 1, parser)
    sizes = sorted({(int(w), int(h)) for w, h in scene.cameras.size.tolist()})
    shown = ", ".join(f"{w} x {h}" for w, h in sizes[:3]) + (f" and {len(sizes) - 3} more" if len(sizes) > 3 else "")
    lenses = sorted({("pinhole", "OpenCV", "fisheye")[lens] for lens in scene.cameras.lens.tolist()})
    yield Finding("views", f"{len(scene.paths)} of {shown} pixels, {' and '.join(lenses)} lens")
    yield Finding("split", f"{len(scene.train)} to train, {len(scene.test)} held out")
    for note in scene.notes:
        yield Finding("note", note)
    yield from inspect_scene(data, scene)
    yield Finding("next", f"fprf train --data {shlex.quote(str(data))}")


def inspect_scene(data: Path, scene: Scene) -> Iterator[Finding]:
    """Coordinates, points, masks, files, duplicates, exposure and blur of a scene, one line each where there is one to say."""
    count = len(scene.paths)
    looked = np.unique(np.linspace(0, count - 1, min(count, LOOKED)).round().astype(int)).tolist()
    if len(looked) < count:
        yield Finding("sample", f"masks, profiles, exposure and blur are looked at in {len(looked)} of {count} views")
    if any(scene.origin):
        centre = ", ".join(f"{x:.9g}" for x in scene.origin)
        yield Finding("coordinates", f"about ({centre}), beyond what float32 resolves: trained about that as a local origin")
    yield _points(data, scene)
    for name, masks in (("masks", scene.masks), ("sky masks", scene.sky_masks)):
        if masks:
            yield from _masks(name, [(masks[view], scene.cameras.size[view].tolist()) for view in looked])
    yield from _metadata([scene.paths[view] for view in looked])
    yield from _duplicates(scene)
    # One reading of the pixels serves both, at a size at which blur is seen and thousands of points are found.
    scale = max(1.0, float(scene.cameras.size.max()) / _SIDE)
    reduced = replace(scene, cameras=scene.cameras.scaled(scale)) if scale > 1 else scene
    pixels, broken = _pixels(reduced, looked)
    if broken:
        more = f" and {len(broken) - 1} more" if len(broken) > 1 else ""
        yield Finding("images", f"{broken[0]}{more}", "replace them, or remove their poses")
    yield from _exposure(reduced, pixels)
    if blurred := sorted(blurred_views(reduced.cameras, pixels, 1)[0]):
        named = ", ".join(scene.paths[view].name for view in blurred[:3]) + (", ..." if len(blurred) > 3 else "")
        found = f"{len(blurred)} of {len(pixels)} images: {named}; Gaussians are shown them rarely, fields like the others"
        yield Finding("blur", found, "remove them, where others show the same", optional=True)


def _points(data: Path, scene: Scene) -> Finding:
    """Number of the reconstruction's points, and of those that training views see."""
    count = 0 if scene.points is None else len(scene.points)
    if not count:
        found = "none; bounds come from the cameras, first Gaussians from matches between views"
        unread = next((path.name for path in sorted(data.glob("*.ply"))), None)
        if unread is None:
            return Finding("points", found)
        remedy = f'if its points are in the frame of the poses: "ply_file_path": "{unread}" in transforms.json'
        return Finding("points", f"{found}; {unread} is not read", remedy, optional=True)
    sightings = find_sightings(sparser(scene))
    seeing = 0 if sightings is None else len({*sightings.view.tolist()})
    found = f"{count} of the reconstruction, in view of {seeing} of {len(scene.train)} training views"
    if not seeing:
        return Finding("points", found, "remove them, or give those of this scene: they lie elsewhere or behind", optional=True)
    few = "; too few to begin with: first Gaussians come from matches between views" if count < _FEW_POINTS else ""
    return Finding("points", found + few)


def _masks(name: str, masks: Sequence[tuple[Path | None, list[int]]]) -> Iterator[Finding]:
    """The share of the pixels that masks keep, and masks that say nothing."""
    shares = []
    for path, (width, height) in masks:
        try:
            shares += [] if path is None else [float(load_mask(path, (width, height)).mean())]
        except DataError as fault:
            yield Finding(name, str(fault), "restore it, or remove it")
            return
    if not shares:
        return
    sky, colour = name != "masks", uniform_colour(shares)
    found = f"white is {100 * np.mean(shares):.0f} % of the pixels of {len(shares)} views"
    if colour == "black" and not sky:
        yield Finding(name, f"{found}: nothing is left to learn from", "invert them: white is used, black is left out")
    elif colour:
        what = "all is sky" if sky and colour == "white" else "no sky" if sky else "they leave nothing out"
        remedy = "remove them, or write them again: do their pixels hold what was meant?"
        yield Finding(name, f"{found}: {what}", remedy, optional=True)
    else:
        black = shares.count(0.0)
        empty = f"; {black} leave nothing of their view" if black and not sky else ""
        yield Finding(name, f"{found}, which is {'sky' if sky else 'used'}{empty}")


def _metadata(paths: Sequence[Path]) -> Iterator[Finding]:
    """Colour profiles other than sRGB, and orientations."""
    profiles: Counter[str] = Counter()
    turned = 0
    for path in paths:
        try:
            with opened(path) as file:
                image = open_image(file, path)[1]
                icc, orientation = image.info.get("icc_profile"), exif_orientation(image)
        except DataError:
            continue  # what cannot be read is said where its pixels are
        turned += orientation != 1
        try:
            profile = ImageCms.getProfileDescription(ImageCms.ImageCmsProfile(io.BytesIO(icc))).strip() if icc else "sRGB"
        except (OSError, ImageCms.PyCMSError):
            profile = "unreadable"
        if "srgb" not in profile.lower():
            profiles[profile or "unnamed"] += 1
    if profiles:
        named = ", ".join(f"{name} ({count})" for name, count in profiles.most_common())
        yield Finding("profiles", f"{named} of {len(paths)} images: converted to sRGB")
    if turned:
        yield Finding(
            "orientation", f"{turned} of {len(paths)} images are marked as turned: pixels are taken as COLMAP reads them"
        )


def _duplicates(scene: Scene) -> Iterator[Finding]:
    """Files of the same content, and views of the same pose."""

    def digest(view: int, most: int | None = None) -> bytes:
        """Digest of a view's file, or of its last bytes."""
        path = scene.paths[view]
        with path.open("rb") as file:
            if most is not None:
                file.seek(max(0, path.stat().st_size - most))
            return hashlib.sha256(file.read()).digest()

    views = range(len(scene.paths))
    files = _alike([views], lambda view: scene.paths[view].stat().st_size)
    files = _alike(files, lambda view: digest(view, _TAIL))  # whole files only where much is equal already
    files = _alike(files, digest)
    position = scene.cameras.pose[:, :, 3]
    extent = float((position.amax(0) - position.amin(0)).max()) or 1.0
    pose = torch.cat([scene.cameras.pose[:, :, :3].flatten(1), (position - position.mean(0)) / extent], 1)
    rows = (pose * 1e6).round().tolist()
    posed = _alike([views], lambda view: tuple(rows[view]))
    for what, groups in (("are the same file", files), ("are taken from the same pose", posed)):
        if groups:
            first = " and ".join(scene.paths[view].name for view in groups[0][:2])
            found = f"{sum(len(group) - 1 for group in groups)} of {len(views)} views: {first} {what}; all are trained"
            yield Finding("duplicates", found, "remove the copies", optional=True)


def _alike(groups: Iterable[Sequence[int]], key: Callable[[int], Hashable]) -> list[list[int]]:
    """Views of a group that have the same key, where they are at least two."""
    found = []
    for group in groups:
        parts: dict[Hashable, list[int]] = {}
        for view in group:
            parts.setdefault(key(view), []).append(view)
        found += [part for part in parts.values() if len(part) > 1]
    return found


def _pixels(scene: Scene, views: Sequence[int]) -> tuple[dict[int, Image], list[str]]:
    """Images by view, and why others cannot be read."""

    def load(view: int) -> Image | str:
        try:
            return load_images(scene, views=[view])[0]
        except DataError as fault:
            return str(fault)

    with ThreadPoolExecutor() as pool:
        loaded = dict(zip(views, pool.map(load, views), strict=True))
    images = {view: each for view, each in loaded.items() if not isinstance(each, str)}
    return images, [each for each in loaded.values() if isinstance(each, str)]


def _exposure(scene: Scene, images: Mapping[int, Image]) -> Iterator[Finding]:
    """Spread of the exposures of the training views that were looked at."""
    train = torch.tensor([view for view in scene.train.tolist() if view in images], dtype=torch.int64)
    if len(train) < 2:
        return
    some = replace(scene, train=train, test=train[:0])
    exposure = with_exposure(some, lambda view: torch.from_numpy(images[view]).float() / 255).exposure
    if exposure is None:
        return
    spread = float(exposure[train].log2().std())
    decided = "a factor for each view is learnt" if exposures_differ(exposure[train]) else "no factor is learnt"
    yield Finding("exposure", f"spread by {spread:.2f} stops: {decided}")
