"""A run folder: everything that is needed to render and restyle a scene, and nothing that runs code.

    config.json         the knobs, plug-ins by name
    scene.json          what was found out: space, cameras, names, splits, sizes
    basis.safetensors   semantic basis, to bring references into the scene's terms
    style.safetensors   the scene's own statistics and regions
    images.json         hashes of the images, so that another start does not go on with others
    events.jsonl        one line every few seconds of training
    metrics.json        written by `fprf eval`
    checkpoints/        see `training.checkpoint`

It can be moved and shared: it holds no absolute path that matters and needs neither images nor encoders to render.
"""

import dataclasses
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..config import RunConfig
from ..datamanagers.scene import Scene
from ..errors import CheckpointError
from ..io.atomic import write_json
from ..plugins.codec import load_config, save_config
from ..rendering.cameras import Cameras
from ..rendering.coverage import well_covered
from ..rendering.space import Space
from . import tensorfiles
from .model import Facts

__all__ = ["Known", "Run", "view_names"]

FORMAT = 1
_SHOWN = 8
"""Views of the split `covered`, at most."""
_CAMERA = ("pose", "focal", "centre", "size", "distortion", "lens")


@dataclass(frozen=True, kw_only=True)
class Known:
    """The content of scene.json."""

    name: str
    data: str
    """Where the images lay when it was trained: a hint for `eval`, not a need."""
    names: tuple[str, ...]
    """Of each view: the stem of its image (see `view_names`)."""
    cameras: Cameras
    train: tuple[int, ...]
    test: tuple[int, ...]
    facts: Facts

    def split(self, name: str) -> tuple[int, ...]:
        """Views of `train`, `test` or `all`; `covered`: at most 8 that are well covered by the training views."""
        if name == "covered":
            return tuple(well_covered(self.cameras, self.train, self.facts.space, _SHOWN))
        return {"train": self.train, "test": self.test, "all": tuple(range(len(self.names)))}[name]


@dataclass(frozen=True)
class Run:
    """One folder."""

    root: Path

    @property
    def checkpoints(self) -> Path:
        """Folder of the checkpoints."""
        return self.root / "checkpoints"

    @property
    def exists(self) -> bool:
        """Whether a run was begun here."""
        return (self.root / "config.json").is_file()

    def save_config(self, config: RunConfig, method: str) -> None:
        """Write config.json."""
        save_config(self.root / "config.json", config, method)

    def load_config(self) -> tuple[RunConfig, str]:
        """Config and method name. Raises CheckpointError where this is no run folder."""
        if not self.exists:
            raise CheckpointError(f"{self.root}: no config.json here, so it is no run folder; `fprf train` makes one")
        return load_config(self.root / "config.json")

    def save_known(self, scene: Scene, data: Path | None, facts: Facts) -> None:
        """Write scene.json."""
        document = {
            "format": FORMAT,
            "name": scene.name,
            "data": str(data or ""),
            "names": view_names(scene.paths),
            "cameras": {key: getattr(scene.cameras, key).tolist() for key in _CAMERA},
            "train": scene.train.tolist(),
            "test": scene.test.tolist(),
            "facts": dataclasses.asdict(facts),
        }
        write_json(self.root / "scene.json", document)

    def load_known(self) -> Known:
        """Read scene.json. Raises CheckpointError."""
        path = self.root / "scene.json"
        try:
            document: dict[str, Any] = json.loads(path.read_text())
            if document["format"] != FORMAT:
                raise CheckpointError(
                    f"{path}: is of format {document['format']!r}, this fprf reads {FORMAT}; use the one that wrote it"
                )
            facts = dict(document["facts"])
            space = {k: _tupled(v) for k, v in facts.pop("space").items()}
            raw = document["cameras"]
            cameras = Cameras(
                *(torch.tensor(raw[key], dtype=torch.int64 if key in ("size", "lens") else torch.float64) for key in _CAMERA)
            )
            return Known(
                name=document["name"],
                data=document["data"],
                names=tuple(document["names"]),
                cameras=cameras,
                train=tuple(document["train"]),
                test=tuple(document["test"]),
                facts=Facts(space=Space(**space), **{k: _tupled(v) for k, v in facts.items()}),
            )
        except (OSError, ValueError, KeyError, TypeError, AttributeError, RuntimeError) as e:
            raise CheckpointError(f"{path}: cannot be read ({e!r}); train the scene again") from e

    def saved_facts(self) -> Facts | None:
        """What a run found out about its scene; None before it wrote scene.json. Raises CheckpointError."""
        return self.load_known().facts if (self.root / "scene.json").is_file() else None

    def save_tensors(self, name: str, tensors: dict[str, Tensor]) -> None:
        """Write NAME.safetensors, with a checksum for each tensor."""
        tensorfiles.save_sealed(self.root / f"{name}.safetensors", tensors)

    def load_tensors(self, name: str) -> dict[str, Tensor]:
        """Read NAME.safetensors. Raises CheckpointError where training did not get that far, or the file is damaged."""
        path = self.root / f"{name}.safetensors"
        if not path.is_file():
            raise CheckpointError(f"{path}: not written yet; finish training with `fprf train {self.root}/config.json`")
        return tensorfiles.load_sealed(path)

    def log(self, event: dict[str, Any]) -> None:
        """Append one line to events.jsonl; a line that a killed process left unfinished is ended first."""
        with (self.root / "events.jsonl").open("a+b") as f:
            f.seek(max(0, f.seek(0, os.SEEK_END) - 1))
            torn = f.read(1) not in (b"", b"\n")
            f.write(b"\n" * torn + json.dumps(event, allow_nan=False).encode() + b"\n")


def view_names(paths: Sequence[Path]) -> list[str]:
    """The stems of images; where two agree (a folder per camera), with one or two folders above, else a number, before them."""
    for folders in range(3):
        names = ["-".join([*(f.name for f in p.parents[:folders][::-1]), p.stem]) for p in paths]
        if len(set(names)) == len(names):
            return names
    return [f"{i:05d}-{p.stem}" for i, p in enumerate(paths)]


def _tupled(value: Any) -> Any:
    return tuple(_tupled(v) for v in value) if isinstance(value, list) else value
