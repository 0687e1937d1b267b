"""Where VGG-19's weights come from: a named file, a cache, or torchvision's server, checked by hash."""

import hashlib
import json
import os
import re
import urllib.error
import urllib.request
from pathlib import Path
from typing import Annotated

import torch
from torch import Tensor

from ...errors import WeightsError
from ..weightfiles import read_weights
from .vgg import Vgg19Encoder, vgg19_activations

__all__ = ["build_vgg19", "pink_noise"]

FILE = "vgg19-dcbb9e9d.pth"
URL = f"https://download.pytorch.org/models/{FILE}"
IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
CHUNK = 1 << 20
TIMEOUT_SECONDS = 30


def build_vgg19(layer: str, *, weights: Path | None, normalise: bool) -> Vgg19Encoder:
    """The encoder from a file, the cache or the download. Raises WeightsError where none of them serves."""
    path = weights if weights is not None else _cached() or _download()
    tensors, metadata = read_weights(path) if path.suffix == ".safetensors" else (_read_pth(path), {})
    mean, std = (_triple(metadata, key, path) for key in ("mean", "std"))
    if not normalise:
        return Vgg19Encoder(layer, tensors, mean=mean, std=std, scale=None, source=str(path))
    scale = tensors.get(f"mean_activation.conv{layer[4:]}")
    if scale is None:
        # Few files bring their own means; noise with the spectrum of photographs estimates those of the others.
        unscaled = Vgg19Encoder(layer, tensors, mean=mean, std=std, scale=torch.ones(1), source=str(path))
        scale = vgg19_activations(unscaled, pink_noise()).float()
    scale = scale.clamp_min(1e-3 * float(scale.mean()))  # a filter that hardly ever fires must not be blown up
    return Vgg19Encoder(layer, tensors, mean=mean, std=std, scale=scale, source=str(path))


def pink_noise(images: int = 8, size: int = 128) -> Annotated[Tensor, "B 3 H W"]:
    """Images with the 1/f spectrum, contrast and grey axis of photographs; always the same ones."""
    generator = torch.Generator().manual_seed(0)
    frequency = torch.hypot(torch.fft.fftfreq(size)[:, None], torch.fft.rfftfreq(size)[None]).clamp_min(1 / size)
    spectrum = torch.fft.rfft2(torch.randn(images, 3, size, size, generator=generator)) / frequency
    noise = torch.fft.irfft2(spectrum, s=(size, size))
    noise = noise / noise.std(dim=(2, 3), keepdim=True)
    grey, warm, green = noise.unbind(1)
    # Opponent axes with the spread that photographs have: light 0.22, yellow-blue 0.06, red-green 0.03.
    rgb = torch.stack([grey * 0.22 + warm * 0.06 + green * 0.03, grey * 0.22 - green * 0.03, grey * 0.22 - warm * 0.06], 1)
    return (0.45 + rgb).clamp(0, 1)


def _cached() -> Path | None:
    for folder in (_cache_folder(), Path.home() / ".cache/torch/hub/checkpoints"):
        if (folder / FILE).is_file():
            return folder / FILE
    return None


def _cache_folder() -> Path:
    return Path.home() / ".cache/fprf/weights"


def _download() -> Path:
    target = _cache_folder() / FILE
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = target.with_name(f"{FILE}.{os.getpid()}.partial")
    try:
        with urllib.request.urlopen(URL, timeout=TIMEOUT_SECONDS) as response, partial.open("wb") as file:
            while piece := response.read(CHUNK):
                file.write(piece)
        _check_hash(partial, FILE)
        partial.replace(target)
    except (urllib.error.URLError, OSError, TimeoutError) as error:
        raise WeightsError(
            f"VGG-19's weights are not here and cannot be downloaded ({error}): put {URL} (SHA-256 begins with "
            f"{_expected(FILE)}) into {target.parent}, or name a file with --content.encoder.weights FILE"
        ) from error
    finally:
        partial.unlink(missing_ok=True)
    return target


def _read_pth(path: Path) -> dict[str, Tensor]:
    if not path.is_file():
        raise WeightsError(f"{path}: no such weights file; torchvision's is {URL}")
    _check_hash(path, path.name)
    try:
        tensors = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # the unpickler raises whatever the bytes lead it to
        raise WeightsError(f"{path}: not a file of tensors ({type(error).__name__}); torchvision's is {URL}") from error
    if not isinstance(tensors, dict):
        raise WeightsError(f"{path}: holds a {type(tensors).__name__}, not named tensors; torchvision's is {URL}")
    return {name: value for name, value in tensors.items() if isinstance(value, Tensor)}


def _expected(name: str) -> str | None:
    """torchvision's file names carry the beginning of their own SHA-256."""
    match = re.search(r"-([0-9a-f]{8,})\.pth$", name)
    return match.group(1) if match else None


def _check_hash(path: Path, name: str) -> None:
    expected = _expected(name)
    if expected is None:
        return
    with path.open("rb") as file:
        found = hashlib.file_digest(file, "sha256").hexdigest()
    if not found.startswith(expected):
        raise WeightsError(
            f"{path}: SHA-256 begins with {found[:8]}, its name promises {expected}; delete it and fetch {URL} again"
        )


def _triple(metadata: dict[str, str], key: str, path: Path) -> Annotated[Tensor, "3"]:
    if key not in metadata:
        return torch.tensor(IMAGENET_MEAN if key == "mean" else IMAGENET_STD)
    try:
        return torch.tensor(json.loads(metadata[key]), dtype=torch.float32).view(3)
    except (ValueError, RuntimeError, TypeError) as error:
        raise WeightsError(f"{path}: metadata {key!r} is {metadata[key]!r}, not three numbers such as [0.5,0.5,0.5]") from error
