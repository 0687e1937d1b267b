"""The images that a run was begun with, by the hash of their files: training goes on with the same ones, or not at all.

`images.json` holds a SHA-256 for each view's name. Times and sizes of files are not looked at: they change where nothing did,
and stay where something did.
"""

import hashlib
import json
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from ..datamanagers.scene import Scene
from ..errors import CheckpointError, DataError, UsageError
from ..io.atomic import write_json
from .run import view_names

__all__ = ["FLAG", "NAME", "fingerprints", "keep", "refuse_others"]

NAME = "images.json"
FLAG = "--changed-images"
"""Of `fprf train`: go on nevertheless."""
FORMAT = 1
_SHOWN = 3


def fingerprints(scene: Scene) -> dict[str, str]:
    """SHA-256 of each image's file, by the view's name. Raises DataError where one cannot be read."""

    def of(path: Path) -> str:
        try:
            with path.open("rb") as file:
                return hashlib.file_digest(file, "sha256").hexdigest()
        except OSError as error:
            raise DataError(f"{path}: cannot be read ({error.strerror}); check the path and its permissions") from error

    with ThreadPoolExecutor() as pool:
        return dict(zip(view_names(scene.paths), pool.map(of, scene.paths), strict=True))


def keep(root: Path, found: Mapping[str, str]) -> None:
    """Write down what a run is trained on."""
    write_json(root / NAME, {"format": FORMAT, "images": dict(found)})


def refuse_others(root: Path, scene: Scene, found: Mapping[str, str]) -> None:
    """Raise UsageError where images differ from those that the run in a folder was begun with; no run, or one of before
    there was a list, has none.
    """
    path = root / NAME
    if not path.exists():
        return
    try:
        document = json.loads(path.read_text())
        before = {str(name): str(mark) for name, mark in document["images"].items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise CheckpointError(f"{path}: cannot be read ({error!r}); remove it, and the images are taken as they are") from error
    files = dict(zip(view_names(scene.paths), scene.paths, strict=True))
    changed = [f"{files[name]} is another" for name in found if name in before and before[name] != found[name]]
    changed += [f"{files[name]} is new" for name in found if name not in before]
    changed += [f"{name} is gone" for name in before if name not in found]
    if changed:
        more = f" and {len(changed) - _SHOWN} more" if len(changed) > _SHOWN else ""
        raise UsageError(
            f"{root}: its images have changed since it was begun: {', '.join(changed[:_SHOWN])}{more}; put them back, "
            f"choose another --output, or go on with these by {FLAG}"
        )
