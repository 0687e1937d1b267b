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

import dataclasses
import errno
import hashlib
import json
import os
import socket
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import torch
from torch import Tensor

from ..config import RunConfig
from ..datamanagers.images import load_image, load_mask
from ..datamanagers.scene import ParsedScene
from ..errors import CheckpointError, DataError, UsageError
from ..io import tensorfiles
from ..io.atomic import unwritable, write_json
from ..io.strict_json import open_json, parse_json
from ..methods import load_config, save_config
from ..plugins.codec import from_json
from ..plugins.registry import nearest
from ..rendering.cameras import Cameras
from .model import Facts

FORMAT = 1
_SHOWN = 8
"""Views of the split `some`, at most."""
_CAMERA = {"pose": (3, 4), "focal": (2,), "centre": (2,), "size": (2,), "distortion": (6,), "lens": ()}
"""Fields of the cameras, and the shape of each for one view."""
_INTEGERS = ("size", "lens")


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
        count = min(_SHOWN, len(self.train))
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

    def photograph(
        self, captured: ParsedScene, view: int, *, masks: bool
    ) -> tuple[Annotated[Tensor, "H W 3"], Annotated[Tensor, "H W"] | None]:
        """The image of a view at the size of its camera, in [0, 1], and where it counts by the masks; None =
        everywhere.
        """
        width, height = self.cameras.size[view].tolist()
        image = (
            torch.from_numpy(load_image(captured.paths[view], (width, height), self.facts.background)).float()
            / 255
        )
        mask = None
        if captured.masks and masks:
            mask = captured.masks[view]
        return image, None if mask is None else torch.from_numpy(load_mask(mask, (width, height)))


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
            raise CheckpointError(
                f"{self.root}: no config.json here, so it is no run folder; `fprf train` makes one"
            )
        return load_config(self.root / "config.json")

    def save_known(self, scene: ParsedScene, data: Path | None, facts: Facts) -> None:
        """Write scene.json."""
        known = known_of(scene, data, facts)
        cameras = {}
        for key in _CAMERA:
            cameras[key] = getattr(scene.cameras, key).tolist()
        document = {"format": FORMAT, **vars(known), "cameras": cameras, "facts": dataclasses.asdict(facts)}
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
                facts=from_json(document["facts"], Facts, path="facts"),
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
    return [f"{i:05d}-{p.stem}" for i, p in enumerate(paths)]


try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]
LOCK = ".lock"
_NOTE = 200
"""Bytes of the holder's note that are repeated to others."""


@contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Hold a folder for the length of the block; it is made if need be, and removed again if it stays empty.

    Raises DataError where another process holds it, naming that, and where nothing can be written: before any
    work is done.
    """
    # The holder before may remove the file between opening and locking it: then a new one is opened.
    while (handle := _locked(folder)) is None:
        pass
    try:
        yield
    finally:
        with suppress(OSError):  # while it is held: who opened it before finds out in `_locked`
            (folder / LOCK).unlink()
        os.close(handle)
        with suppress(OSError):
            folder.rmdir()


def _locked(folder: Path) -> int | None:
    """Take the lock of a folder; None where its holder removed the file in between."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with ExitStack() as opened:
            handle = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT, 0o666)
            opened.callback(os.close, handle)
            # The kernel releases the lock of a process that dies; file systems without locks hold nothing.
            if fcntl is not None:
                try:
                    fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except OSError as error:
                    if error.errno in (errno.EAGAIN, errno.EACCES):
                        note = os.pread(handle, _NOTE, 0).decode(errors="replace").strip()
                        if note.isprintable() and note:
                            who = note
                        else:
                            who = "another process"
                        line = f"{folder}: {who} is training here; wait for it, end it, or choose another --output"
                        raise DataError(line) from error
                else:
                    os.ftruncate(handle, 0)
                    os.pwrite(handle, f"process {os.getpid()} on {socket.gethostname()}\n".encode(), 0)
            # Somebody may hold a file of this name that is not this one any more.
            with suppress(FileNotFoundError):
                if os.fstat(handle).st_ino == os.stat(folder / LOCK).st_ino:
                    opened.pop_all()  # it stays open
                    return handle
    except FileExistsError as error:
        raise DataError(f"{folder}: is a file, not a folder; choose another --output") from error
    except OSError as error:
        raise unwritable(folder, error) from error
    return None


def in_training(folder: Path) -> bool:
    """True while a process holds a folder: what it has learnt so far will change soon."""
    if fcntl is None or not (folder / LOCK).is_file():
        return False
    try:
        with (folder / LOCK).open() as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError as error:
        return error.errno in (errno.EAGAIN, errno.EACCES)
    return False


IMAGES = "images.json"
CHANGED_IMAGES = "--changed-images"
"""Flag of `fprf train` that goes on with images that have changed."""
_IMAGES_FORMAT = 1
_NAMED = 3


def image_hashes(scene: ParsedScene) -> dict[str, str]:
    """SHA-256 of each image's file, by the view's name. Raises DataError where one cannot be read."""

    def of(path: Path) -> str:
        try:
            with path.open("rb") as file:
                return hashlib.file_digest(file, "sha256").hexdigest()
        except OSError as error:
            raise DataError(
                f"{path}: cannot be read ({error.strerror}); check the path and its permissions"
            ) from error

    # Hashing waits for the disk, so files are read side by side.
    with ThreadPoolExecutor() as pool:
        return dict(zip(view_names(scene.paths), pool.map(of, scene.paths), strict=True))


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
    changed += [f"{files[name]} is new" for name in hashes if name not in before]
    changed += [f"{name} is gone" for name in before if name not in hashes]
    if changed:
        if len(changed) > _NAMED:
            more = f" and {len(changed) - _NAMED} more"
        else:
            more = ""
        raise UsageError(
            f"{root}: its images have changed since it was begun: {', '.join(changed[:_NAMED])}{more}; put them back, "
            f"choose another --output, or go on with these by {CHANGED_IMAGES}"
        )


class History(NamedTuple):
    """One training: of the run, or of one of its parts."""

    name: str
    """Empty for the run itself."""
    step: list[int]
    seconds: list[float]
    """Training time at each step, over all resumes."""
    values: dict[str, list[float | None]]
    """psnr, rays_per_second, kept and each loss by its name, at each step; None where a line does not say."""
    notes: list[str]
    """Faults of the training: skipped steps, damaged checkpoints, returns to an earlier one."""


def read_history(run: Path) -> list[History]:
    """The histories of a run and of its parts: blocks, or the overview and cells; those without any line are
    left out.

    Where a run was resumed from an earlier step, the later steps of the first try are dropped. Raises
    CheckpointError where there is no line at all.
    """
    parts = ("overview", "blocks/*", "cells/*")
    files = [
        run / "events.jsonl",
        *(file for part in parts for file in sorted(run.glob(f"{part}/events.jsonl"))),
    ]
    histories = []
    for file in files:
        if file.is_file():
            histories.append(_history("" if file.parent == run else file.parent.name, file))
    histories = [history for history in histories if history.step]
    if not histories:
        raise CheckpointError(
            f"{run}: no events.jsonl with a line of training; `fprf train` writes it as it goes"
        )
    return histories


def _history(name: str, file: Path) -> History:
    """The lines of a file, which a killed process may have cut short, and which may come from anywhere."""
    lines: list[dict[str, Any]] = []
    notes: list[str] = []
    for text in file.read_text("utf-8", errors="replace").splitlines():
        try:
            event = parse_json(text, nan=True)
        except ValueError:
            continue
        if not isinstance(event, dict):
            continue
        step = event.get("step")
        if type(step) is int and abs(step) < _LAST and _number(event.get("seconds")) is not None:
            # After a resume the steps come again.
            while lines and lines[-1]["step"] >= step:
                lines.pop()
            lines.append(event)
        else:
            notes.append(", ".join(f"{key.replace('_', ' ')}: {value}" for key, value in event.items()))
    # Losses stand beside the other figures of their line; what a line does not say is None.
    flat = [
        {**event, **(event["losses"] if isinstance(event.get("losses"), dict) else {})} for event in lines
    ]
    known = dict.fromkeys(key for event in flat for key in event if key not in ("step", "seconds", "losses"))
    values = {}
    for key in known:
        values[key] = [_number(event.get(key)) for event in flat]
    return History(name, [e["step"] for e in lines], [float(e["seconds"]) for e in lines], values, notes)


_LARGEST = 3.4e38
_LAST = 2**63
"""Bounds of figures (training computes in float32) and of steps: with those beyond, sums and charts would
overflow.
"""


def _number(value: object) -> float | None:
    """A figure as training writes it; None for anything else."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < _LARGEST:
        return None
    return float(value)
