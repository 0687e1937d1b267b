"""A scene folder in the making: where its parts lie, and what was done already.

images/            the images that are used
sparse/0/          COLMAP's model, once there is one
process.json       what came of every image
sfm/               database.db, state.json, log.txt and the jobs: only needed to go on
"""

import hashlib
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..errors import DataError, UsageError
from ..io.atomic import write_json

__all__ = ["Place", "State", "key_of"]

_FORMAT = 1


@dataclass(frozen=True)
class Place:
    """The folder."""

    root: Path

    @property
    def images(self) -> Path:
        """Folder of the images."""
        return self.root / "images"

    @property
    def work(self) -> Path:
        """Folder of what is needed to go on."""
        return self.root / "sfm"

    @property
    def database(self) -> Path:
        """Features and matches."""
        return self.work / "database.db"

    @property
    def log(self) -> Path:
        """Everything that COLMAP said."""
        return self.work / "log.txt"

    @property
    def model(self) -> Path:
        """The finished model."""
        return self.root / "sparse" / "0"


@dataclass
class State:
    """What was done, with the keys of what it was done from. Saved after every step."""

    source: str = ""
    """What the images were taken from."""
    images: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Of each used image by its name: sha256, width, height, lens."""
    dropped: dict[str, str] = field(default_factory=dict)
    """Files or frames that were not used, with the reason."""
    done: dict[str, str] = field(default_factory=dict)
    """Key of each finished step by its name."""
    seconds: dict[str, float] = field(default_factory=dict)
    """What each step took when it was done."""

    @classmethod
    def load(cls, place: Place) -> "State":
        """The state of a folder; a new one where nothing was done. Raises UsageError for a folder of something else."""
        path = place.work / "state.json"
        if not path.is_file():
            here = [entry.name for entry in place.root.iterdir()] if place.root.is_dir() else []
            if (place.root.exists() and not place.root.is_dir()) or set(here) - {"images", "sfm"}:
                raise UsageError(f"--output {place.root}: holds something else; name a folder that is new or empty")
            return cls()
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            if content.pop("format") != _FORMAT:
                raise ValueError("written by another version")
            return cls(**content)
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise DataError(f"{path}: cannot be read ({error}); remove the folder {place.work} and start anew") from error

    def save(self, place: Place) -> None:
        """Write it."""
        write_json(place.work / "state.json", {"format": _FORMAT, **vars(self)})


def key_of(*parts: object) -> str:
    """A hash of what a step depends on."""
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:16]
