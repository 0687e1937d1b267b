"""Files of network weights: read, written, known by their hash, found in caches or on the public server."""

import hashlib
import json
import os
import re
import urllib.error
import urllib.request
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, NamedTuple

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from ..errors import WeightsError
from ..io.atomic import write_bytes
from .config import Need, absent_file


def read_weights(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Tensors (half precision widened to float32) and metadata. Raises WeightsError where the file is absent or damaged."""
    if not path.is_file():
        raise WeightsError(f"{path}: no such weights file; name an existing one or make it with `fprf pretrain`")
    try:
        with safe_open(path, framework="pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            halves = (torch.float16, torch.bfloat16)
            wide = {name: tensor.float() if tensor.dtype in halves else tensor for name, tensor in tensors.items()}
            return wide, dict(file.metadata() or {})
    except (SafetensorError, OSError) as error:
        raise WeightsError(f"{path}: not a readable safetensors file ({error}); copy or download it again") from error


def write_weights(path: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> None:
    """Write all or nothing: a reader never meets half a file."""
    write_bytes(path, save({name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}, dict(metadata)))


def tensors_hash(tensors: Mapping[str, Tensor]) -> str:
    """First 12 hex digits of the SHA-256 over names, shapes and float32 values, in the order of the names."""
    # Values as float32, so that a file in half precision and its copy in full have one hash.
    digest = hashlib.sha256()
    for name in sorted(tensors):
        value = tensors[name].detach().to("cpu", torch.float32).contiguous()
        digest.update(f"{name}{tuple(value.shape)}".encode())
        digest.update(value.numpy().tobytes())
    return digest.hexdigest()[:12]


IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
CHUNK = 1 << 20
TIMEOUT_SECONDS = 30


class WeightSource(NamedTuple):
    """The public file of a network's weights."""

    network: str
    """Whose weights they are, for messages."""
    file: str
    """Name that the caches are searched for."""
    origin: str
    """Its URL; the file's name carries the beginning of its own SHA-256."""
    flag: str
    """Flag that names another file."""


def weights_needed(source: WeightSource, path: Path | None) -> tuple[Need, ...]:
    """Weights that `find_weights` would have to download."""
    if path is not None or _cached(source) is not None:
        return absent_file(path)
    target = _folders()[0] / source.file
    command = f"curl --create-dirs --output {target} {source.origin}, or name a file with {source.flag} FILE"
    return (Need(f"{source.network}'s weights {target}", command, downloaded=True),)


def _folders() -> tuple[Path, Path]:
    """fprf's cache, which downloads go to, and torch's."""
    return Path.home() / ".cache/fprf/weights", Path.home() / ".cache/torch/hub/checkpoints"


def _cached(source: WeightSource) -> Path | None:
    return next((folder / source.file for folder in _folders() if (folder / source.file).is_file()), None)


def find_weights(source: WeightSource, path: Path | None) -> Path:
    """The named file, else the cached one, else the download. Raises WeightsError where none of them is to be had."""
    if path is not None:
        return path
    cached = _cached(source)
    if cached is not None:
        return cached
    target = _folders()[0] / source.file
    target.parent.mkdir(parents=True, exist_ok=True)
    # Into a file of its own, whose hash is checked before it takes the name.
    partial = target.with_name(f"{source.file}.{os.getpid()}.partial")
    try:
        # The origins are ours, https, and what comes is hashed before it is used.
        with urllib.request.urlopen(source.origin, timeout=TIMEOUT_SECONDS) as response, partial.open("wb") as file:  # nosec B310
            while piece := response.read(CHUNK):
                file.write(piece)
        _check_hash(partial, source.file, source)
        partial.replace(target)
    except (urllib.error.URLError, OSError, TimeoutError) as error:
        raise WeightsError(
            f"{source.network}'s weights are not here and cannot be downloaded ({error}): put {source.origin} (SHA-256 begins "
            f"with {_expected(source.file)}) into {target.parent}, or name a file with {source.flag} FILE"
        ) from error
    finally:
        partial.unlink(missing_ok=True)
    return target


def read_tensors(path: Path, source: WeightSource) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Tensors and metadata of a safetensors file, or of a file of `torch.save` (which has no metadata), hash checked.

    Raises WeightsError where the file is absent, damaged, or another than its name promises.
    """
    if path.suffix == ".safetensors":
        return read_weights(path)
    if not path.is_file():
        raise WeightsError(f"{path}: no such weights file; {source.network}'s is {source.origin}")
    # A name with a hash is a promise that is kept before anything is unpacked.
    _check_hash(path, path.name, source)
    try:
        tensors = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # the unpickler raises whatever the bytes lead it to
        raise WeightsError(
            f"{path}: not a file of tensors ({type(error).__name__}); {source.network}'s is {source.origin}"
        ) from error
    if not isinstance(tensors, dict):
        raise WeightsError(
            f"{path}: holds a {type(tensors).__name__}, not named tensors; {source.network}'s is {source.origin}"
        )
    return {name: value.float() for name, value in tensors.items() if isinstance(value, Tensor)}, {}


def input_statistics(metadata: Mapping[str, str], path: Path) -> tuple[Annotated[Tensor, "3"], Annotated[Tensor, "3"]]:
    """Mean and deviation of a network's input, as the file's metadata says; ImageNet's where it says nothing."""
    stated = []
    for key, default in (("mean", IMAGENET_MEAN), ("std", IMAGENET_STD)):
        try:
            numbers = json.loads(metadata[key]) if key in metadata else default
            stated.append(torch.tensor(numbers, dtype=torch.float32).view(3))
        except (ValueError, RuntimeError, TypeError) as error:
            found = f"metadata {key!r} is {metadata[key]!r}"
            raise WeightsError(f"{path}: {found}, not three numbers such as [0.5,0.5,0.5]") from error
    return stated[0], stated[1]


def _expected(name: str) -> str | None:
    """Public files of weights carry the beginning of their own SHA-256 in their names."""
    match = re.search(r"-([0-9a-f]{8,})\.pth$", name)
    return match.group(1) if match else None


def _check_hash(path: Path, name: str, source: WeightSource) -> None:
    expected = _expected(name)
    if expected is None:
        return
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    if not digest.startswith(expected):
        raise WeightsError(
            f"{path}: SHA-256 begins with {digest[:8]}, its name promises {expected}; delete it and fetch {source.origin} again"
        )
