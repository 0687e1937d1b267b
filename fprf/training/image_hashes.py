"""Hashes of a run's images, so that another start does not go on with others (images.json)."""

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from ..datamanagers.photograph_files import file_digest
from ..datamanagers.scene import ParsedScene
from ..errors import UsageError
from ..io.atomic import write_json
from ..io.strict_json import open_json
from ..plugins.codec import from_json
from .run import view_names

IMAGES = "images.json"
"""File of a run folder."""
CHANGED_IMAGES = "--changed-images"
"""Flag of `fprf train` that goes on with images that have changed."""
_IMAGES_FORMAT = 1
"""Version of images.json."""
_MAX_LISTED = 3
"""Images that a message names, at most."""


def image_hashes(scene: ParsedScene) -> dict[str, str]:
    """SHA-256 of each image's file, by the view's name. Raises DataError where one cannot be read."""
    # Hashing waits for the disk, so files are read side by side.
    with ThreadPoolExecutor() as pool:
        return dict(zip(view_names(scene.paths), pool.map(file_digest, scene.paths), strict=True))


def save_image_hashes(root: Path, hashes: Mapping[str, str]) -> None:
    """Write images.json."""
    write_json(root / IMAGES, {"format": _IMAGES_FORMAT, "images": dict(hashes)})


def check_images(root: Path, scene: ParsedScene, hashes: Mapping[str, str]) -> None:
    """Raise UsageError where images differ from those that the run in a folder was begun with; no run, or one
    of before there was a list, has none.
    """
    path = root / IMAGES
    if not path.exists():
        return
    with open_json(path, "remove it, and the images are taken as they are") as document:
        before = from_json(document["images"], dict[str, str], path="images")
    # By name, not by order: an image that was added moves all numbers behind it.
    files = dict(zip(view_names(scene.paths), scene.paths, strict=True))
    changed = []
    for name in hashes:
        if name in before and before[name] != hashes[name]:
            changed.append(f"{files[name]} is another")
    for name in hashes:
        if name not in before:
            changed.append(f"{files[name]} is new")
    for name in before:
        if name not in hashes:
            changed.append(f"{name} is gone")
    if changed:
        if len(changed) > _MAX_LISTED:
            more = f" and {len(changed) - _MAX_LISTED} more"
        else:
            more = ""
        raise UsageError(
            f"{root}: its images have changed since it was begun: {', '.join(changed[:_MAX_LISTED])}{more}; put them back, "
            f"choose another --output, or go on with these by {CHANGED_IMAGES}"
        )
