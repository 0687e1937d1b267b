"""Named tensors on disk: safetensors, written atomically, with a checksum and a finite flag for each tensor.

`save` returns the entry that a manifest keeps; `load` checks the file against it, so a flipped bit is found
before it is used. A sealed file is one that carries its own manifest.
"""

import json
import re
import zlib
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from ..errors import CheckpointError, WriteError
from .atomic import atomic_path, unwritable
from .cache import reason_of, say_uncached, temporary_folder

_MANIFEST = "manifest"
"""Entry of a sealed file's metadata that holds its manifest."""
_SYSTEM = re.compile(r"os error (\d+)")
"""Number of the system's error in a message of safetensors."""


def _plain(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The tensors as a reader maps them: contiguous, on the CPU."""
    found: dict[str, Tensor] = {}
    for name, tensor in tensors.items():
        found[name] = tensor.detach().cpu().contiguous()
    return found


def _checksum(tensor: Tensor) -> int:
    return zlib.crc32(tensor.detach().cpu().contiguous().view(-1).view(torch.uint8).numpy().data)


def save(path: Path, tensors: Mapping[str, Tensor], *, sealed: bool = False) -> dict[str, dict[str, Any]]:
    """Write the tensors; the answer holds checksum and finiteness of each, and so does the file where it is
    `sealed`.

    Raises WriteError, with what is needed and what is free, where the system refuses.
    """
    # Checksums are of the bytes that a reader will map.
    plain = _plain(tensors)
    entries = {}
    for name, t in plain.items():
        entries[name] = {
            "crc32": _checksum(t),
            "finite": bool(torch.isfinite(t).all()) if t.is_floating_point() else True,
        }
    with atomic_path(path) as temporary:
        try:
            safetensors.torch.save_file(
                plain, temporary, {_MANIFEST: json.dumps(entries)} if sealed else None
            )
        except SafetensorError as error:
            # safetensors wraps errors of the system in its own: their number says what the disk refused.
            match = _SYSTEM.search(str(error))
            if match is None:
                raise
            needed = sum(t.nbytes for t in plain.values())
            raise unwritable(path, OSError(int(match[1]), str(error)), needed) from error
    return entries


def keep(path: Path, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The tensors, mapped from a sealed file of a cache that is written to `path`.

    Where the system refuses it, which one line says, from a file that ends with this process; where it
    refuses that, too, as they are, in memory.
    """
    kept = save_kept(path, tensors)
    if not kept:
        folder = temporary_folder("tensors")
        if folder is not None:
            path = folder / path.name
            kept = save_kept(path, tensors)
    if kept:
        with suppress(CheckpointError):  # another process removed it already, or the disk is bad
            return load_sealed(path)
    return _plain(tensors)


def save_kept(path: Path, tensors: Mapping[str, Tensor]) -> bool:
    """Write a sealed file of a cache; False where the system refuses, which one line says."""
    try:
        save(path, tensors, sealed=True)
    except WriteError as error:
        say_uncached(path.parent, reason_of(error))
        return False
    return True


def load_sealed(path: Path) -> dict[str, Tensor]:
    """The tensors of a sealed file, checked. Raises CheckpointError naming file and tensor."""
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
    except (OSError, SafetensorError) as e:
        raise CheckpointError(f"{path}: cannot be read ({e}); train again") from e
    try:
        manifest = json.loads(metadata[_MANIFEST])
        return load(path, {name: dict(entry) for name, entry in manifest.items()})
    except (KeyError, ValueError, TypeError, AttributeError, RecursionError) as e:
        raise CheckpointError(f"{path}: its checksums cannot be read ({e!r}); train again") from e


def load(path: Path, manifest: Mapping[str, Mapping[str, Any]]) -> dict[str, Tensor]:
    """The tensors of a file, checked against the manifest. Raises CheckpointError naming file and tensor."""
    tensors = read(path)
    if tensors.keys() != manifest.keys():
        odd = ", ".join(sorted(tensors.keys() ^ manifest.keys())[:3])
        raise CheckpointError(f"{path}: its tensors differ from its manifest ({odd}); use another checkpoint")
    for name, tensor in tensors.items():
        if isinstance(manifest[name], Mapping):
            entry = dict(manifest[name])
        else:
            entry = {}
        if _checksum(tensor) != entry.get("crc32"):
            raise CheckpointError(
                f"{path}: tensor {name} is damaged (checksum differs); use another checkpoint"
            )
        if not entry.get("finite"):
            raise CheckpointError(f"{path}: tensor {name} was not finite when saved; use another checkpoint")
    return tensors


def read(path: Path) -> dict[str, Tensor]:
    """The tensors of a file, unchecked. Raises CheckpointError where it is no such file."""
    try:
        return safetensors.torch.load_file(path)
    except (OSError, SafetensorError) as e:
        raise CheckpointError(f"{path}: cannot be read ({e}); use another checkpoint or train again") from e
