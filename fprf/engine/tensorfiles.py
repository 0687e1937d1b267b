"""Named tensors on disk: safetensors, written atomically, with a checksum and a finite flag for each tensor.

`save` returns the entry that a manifest keeps; `load` checks the file against it, so a flipped bit is found before it is used.
"""

import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
from safetensors import SafetensorError
from torch import Tensor

from ..errors import CheckpointError
from ..output.atomic import atomic_path

__all__ = ["load", "read", "save"]


def _checksum(tensor: Tensor) -> int:
    return zlib.crc32(tensor.detach().cpu().contiguous().view(-1).view(torch.uint8).numpy().data)


def save(path: Path, tensors: Mapping[str, Tensor]) -> dict[str, dict[str, Any]]:
    """Write the tensors; the answer holds checksum and finiteness of each."""
    plain = {name: t.detach().cpu().contiguous() for name, t in tensors.items()}
    with atomic_path(path) as temporary:
        safetensors.torch.save_file(plain, temporary)
    return {
        name: {"crc32": _checksum(t), "finite": bool(torch.isfinite(t).all()) if t.is_floating_point() else True}
        for name, t in plain.items()
    }


def load(path: Path, manifest: Mapping[str, Mapping[str, Any]]) -> dict[str, Tensor]:
    """The tensors of a file, checked against the manifest. Raises CheckpointError naming file and tensor."""
    tensors = read(path)
    if tensors.keys() != manifest.keys():
        odd = ", ".join(sorted(tensors.keys() ^ manifest.keys())[:3])
        raise CheckpointError(f"{path}: its tensors differ from its manifest ({odd}); use another checkpoint")
    for name, tensor in tensors.items():
        entry = dict(manifest[name]) if isinstance(manifest[name], Mapping) else {}
        if _checksum(tensor) != entry.get("crc32"):
            raise CheckpointError(f"{path}: tensor {name} is damaged (checksum differs); use another checkpoint")
        if not entry.get("finite"):
            raise CheckpointError(f"{path}: tensor {name} was not finite when saved; use another checkpoint")
    return tensors


def read(path: Path) -> dict[str, Tensor]:
    """The tensors of a file, unchecked. Raises CheckpointError where it is no such file."""
    try:
        return safetensors.torch.load_file(path)
    except (OSError, SafetensorError) as e:
        raise CheckpointError(f"{path}: cannot be read ({e}); use another checkpoint or train again") from e
