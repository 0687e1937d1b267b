"""VGG-19 (Simonyan and Zisserman) up to any layer, plain or normalised as AdaIN and FPRF use it.

Normalised: every filter is divided by its mean activation on photographs, borders are mirrored; features are
then O(1). Pools round up, so that no pixel is lost: the last cell of an odd axis covers what is left.

Weights come as torchvision has them, or normalised as AdaIN has them. VGG-19 up to relu2_1, the paper's
content encoder, ships with the package; torchvision's file is found in the caches or on the public server.
"""

import hashlib
import json
import math
import os
import re
import urllib.error
import urllib.request
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Annotated

import torch
import torch.nn.functional as F
from torch import Tensor

from ...errors import WeightsError
from ...io.cache import cache_folder, user_folder
from ..config import Need, absent_file
from ..weights import IMAGENET_MEAN, IMAGENET_STD, read_weights, tensors_hash
from .frozen import FrozenEncoder, freeze, reflect_pad, street

_CONVOLUTION_NAMES = [
    f"{block}_{index}" for block, depth in enumerate((2, 2, 4, 4, 4), 1) for index in range(1, depth + 1)
]
"""Names of the convolutions, block by block."""
CONVOLUTIONS: Mapping[str, int] = {
    name: 2 * at + int(name[0]) - 1 for at, name in enumerate(_CONVOLUTION_NAMES)
}
"""Place of each convolution in torchvision's `features`: with its ReLU it takes two, a pool one after each
block.
"""


class VggEncoder(FrozenEncoder):
    """One layer of VGG-19. `scale` [C] divides the features where they are normalised, None leaves them
    plain.
    """

    def __init__(
        self,
        layer: str,
        tensors: Mapping[str, Tensor],
        *,
        mean: Annotated[Tensor, "3"],
        std: Annotated[Tensor, "3"],
        scale: Annotated[Tensor, "C"] | None,
        source: str,
    ) -> None:
        # Tensors of the convolutions up to the layer, each of which the file must hold.
        names = _CONVOLUTION_NAMES[: _CONVOLUTION_NAMES.index(layer[4:]) + 1]
        used = {"mean": mean.float(), "std": std.float()}
        for index, name in enumerate(names):
            for part in ("weight", "bias"):
                key = f"features.{CONVOLUTIONS[name]}.{part}"
                if key not in tensors:
                    held = []
                    for each in names[:index]:
                        held.append(f"relu{each}")
                    raise WeightsError(
                        f"{source}: holds no conv{name} ({key} is missing); its layers are "
                        f"{', '.join(held) or 'none of VGG-19'}; choose one of these, or name a file that reaches further "
                        "with --content.encoder.weights FILE"
                    )
                value = tensors[key].float()
                odd = value.ndim != 4 or value.shape[2:] != (3, 3) or not math.isfinite(float(value.sum()))
                if part == "weight" and odd:
                    found = f"{key} has shape {tuple(value.shape)}"
                    raise WeightsError(f"{source}: {found}, not that of a 3x3 convolution of VGG-19")
                used[f"{part}{index}"] = value
        # What divides the features is part of the identity, as the tensors are.
        channels = len(used[f"bias{len(names) - 1}"])
        if scale is None:
            used["scale"] = torch.ones(channels)
        else:
            used["scale"] = scale.float()
        kind = "plain" if scale is None else "normalised"
        super().__init__(f"vgg19:{layer}:{kind}:{tensors_hash(used)}", channels)
        self.names = names
        self._layer = layer
        self._normalised = scale is not None
        for key, value in used.items():
            self.register_buffer(key, value)
        freeze(self)

    @torch.no_grad()
    def forward(self, image: Annotated[Tensor, "B 3 H W"]) -> Annotated[Tensor, "B C h w"]:
        """Features at stride 1, 2, 4, 8 or 16, by the block of the layer."""
        x = image
        for x in self.activations(image):  # noqa: B007  # only the last one counts, and the others need not be kept
            pass
        return x / self._column("scale", x)

    def activations(self, image: Annotated[Tensor, "B 3 H W"]) -> Iterator[Annotated[Tensor, "B K h w"]]:
        """Activations of each convolution, layer after layer and undivided; gradients pass through."""
        x = (image - self._column("mean", image)) / self._column("std", image)
        # A pool before each block but the first, and the last ReLU only if the layer is one.
        for index, name in enumerate(self.names):
            if index and name.endswith("_1"):
                x = F.max_pool2d(x, 2, ceil_mode=True)
            if self._normalised:
                x = reflect_pad(x)
            else:
                x = F.pad(x, (1, 1, 1, 1))
            x = F.conv2d(x, self.get_buffer(f"weight{index}").to(x), self.get_buffer(f"bias{index}").to(x))
            if index < len(self.names) - 1 or self._layer.startswith("relu"):
                x = F.relu(x)
            yield x

    def _column(self, name: str, like: Tensor) -> Tensor:
        return self.get_buffer(name).to(like).view(1, -1, 1, 1)


def vgg_activations(encoder: VggEncoder, images: Annotated[Tensor, "B 3 H W"]) -> Annotated[Tensor, "C"]:
    """Mean of each filter's ReLU output over images, in float64: what `scale` is made of."""
    return F.relu(encoder(images)).double().mean(dim=(0, 2, 3))


FLAG = "--content.encoder.weights"
FILE = "vgg19-dcbb9e9d.pth"
ORIGIN = f"https://download.pytorch.org/models/{FILE}"
"""torchvision's file: its name carries the beginning of its own SHA-256."""
CHUNK = 1 << 20
"""Bytes that are downloaded at a time: an interrupt waits for no more."""
TIMEOUT_SECONDS = 30
"""Seconds of silence after which a download is given up; by eye."""
RAREST = 0.05
"""Mean activation of the rarest filters, as a share of the mean over all: on photographs none of VGG-19 is
below that.
"""
BUNDLED = Path(__file__).parent / "weights" / "vgg19-relu2_1.safetensors"
"""VGG-19's conv1_1, conv1_2 and conv2_1 (CC BY 4.0, Simonyan and Zisserman), which decoders ship for."""
BUNDLED_LAYERS = ("1_1", "1_2", "2_1")


def _available(layer: str, path: Path | None) -> Path | None:
    """The named file, else the package's where it holds the layer, else the cached one (fprf's or
    torch's).
    """
    if path is not None or layer[4:] in BUNDLED_LAYERS:
        return path or BUNDLED
    # Also at home where XDG_CACHE_HOME names another cache.
    for cache in (user_folder("").parent, Path(os.path.expanduser("~/.cache"))):
        for name in ("fprf/weights", "torch/hub/checkpoints"):
            file = cache / name / FILE
            if os.path.isfile(file):  # False also where the folder is closed to us
                return file
    return None


def weights_needed(layer: str, path: Path | None) -> tuple[Need, ...]:
    """Weights that `build_vgg` would have to download, or a named file that is not there."""
    if _available(layer, path) is not None:
        return absent_file(path)
    target = user_folder("weights") / FILE
    command = f"curl --create-dirs --output {target} {ORIGIN}, or name a file with {FLAG} FILE"
    return (Need(f"VGG-19's weights {target}", command, downloaded=True),)


def _download() -> Path:
    """Download torchvision's file into fprf's cache. Raises WeightsError where it is not to be had."""
    target = cache_folder("weights") / FILE
    # Into a file of its own, whose hash is checked before it takes the name.
    partial_file = target.with_name(f"{FILE}.{os.getpid()}.partial")
    try:
        # The origin is ours, https, and what comes is hashed before it is used.
        with (
            urllib.request.urlopen(ORIGIN, timeout=TIMEOUT_SECONDS) as response,
            partial_file.open("wb") as file,
        ):  # nosec B310
            while piece := response.read(CHUNK):
                file.write(piece)
        _check_hash(partial_file, FILE)
        partial_file.replace(target)
    except (urllib.error.URLError, OSError, TimeoutError) as error:
        raise WeightsError(
            f"VGG-19's weights are not here and cannot be downloaded ({error}): put {ORIGIN} (SHA-256 begins with "
            f"{_expected(FILE)}) into {user_folder('weights')}, or name a file with {FLAG} FILE"
        ) from error
    finally:
        partial_file.unlink(missing_ok=True)
    return target


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Tensors and metadata of a safetensors file, or of a file of `torch.save` (which has no metadata), hash
    checked.

    Raises WeightsError where the file is absent, damaged, or another than its name promises.
    """
    if path.suffix == ".safetensors":
        return read_weights(path)
    if not path.is_file():
        raise WeightsError(f"{path}: no such weights file; VGG-19's is {ORIGIN}")
    # A name with a hash is a promise that is kept before anything is unpacked.
    _check_hash(path, path.name)
    try:
        tensors = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # the unpickler raises whatever the bytes lead it to
        raise WeightsError(
            f"{path}: not a file of tensors ({type(error).__name__}); VGG-19's is {ORIGIN}"
        ) from error
    if not isinstance(tensors, dict):
        raise WeightsError(
            f"{path}: holds a {type(tensors).__name__}, not named tensors; VGG-19's is {ORIGIN}"
        )
    return {name: value.float() for name, value in tensors.items() if isinstance(value, Tensor)}, {}


def _expected(name: str) -> str | None:
    """Public files of weights carry the beginning of their own SHA-256 in their names."""
    match = re.search(r"-([0-9a-f]{8,})\.pth$", name)
    return match.group(1) if match else None


def _check_hash(path: Path, name: str) -> None:
    expected = _expected(name)
    if expected is None:
        return
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    if not digest.startswith(expected):
        raise WeightsError(
            f"{path}: SHA-256 begins with {digest[:8]}, its name promises {expected}; delete it and fetch {ORIGIN} again"
        )


def input_statistics(
    metadata: Mapping[str, str], path: Path
) -> tuple[Annotated[Tensor, "3"], Annotated[Tensor, "3"]]:
    """Mean and deviation of a network's input, as the file's metadata says; ImageNet's where it says
    nothing.
    """
    stated = []
    for key, default in (("mean", IMAGENET_MEAN), ("std", IMAGENET_STD)):
        try:
            if key in metadata:
                numbers = json.loads(metadata[key])
            else:
                numbers = default
            stated.append(torch.tensor(numbers, dtype=torch.float32).view(3))
        except (ValueError, RuntimeError, TypeError) as error:
            found = f"metadata {key!r} is {metadata[key]!r}"
            raise WeightsError(f"{path}: {found}, not three numbers such as [0.5,0.5,0.5]") from error
    return stated[0], stated[1]


def build_vgg(layer: str, *, weights: Path | None, normalise: bool) -> VggEncoder:
    """The encoder from a file, the package, the cache or the download. Raises WeightsError where none of them
    serves.
    """
    path = _available(layer, weights) or _download()
    tensors, metadata = read_tensors(path)
    # Whose file it is says what its network wants of the input: AdaIN's RGB as it is.
    divided = tensors.get("0.weight", torch.empty(0)).shape == (3, 3, 1, 1)
    if divided:
        tensors = _from_adain(tensors)
        mean = torch.zeros(3)
        std = torch.ones(3)
    else:
        mean, std = input_statistics(metadata, path)
    encoder = partial(VggEncoder, layer, tensors, mean=mean, std=std, source=str(path))
    if not normalise:
        if divided:
            raise WeightsError(
                f"{path}: holds the normalised VGG-19 of AdaIN, which cannot be made plain again; "
                f"leave normalise on, or name a file of plain weights with {FLAG} FILE"
            )
        return encoder(scale=None)
    if divided:
        return encoder(scale=torch.ones(1))
    scale = tensors.get(f"mean_activation.conv{layer[4:]}")
    if scale is not None:
        return encoder(scale=scale.clamp_min(1e-3 * float(scale.mean())))
    # Few files bring their own means. On the town each filter's is within a factor of two of that on
    # photographs (VGG-19, standard deviation of the log 0.19 at relu2_1, 0.35 at relu3_1), but for filters
    # that find nothing there to answer to.
    scale = vgg_activations(encoder(scale=torch.ones(1)), street()).float()
    return encoder(scale=scale.clamp_min(RAREST * float(scale.mean())))


def _from_adain(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """VGG-19 from AdaIN's list of layers: padding, convolution and ReLU take three places, a pool one after
    each block.

    The 1x1 convolution at its start turns colours; it goes into the first 3x3 one, which mirrored borders
    leave exact.
    """
    # Their places to torchvision's.
    renamed = {}
    for at, (name, place) in enumerate(CONVOLUTIONS.items()):
        theirs = 2 + 3 * at + int(name[0]) - 1
        for part in ("weight", "bias"):
            if f"{theirs}.{part}" in tensors:
                renamed[f"features.{place}.{part}"] = tensors[f"{theirs}.{part}"]
    # w3 * (w1 x + b1) + b3 is one convolution: (w3 w1) * x + (sum w3 b1 + b3).
    if {"features.0.weight", "features.0.bias"} <= renamed.keys() and "0.bias" in tensors:
        first = renamed["features.0.weight"].double()
        turn = tensors["0.weight"][:, :, 0, 0].double()
        shift = tensors["0.bias"].double()
        renamed["features.0.weight"] = torch.einsum("okyx,ki->oiyx", first, turn).float()
        renamed["features.0.bias"] = (
            renamed["features.0.bias"] + torch.einsum("okyx,k->o", first, shift)
        ).float()
    return renamed
