"""A scene folder in the making: where its parts lie, what was done already, and what came of every image.

images/            the images that are used
masks/             their masks, if some were given
sparse/0/          COLMAP's model, once there is one
process.json       what came of every image
sfm/               database.db, state.json, log.txt and the jobs: only needed to go on
"""

import contextlib
import hashlib
import itertools
import json
import sqlite3
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..errors import DataError, UsageError
from ..io.atomic import write_json
from ..io.folder_lock import LOCK

_STATE_FORMAT = 1
"""Version of state.json."""
_NAMES_OF_NEW_FOLDERS = {"images", "masks", "sfm", LOCK, ".DS_Store", "Thumbs.db", "desktop.ini"}
"""Names that a folder may hold when a scene is begun in it: images, masks, our lock, and what file managers leave behind.
"""

Progress = Callable[[int, int, str], None]
"""Told (done, total, what)."""


class SceneFolder:
    """Paths of the parts of a scene folder."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.images = root / "images"
        self.masks = root / "masks"
        """Masks of the images, as COLMAP and `fprf train` look for them."""
        self.work = root / "sfm"
        """Folder of what is needed to go on."""
        self.database = self.work / "database.db"
        """Features and matches."""
        self.log = self.work / "log.txt"
        """Everything that COLMAP said."""
        self.progress = self.work / "progress.jsonl"
        """Progress of a running step, as it reports it."""
        self.model = root / "sparse" / "0"
        """The finished model."""


@dataclass
class State:
    """Finished steps and the keys of their inputs. Saved after every step."""

    source: str = ""
    """Source of the images."""
    images: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Used images by name, each with hashes of file and pixels, width, height and lens."""
    dropped: dict[str, str] = field(default_factory=dict)
    """Files or frames that were not used, with the reason."""
    done: dict[str, str] = field(default_factory=dict)
    """Key of each finished step by its name."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Time of each finished step."""
    masks: dict[str, str] = field(default_factory=dict)
    """Hashes of the masks by image; empty without."""
    notes: dict[str, list[str]] = field(default_factory=dict)
    """Decisions, by the step that made them."""

    @classmethod
    def load(cls, place: SceneFolder) -> "State":
        """The state of a folder; a new one where nothing was done. Raises UsageError for a folder of
        something else.
        """
        path = place.work / "state.json"
        # Only a folder that is new, or holds no more than images, is begun in.
        if not path.is_file():
            if place.root.is_dir():
                here = []
                for entry in place.root.iterdir():
                    here.append(entry.name)
            else:
                here = []
            if (place.root.exists() and not place.root.is_dir()) or set(here) - _NAMES_OF_NEW_FOLDERS:
                raise UsageError(
                    f"--output {place.root}: holds something else; name a folder that is new or empty"
                )
            return cls()
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            if content.pop("format") != _STATE_FORMAT:
                raise ValueError("written by another version")
            return cls(**content)
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise DataError(
                f"{path}: cannot be read ({error}); remove the folder {place.work} and start anew"
            ) from error

    def save(self, place: SceneFolder) -> None:
        """Write it."""
        write_json(place.work / "state.json", {"format": _STATE_FORMAT, **vars(self)})


def step_key(*parts: object) -> str:
    """A hash of what a step depends on."""
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]


PAIR_FACTOR = 2147483647
"""A pair of images is stored as PAIR_FACTOR * smaller id + larger id: COLMAP's kMaxNumImages."""
MIN_MATCHES = 15
"""Verified matches from which on COLMAP takes two images for neighbours: its min_num_matches."""


class MatchTables:
    """Features and matches in a database, by image. Raises sqlite3.Error for what is no database of
    COLMAP's.
    """

    def __init__(self, path: Path) -> None:
        with reading(path) as base:
            names = dict(base.execute("SELECT image_id, name FROM images"))
            features = dict(base.execute("SELECT image_id, rows FROM keypoints"))
            pairs = base.execute(
                "SELECT pair_id FROM two_view_geometries WHERE rows >= ?", (MIN_MATCHES,)
            ).fetchall()
        self.features: dict[str, int] = {name: features.get(number, 0) for number, name in names.items()}
        """Features of each image that COLMAP could decode."""
        self.partners: Counter[str] = Counter()
        """Images that share enough verified matches with an image."""
        for (pair,) in pairs:
            first, second = divmod(pair, PAIR_FACTOR)
            if first in names and second in names:
                self.partners[names[first]] += 1
                self.partners[names[second]] += 1


def tried_pairs(path: Path) -> set[frozenset[str]]:
    """Names of the pairs of images that were matched, whether they fit or not."""
    with reading(path) as base:
        names = dict(base.execute("SELECT image_id, name FROM images"))
        pairs = base.execute("SELECT pair_id FROM two_view_geometries").fetchall()
    found = set()
    for (pair,) in pairs:
        first, second = divmod(pair, PAIR_FACTOR)
        if first in names and second in names:
            found.add(frozenset((names[first], names[second])))
    return found


def count_rows(path: Path) -> tuple[int, int]:
    """Images with features and pairs that were tried so far; zeros while the database cannot be read."""
    with contextlib.suppress(sqlite3.Error, OSError), reading(path) as base:
        features = base.execute("SELECT COUNT(*) FROM keypoints").fetchone()[0]
        return int(features), int(base.execute("SELECT COUNT(*) FROM two_view_geometries").fetchone()[0])
    return 0, 0


@contextlib.contextmanager
def reading(path: Path) -> Iterator[sqlite3.Connection]:
    """A database open for reading only: COLMAP may be writing it."""
    base = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True, timeout=5)
    try:
        yield base
    finally:
        base.close()


def report(
    state: Mapping[str, Any],
    matching: str,
    matches: MatchTables,
    models: Sequence[Mapping[str, Any]],
    version: str,
) -> dict[str, Any]:
    """The content of process.json; `state` as a mapping, and COLMAP's models, the largest first.

    Every image without a pose in the first of these is dropped: in the order of the steps, choosing,
    features, matching and mapping, with the one where it was lost and the reason.
    """
    images = state["images"]
    unused = state["dropped"]
    if models:
        main = models[0]
    else:
        main = {"images": [], "points": 0, "error_pixels": None, "track_length": None}
    dropped = []
    for image, reason in unused.items():
        dropped.append({"image": image, "step": "choosing", "reason": reason})
    dropped += _dropped_images(images, matches, models)
    return {
        "format": 1,
        "fprf": version,
        "source": state["source"],
        "images": {
            "given": len(images) + len(unused),
            "used": len(images),
            "posed": len(set(main["images"])),
        },
        "points": main["points"],
        "error_pixels": main["error_pixels"],
        "track_length": main["track_length"],
        "parts": [len(model["images"]) for model in models],
        "matching": matching,
        "notes": list(itertools.chain.from_iterable(state.get("notes", {}).values())),
        "step_seconds": dict(state["seconds"]),
        "dropped": dropped,
    }


def _dropped_images(
    images: Iterable[str], matches: MatchTables, models: Sequence[Mapping[str, Any]]
) -> list[dict[str, str]]:
    """Images without a pose in the first model, with the first step that they did not pass, in the order of
    the steps.
    """
    posed = set(models[0]["images"]) if models else set()
    part_of: dict[str, int] = {}  # the largest part that has it
    for number, model in enumerate(models, 1):
        part_of = dict.fromkeys(model["images"], number) | part_of
    lost: dict[str, list[tuple[str, str]]] = {"features": [], "matching": [], "mapping": []}
    for name in images:
        features = matches.features.get(name)
        partners = matches.partners[name]
        part = part_of.get(name)
        if name in posed:
            continue
        if features is None:
            lost["features"].append((name, "COLMAP cannot decode it; convert it to JPEG"))
        elif not features:
            lost["features"].append((name, "nothing with texture in it"))
        elif not partners:
            lost["matching"].append(
                (name, f"{features} features, but it fits no other image; take views in between")
            )
        elif part is not None:
            count = len(models[part - 1]["images"])
            apart = f"in part {part} ({count} images), apart from the rest; take views in between"
            lost["mapping"].append((name, apart))
        else:
            lost["mapping"].append((name, f"fits {partners} images, but no pose was found for it"))
    dropped = []
    for step, drops in lost.items():
        for image, reason in drops:
            dropped.append({"image": image, "step": step, "reason": reason})
    return dropped
