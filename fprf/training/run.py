"""A run folder: everything that is needed to render and restyle a scene, and nothing that runs code.

    config.json         the knobs, plug-ins by name
    scene.json          what was found out: space, cameras, names, splits, sizes
    basis.safetensors   semantic basis, to bring references into the scene's terms
    style.safetensors   the scene's own statistics and regions
    images.json         hashes of the images, so that another start does not go on with others
    events.jsonl        one line every few seconds of training
    metrics.json        written by `fprf eval`
    checkpoints/        see `training.checkpoint`

It can be moved and shared: it holds no absolute path that matters and needs neither images nor encoders to
render.
"""

import json
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import torch
from torch import Tensor

from ..config_files import load_config, save_config
from ..datamanagers.images import load_image, load_mask
from ..datamanagers.scene import ParsedScene
from ..errors import CheckpointError, UsageError
from ..io import tensorfiles
from ..io.atomic import write_json
from ..io.strict_json import open_json
from ..plugins.captures import format_name
from ..plugins.codec import from_json
from ..plugins.registry import nearest
from ..rendering.cameras import Cameras
from ..run_config import RunConfig
from .facts import Facts, facts_from_json, facts_to_json
from .locks import lock_folder

FORMAT = 1
"""Version of scene.json."""
_RUN_FILES = (
    "config.json",
    "scene.json",
    "images.json",
    "basis.safetensors",
    "style.safetensors",
    "events.jsonl",
    "checkpoints",
    "blocks",
    "cells",
    "overview",
)
"""Files and folders that training writes into a run folder (docs/design.md)."""
_MAX_SOME = 8
"""Views of the split `some`, at most."""
_CAMERA = {"pose": (3, 4), "focal": (2,), "centre": (2,), "size": (2,), "distortion": (6,), "lens": ()}
"""Fields of the cameras, and the shape of each for one view."""
_INTEGERS = ("size", "lens")
"""Those of them that are whole numbers."""


class Photograph(NamedTuple):
    """The image of a view, and where it counts."""

    image: Annotated[Tensor, "H W 3"]
    """In [0, 1]."""
    where: Annotated[Tensor, "H W"] | None
    """True where it counts; None = everywhere."""


@dataclass(frozen=True, kw_only=True)
class Known:
    """The content of scene.json."""

    name: str
    data: str
    """Folder of the images when it was trained: a hint for `eval`, not a need."""
    names: tuple[str, ...]
    """Names of the views: the stems of their images (see `view_names`)."""
    cameras: Cameras
    train: tuple[int, ...]
    test: tuple[int, ...]
    facts: Facts

    def split(self, name: str) -> tuple[int, ...]:
        """Views of `train`, `test` or `all`; `some`: at most 8 training views, spread evenly."""
        count = min(_MAX_SOME, len(self.train))
        some = tuple(self.train[k * len(self.train) // count] for k in range(count))
        return {"some": some, "train": self.train, "test": self.test, "all": tuple(range(len(self.names)))}[
            name
        ]

    def views(self, split: str, names: Sequence[str] = ()) -> list[int]:
        """Views by name, or those of a split where none is named.

        Raises UsageError for a name that the run does not hold, or a split without views.
        """
        held = list(self.names)
        for name in names:
            if name not in held:
                raise UsageError(
                    f"--views {name}: no such view in the run{nearest(name, held)} ({held[0]} … {held[-1]})"
                )
        views = [held.index(name) for name in names] or list(self.split(split))
        if not views:
            raise UsageError(f"--split {split}: the run holds no such views; choose another split")
        return views

    def photograph(self, captured: ParsedScene, view: int, *, masks: bool) -> Photograph:
        """The image of a view at the size of its camera, with `masks` where those of the capture say that it
        counts.
        """
        width, height = self.cameras.size[view].tolist()
        pixels = load_image(captured.paths[view], (width, height), self.facts.background)
        image = torch.from_numpy(pixels).float() / 255
        mask = None
        if captured.masks and masks:
            mask = captured.masks[view]
        where = None
        if mask is not None:
            where = torch.from_numpy(load_mask(mask, (width, height)))
        return Photograph(image, where)


def _not_a_run(path: Path) -> str:
    """The message for a path without config.json: its kind, and the command that takes or makes it."""
    if path.is_file() and format_name(path) is not None:
        return (
            f"{path}: a capture of Gaussians, and no run folder; `fprf restyle {path} --references PHOTO.jpg "
            f"--page {path.stem}.html` restyles it, `fprf view {path}` shows it"
        )
    return f"{path}: no config.json here, so it is no run folder; `fprf train` makes one"


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
        """True where a run was begun."""
        return (self.root / "config.json").is_file()

    def save_config(self, config: RunConfig, method: str) -> None:
        """Write config.json."""
        save_config(self.root / "config.json", config, method)

    def load_config(self) -> tuple[RunConfig, str]:
        """Config and method name. Raises CheckpointError where this is no run folder."""
        if not self.exists:
            raise CheckpointError(_not_a_run(self.root))
        return load_config(self.root / "config.json")

    def save_known(self, scene: ParsedScene, data: Path | None, facts: Facts) -> None:
        """Write scene.json."""
        known = known_of(scene, data, facts)
        cameras = {}
        for key in _CAMERA:
            cameras[key] = getattr(scene.cameras, key).tolist()
        document = {"format": FORMAT, **vars(known), "cameras": cameras, "facts": facts_to_json(facts)}
        write_json(self.root / "scene.json", document)

    def load_known(self) -> Known:
        """Read scene.json. Raises CheckpointError."""
        with open_json(
            self.root / "scene.json", "train the scene again, or use the fprf that wrote it"
        ) as document:
            if document["format"] != FORMAT:
                raise ValueError(f"format {document['format']!r}, this fprf reads {FORMAT}")
            names = from_json(document["names"], tuple[str, ...], path="names")
            train = from_json(document["train"], tuple[int, ...], path="train")
            test = from_json(document["test"], tuple[int, ...], path="test")
            # A file that somebody sent may hold anything.
            if not all(0 <= view < len(names) for view in (*train, *test)):
                raise ValueError(f"train or test numbers a view beyond its {len(names)}")
            cameras = {}
            # Shapes are those of the numbers of names, whatever the file says.
            for key, shape in _CAMERA.items():
                numbers = torch.tensor(
                    document["cameras"][key], dtype=torch.int64 if key in _INTEGERS else torch.float64
                )
                cameras[key] = numbers.reshape(len(names), *shape)
            return Known(
                name=from_json(document["name"], str, path="name"),
                data=from_json(document["data"], str, path="data"),
                names=names,
                cameras=Cameras(**cameras),
                train=train,
                test=test,
                facts=facts_from_json(document["facts"]),
            )

    def saved_facts(self) -> Facts | None:
        """Facts of the run's scene; None before it wrote scene.json. Raises CheckpointError."""
        if (self.root / "scene.json").is_file():
            return self.load_known().facts
        return None

    def save_tensors(self, name: str, tensors: dict[str, Tensor]) -> None:
        """Write NAME.safetensors, with a checksum for each tensor."""
        tensorfiles.save(self.root / f"{name}.safetensors", tensors, sealed=True)

    def load_tensors(self, name: str) -> dict[str, Tensor]:
        """Read NAME.safetensors. Raises CheckpointError where training did not get that far, or the file is
        damaged.
        """
        path = self.root / f"{name}.safetensors"
        if not path.is_file():
            raise CheckpointError(
                f"{path}: not written yet; finish training with `fprf train {self.root}/config.json`"
            )
        return tensorfiles.load_sealed(path)

    def log(self, event: dict[str, Any]) -> None:
        """Append one line to events.jsonl; a line that a killed process left unfinished is ended first."""
        with (self.root / "events.jsonl").open("a+b") as f:
            f.seek(max(0, f.seek(0, os.SEEK_END) - 1))
            torn = f.read(1) not in (b"", b"\n")
            f.write(b"\n" * torn + json.dumps(event, allow_nan=False).encode() + b"\n")


def known_of(scene: ParsedScene, data: Path | None, facts: Facts) -> Known:
    """The content of scene.json of a scene whose images lie in the folder `data`."""
    return Known(
        name=scene.name,
        data=str(data or ""),
        names=tuple(view_names(scene.paths)),
        cameras=scene.cameras,
        train=tuple(scene.train.tolist()),
        test=tuple(scene.test.tolist()),
        facts=facts,
    )


def view_names(paths: Sequence[Path]) -> list[str]:
    """The stems of images; where two agree (a folder per camera), with one or two folders above, else a
    number, before them.
    """
    # As few folders as tell all images apart: names are shown and typed.
    for folders in range(3):
        names = []
        for p in paths:
            names.append("-".join([*(f.name for f in p.parents[:folders][::-1]), p.stem]))
        if len(set(names)) == len(names):
            return names
    found: list[str] = []
    for i, p in enumerate(paths):
        found.append(f"{i:05d}-{p.stem}")
    return found


try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]


def make_room(run: Path, reads: Sequence[Path], overwrite: bool) -> None:
    """Remove the run that is to be overwritten; nothing that the new one reads.

    Raises UsageError where files lie in the place of a run's that no run has written, unless they may be
    overwritten. Whether a run that is there goes on, training itself says.
    """
    there = []
    for name in _RUN_FILES:
        if (run / name).exists():
            there.append(run / name)
    if not there or (Run(run).exists and not overwrite):
        return
    if not overwrite:
        raise UsageError(
            f"{there[0]}: is there already, and no run has written it; name another --output, or replace it with "
            "--overwrite true"
        )
    for path in there:
        for read in reads:
            if read.exists() and read.resolve().is_relative_to(path.resolve()):
                raise UsageError(
                    f"{read}: is read, and lies in what is to be overwritten; name another --output"
                )
    with lock_folder(run):
        ours = (run / "scene.json").is_file() and Run(run).exists
        for path in there:
            if path.is_file():
                path.unlink()
            elif ours:
                shutil.rmtree(path)
