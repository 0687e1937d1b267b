"""One file a view: guided-filter coefficients in half precision, memory-mapped.

A file is named by the hash of everything that it was made from, holds a checksum of what it should contain, and appears
under its name only when it is whole. So whatever an interrupted run, a second writer or a bad disk leaves behind is either
right or made again; nothing is ever found by position.

Half precision keeps 11 bits of each number, so numbers are made small first: b is taken at mid-grey (colours are then in
[-0.5, 0.5]) and relative to its mean, and each channel is divided by its largest coefficient.
"""

import contextlib
import hashlib
import os
import time
import zlib
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Annotated, NamedTuple

import safetensors
import safetensors.torch
import torch
import torch.nn.functional as F
from safetensors import SafetensorError
from torch import Tensor

from ..io.atomic import atomic_path

__all__ = [
    "GREY",
    "LANES",
    "Entry",
    "digest",
    "keep_within",
    "pack",
    "read",
    "read_tensors",
    "remove_stale",
    "write",
    "write_tensors",
]

GREY = 0.5
LANES = 8
# Part of every key: raise it when the same inputs give other files.
FORMAT = "fprf-features-1"
# Stored numbers stay within +-TOP: far from half precision's 65504, and its 24 bits below 1 are left for the small ones.
TOP = 4096.0


class Entry(NamedTuple):
    """A view's features: F = scale (A (I - GREY) + b) + centre, with A and b interpolated over s x t cells."""

    coefs: Annotated[Tensor, "s t 4 P"]
    """float16: A for red, green, blue, then b; P is C rounded up to a multiple of LANES, zeros beyond C."""
    scale: Annotated[Tensor, "C"]
    centre: Annotated[Tensor, "C"]
    size: Annotated[Tensor, "2"]
    """Height, width of the image in pixels, int64."""
    moments: Annotated[Tensor, "2 C"]
    """Mean and variance of the features over the view's pixels, float64."""

    def plain(self) -> Annotated[Tensor, "s t C 4"]:
        """The coefficients as `ops.guided.coefficients` gives them, float32."""
        channels = len(self.scale)
        coefs = self.coefs[..., :channels].float() * self.scale
        coefs[..., 3, :] += self.centre - GREY * coefs[..., :3, :].sum(2)
        return coefs.transpose(2, 3)


def pack(coefs: Annotated[Tensor, "s t C 4"], size: tuple[int, int]) -> Entry:
    """Coefficients of `ops.guided` in storage form; moments are zero until somebody measures them."""
    channels = coefs.shape[2]
    runs = coefs.detach().cpu().float().transpose(2, 3).clone()
    runs[..., 3, :] += GREY * runs[..., :3, :].sum(2)
    centre = runs[..., 3, :].mean((0, 1))
    runs[..., 3, :] -= centre
    scale = runs.abs().amax((0, 1, 2)) / TOP
    scale = torch.where(scale > 0, scale, torch.ones_like(scale))
    halves = F.pad(runs / scale, (0, -channels % LANES)).half()
    return Entry(halves, scale, centre, torch.tensor(size), torch.zeros(2, channels, dtype=torch.float64))


def digest(*parts: str | bytes) -> str:
    """SHA-256 of the parts and the format, as 32 hexadecimal digits; parts cannot run into each other."""
    state = hashlib.sha256(FORMAT.encode())
    for part in parts:
        data = part.encode() if isinstance(part, str) else part
        state.update(len(data).to_bytes(8, "little"))
        state.update(data)
    return state.hexdigest()[:32]


def write(folder: Path, key: str, entry: Entry) -> None:
    """Keep an entry under its key, whole or not at all."""
    write_tensors(folder, key, entry._asdict())


def read(folder: Path, key: str) -> Entry | None:
    """The memory-mapped entry of a key; None where it is absent or not what it should be."""
    tensors = read_tensors(folder, key)
    return Entry(**tensors) if tensors is not None and tensors.keys() == set(Entry._fields) else None


def write_tensors(folder: Path, key: str, tensors: Mapping[str, Tensor]) -> None:
    """Named tensors in FOLDER/KEY.safetensors with key and checksum."""
    plain = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    with atomic_path(folder / f"{key}.safetensors") as temporary:
        safetensors.torch.save_file(plain, temporary, metadata={"key": key, "crc32": str(_checksum(plain))})


def read_tensors(folder: Path, key: str) -> dict[str, Tensor] | None:
    """What `write_tensors` wrote under the key; None where it is absent, damaged or of another key."""
    path = folder / f"{key}.safetensors"
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (OSError, SafetensorError):
        return None
    with contextlib.suppress(OSError):  # a cache that is only read; its order of use is then not known
        os.utime(path)
    right = metadata.get("key") == key and metadata.get("crc32") == str(_checksum(tensors))
    return tensors if right else None


def keep_within(folder: Path, size: int, used: Collection[str]) -> None:
    """Delete the files that were used longest ago until at most `size` bytes are left, but none whose key is in `used`.

    Whoever has one mapped keeps it on POSIX; on Windows it stays.
    """
    files = []
    for path in folder.glob("[!.]*.safetensors"):
        with contextlib.suppress(OSError):  # another process was first
            files.append((path.stat().st_mtime, path.stat().st_size, path))
    total = sum(bytes_of for _, bytes_of, _ in files)
    for _, bytes_of, path in sorted(files):
        if total <= size:
            return
        if path.stem not in used:
            with contextlib.suppress(OSError):
                path.unlink()
                total -= bytes_of


def remove_stale(folder: Path, hours: float = 1.0) -> None:
    """Delete unfinished files of processes that died; younger ones may belong to a living writer."""
    for path in folder.glob(".*.safetensors"):
        try:
            if time.time() - path.stat().st_mtime > 3600 * hours:
                path.unlink()
        except OSError:  # another process was first
            continue


def _checksum(tensors: Mapping[str, Tensor]) -> int:
    result = 0
    for name in sorted(tensors):
        tensor = tensors[name]
        result = zlib.crc32(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode(), result)
        result = zlib.crc32(tensor.reshape(-1).view(torch.uint8).numpy().data, result)
    return result
