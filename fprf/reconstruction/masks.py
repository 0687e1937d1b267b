"""Masks of the images: what is black in them gives no features, and is not trained on.

They are written as COLMAP looks for them, and as the readers of scene folders do: masks/a/0001.jpg.png.
"""

import hashlib
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from ..datamanagers.images import IMAGE_SUFFIXES, load_mask
from ..datamanagers.masks import match_masks
from ..errors import UsageError
from ..io.atomic import write_bytes
from .scene_folder import SceneFolder, State


def gather_masks(folder: Path | None, place: SceneFolder, state: State) -> None:
    """Bring the masks of a folder into the scene, each under its image's name; those of before go.

    Raises UsageError where no mask carries an image's name, DataError where one cannot be decoded or has another
    shape than its image.
    """
    found: dict[str, Path] = {}
    if folder is not None:
        found = masks_of(folder, list(state.images))
    written = {}
    for name, path in found.items():
        image = state.images[name]
        opaque = load_mask(path, (image["width"], image["height"]))
        coded, data = cv2.imencode(".png", opaque.astype(np.uint8) * 255)
        assert coded
        target = place.masks / f"{name}.png"
        if not target.exists() or not target.samefile(path):
            write_bytes(target, data.tobytes())
        written[name] = hashlib.sha256(data.tobytes()).hexdigest()
    for name in set(state.masks) - set(written):
        (place.masks / f"{name}.png").unlink(missing_ok=True)
    state.masks = written
    state.notes.pop("masks", None)
    if folder is not None:
        state.notes["masks"] = [f"masks: {len(written)} of {len(state.images)} images have one in {folder}"]
    state.save(place)


def masks_of(folder: Path, images: Sequence[str]) -> dict[str, Path]:
    """The mask of each image that has one below a folder, by the rule of `fprf/datamanagers/masks.py`. Raises
    UsageError where none has.
    """
    files = []
    for path in sorted(folder.rglob("*")):
        if path.suffix.lower() in IMAGE_SUFFIXES and path.is_file() and not path.name.startswith("."):
            files.append(path.relative_to(folder))
    if not files:
        raise UsageError(f"--masks {folder}: holds no images; name the folder of the masks")
    numbers = match_masks([Path(name) for name in images], files)
    found = {}
    for name, number in zip(images, numbers, strict=True):
        if number is not None:
            found[name] = folder / files[number]
    if not found:
        raise UsageError(
            f"--masks {folder}: none of its {len(files)} masks, for example {files[0]}, carries an image's name; name them "
            "as the images: 0001.png or 0001.jpg.png for 0001.jpg"
        )
    return found
