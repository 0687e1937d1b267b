"""Checkpoints: `checkpoints/step-N/` with model, optimiser and a manifest that is written last.

A folder without a valid manifest was cut short and does not count. The two newest are kept. All draws are
functions of (seed, step), so parameters, moments and the step are all there is to save.
"""

import json
import math
import shutil
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from ..errors import CheckpointError, DataError
from ..interfaces import State
from ..io import tensorfiles
from ..io.atomic import remove_unfinished, write_json
from ..io.strict_json import open_json

KEEP = 2
"""Checkpoints that stay on disk."""


class Saved(NamedTuple):
    """Content of a checkpoint."""

    step: int
    seconds: float
    """Training time until then."""
    model: dict[str, Tensor]
    optimizer: dict[str, Tensor]

    @property
    def state(self) -> State:
        """The tensors for `Learner.load`."""
        return State(self.model, self.optimizer)


def _folder(root: Path, step: int) -> Path:
    return root / f"step-{step:07d}"


def steps(root: Path) -> list[int]:
    """Steps of the complete checkpoints, oldest first."""
    numbers = []
    for manifest in root.glob("step-*/manifest.json"):
        digits = manifest.parent.name.removeprefix("step-")
        if digits.isdecimal():
            numbers.append(int(digits))
    return sorted(numbers)


def write(
    root: Path, model: Mapping[str, Tensor], optimizer: Mapping[str, Tensor], *, step: int, seconds: float
) -> Path:
    """Write the checkpoint of a step, then drop all but the newest two; later ones are of a past that was
    gone back from.

    Raises DataError where the system refuses; what was there before is then there still.
    """
    folder = _folder(root, step)
    try:
        files = {
            "model": tensorfiles.save(folder / "model.safetensors", model),
            "optimizer": tensorfiles.save(folder / "optimizer.safetensors", optimizer),
        }
        # Last of all, so that a folder with a manifest is whole.
        manifest = {"format": 1, "step": step, "seconds": seconds, "files": files}
        write_json(folder / "manifest.json", manifest | {"crc32": _checksum(manifest)})
    except DataError:
        tidy(root)
        raise
    # The manifest goes first: without it a folder does not count, also where this is cut short.
    written = steps(root)
    for old in [s for s in written if s <= step][:-KEEP] + [s for s in written if s > step]:
        (_folder(root, old) / "manifest.json").unlink()
        shutil.rmtree(
            _folder(root, old), ignore_errors=True
        )  # files that somebody has open stay; `tidy` removes them later
    return folder


def tidy(root: Path) -> None:
    """Remove what was cut short: folders without a manifest, unfinished files. Only where nobody else
    writes.
    """
    complete = set()
    for step in steps(root):
        complete.add(_folder(root, step))
    for folder in root.glob("step-*"):
        if folder in complete:
            remove_unfinished(folder)
        elif folder.name.removeprefix("step-").isdecimal() and not (folder / "manifest.json").exists():
            shutil.rmtree(folder, ignore_errors=True)


def load(root: Path, step: int, *, verify: bool = True) -> Saved:
    """One checkpoint. Its tensors are mapped from files: only to `verify` them they are read. Raises
    CheckpointError.
    """
    folder = _folder(root, step)
    manifest = _read(root, step)
    files = {}
    for name, entries in manifest.files.items():
        files[name] = (folder / f"{name}.safetensors", entries)
    if verify:
        model = tensorfiles.load(*files["model"])
    else:
        model = tensorfiles.read(files["model"][0])
    if verify:
        optimizer = tensorfiles.load(*files["optimizer"])
    else:
        optimizer = tensorfiles.read(files["optimizer"][0])
    return Saved(step, manifest.seconds, model, optimizer)


def digest(root: Path) -> str:
    """Return a short key of the tensors in the newest checkpoint's manifest; empty without one."""
    kept = steps(root)
    try:
        if kept:
            return f"{_read(root, kept[-1]).checksum:08x}"
        return ""
    except CheckpointError:
        return ""


def _checksum(manifest: dict[str, Any]) -> int:
    return zlib.crc32(json.dumps(manifest, sort_keys=True).encode())


class _Manifest(NamedTuple):
    seconds: float
    files: dict[str, dict[str, Any]]
    checksum: int


def _read(root: Path, step: int) -> _Manifest:
    """A manifest, checked; those of before had no checksum of their own. Raises CheckpointError."""
    with open_json(_folder(root, step) / "manifest.json", "use another checkpoint") as manifest:
        if manifest.pop("crc32", None) not in (None, checksum := _checksum(manifest)):
            raise ValueError("its checksum differs")
        at = int(manifest["step"])
        seconds = float(manifest["seconds"])
        files = {}
        for name in ("model", "optimizer"):
            files[name] = dict(manifest["files"][name])
        if at != step or not math.isfinite(seconds):
            raise ValueError(f"it speaks of step {at} after {seconds} s")
        return _Manifest(seconds, files, checksum)


def load_latest(root: Path, *, verify: bool = True) -> tuple[Saved | None, list[str]]:
    """The newest intact checkpoint, and a line for every newer one that was damaged. Raises where all are
    damaged.
    """
    # From the newest backwards, since a disk that failed has mostly failed at the last one.
    damaged: list[str] = []
    for step in reversed(steps(root)):
        try:
            return load(root, step, verify=verify), damaged
        except CheckpointError as e:
            damaged.append(str(e))
    if damaged:
        raise CheckpointError(f"{root}: no intact checkpoint; the newest says: {damaged[0]}")
    return None, damaged


def misfit(module: nn.Module, tensors: Mapping[str, Tensor]) -> str | None:
    """Name of a tensor that is absent, of another shape, or not the module's; None where all are those of its
    state.
    """
    own = module.state_dict()
    wrong = []
    for name in own:
        if name not in tensors or own[name].shape != tensors[name].shape:
            wrong.append(name)
    for name in tensors:
        if name not in own:
            wrong.append(name)
    return wrong[0] if wrong else None


def restore(state: State, model: nn.Module, optimizer: torch.optim.Optimizer | None) -> None:
    """Put a state into a model and its optimiser. Raises CheckpointError where they are of another config."""
    wrong = misfit(model, state.model)
    if wrong is not None:
        raise CheckpointError(f"{wrong} does not fit the config; it was changed since")
    model.load_state_dict(state.model)
    if optimizer is None:
        return
    # Files name moments by their parameter's number, as torch's own state does.
    moments: dict[int, dict[str, Tensor]] = {}
    for name, tensor in state.optimizer.items():
        index, key = name.split(".", 1)
        moments.setdefault(int(index), {})[key] = tensor
    optimizer.load_state_dict(optimizer.state_dict() | {"state": moments})


def moments_of(optimizer: torch.optim.Optimizer) -> dict[str, Tensor]:
    """The tensors of an optimiser by the number of their parameter and their own name, as `restore` reads
    them.
    """
    found: dict[str, Tensor] = {}
    for index, values in optimizer.state_dict()["state"].items():
        for key, value in values.items():
            if isinstance(value, Tensor):
                found[f"{index}.{key}"] = value
    return found
