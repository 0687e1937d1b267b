"""VGG-16 and VGG-19 (Simonyan and Zisserman) up to any layer, plain or normalised as AdaIN and FPRF use them.

Normalised: every filter is divided by its mean activation on photographs, borders are mirrored; features are then O(1).
Pools round up, so that no pixel is lost: the last cell of an odd axis covers what is left.

Weights come as torchvision, Caffe and Keras have them, or normalised as AdaIN has them. VGG-19 up to relu2_1, the paper's
content encoder, ships with the package.
"""

import math
import re
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated

import torch
import torch.nn.functional as F
from torch import Tensor

from ...errors import WeightsError
from ..weights import WeightSource, find_weights, input_statistics, read_tensors, tensors_hash
from .frozen import FrozenEncoder, freeze, reflect_pad, street


def _places(depths: Sequence[int]) -> Mapping[str, int]:
    """Convolution and ReLU take two places, a pool one after each block."""
    names = [(block, index) for block, depth in enumerate(depths) for index in range(depth)]
    return {f"{block + 1}_{index + 1}": 2 * at + block for at, (block, index) in enumerate(names)}


CONVOLUTIONS: Mapping[str, Mapping[str, int]] = {"vgg16": _places((2, 2, 3, 3, 3)), "vgg19": _places((2, 2, 4, 4, 4))}
"""Place of each convolution in torchvision's `features`, by network."""


class VggEncoder(FrozenEncoder):
    """One layer of a VGG. `scale` [C] divides the features where they are normalised, None leaves them plain."""

    def __init__(
        self,
        network: str,
        layer: str,
        tensors: Mapping[str, Tensor],
        *,
        mean: Annotated[Tensor, "3"],
        std: Annotated[Tensor, "3"],
        scale: Annotated[Tensor, "C"] | None,
        source: str,
    ) -> None:
        # Tensors of the convolutions up to the layer, each of which the file must hold.
        every = list(CONVOLUTIONS[network])
        names = every[: every.index(layer[4:]) + 1]
        used = {"mean": mean.float(), "std": std.float()}
        shown = network.upper().replace("VGG", "VGG-")
        for index, name in enumerate(names):
            for part in ("weight", "bias"):
                key = f"features.{CONVOLUTIONS[network][name]}.{part}"
                if key not in tensors:
                    held = [f"relu{each}" for each in names[:index]]
                    raise WeightsError(
                        f"{source}: holds no conv{name} ({key} is missing); its layers are "
                        f"{', '.join(held) or f'none of {shown}'}; choose one of these, or name a file that reaches further "
                        "with --content.encoder.weights FILE"
                    )
                value = tensors[key].float()
                odd = value.ndim != 4 or value.shape[2:] != (3, 3) or not math.isfinite(float(value.sum()))
                if part == "weight" and odd:
                    found = f"{key} has shape {tuple(value.shape)}"
                    raise WeightsError(f"{source}: {found}, not that of a 3x3 convolution of {shown}")
                used[f"{part}{index}"] = value
        # What divides the features is part of the identity, as the tensors are.
        channels = len(used[f"bias{len(names) - 1}"])
        used["scale"] = torch.ones(channels) if scale is None else scale.float()
        kind = "plain" if scale is None else "normalised"
        super().__init__(f"{network}:{layer}:{kind}:{tensors_hash(used)}", channels)
        self._names, self._layer, self._normalised = names, layer, scale is not None
        for key, value in used.items():
            self.register_buffer(key, value)
        freeze(self)

    @torch.no_grad()
    def forward(self, image: Annotated[Tensor, "B 3 H W"]) -> Annotated[Tensor, "B C h w"]:
        """Features at stride 1, 2, 4, 8 or 16, by the block of the layer."""
        x = (image - self._column("mean", image)) / self._column("std", image)
        # A pool before each block but the first, and the last ReLU only if the layer is one.
        for index, name in enumerate(self._names):
            if index and name.endswith("_1"):
                x = F.max_pool2d(x, 2, ceil_mode=True)
            x = reflect_pad(x) if self._normalised else F.pad(x, (1, 1, 1, 1))
            x = F.conv2d(x, self.get_buffer(f"weight{index}").to(x), self.get_buffer(f"bias{index}").to(x))
            if index < len(self._names) - 1 or self._layer.startswith("relu"):
                x = F.relu(x)
        return x / self._column("scale", x)

    def _column(self, name: str, like: Tensor) -> Tensor:
        return self.get_buffer(name).to(like).view(1, -1, 1, 1)


def vgg_activations(encoder: VggEncoder, images: Annotated[Tensor, "B 3 H W"]) -> Annotated[Tensor, "C"]:
    """Mean of each filter's ReLU output over images, in float64: what `scale` is made of."""
    return F.relu(encoder(images)).double().mean(dim=(0, 2, 3))


FLAG = "--content.encoder.weights"
ORIGIN = "https://download.pytorch.org/models/"
SOURCES = {
    "vgg16": WeightSource("VGG-16", "vgg16-397923af.pth", f"{ORIGIN}vgg16-397923af.pth", FLAG),
    "vgg19": WeightSource("VGG-19", "vgg19-dcbb9e9d.pth", f"{ORIGIN}vgg19-dcbb9e9d.pth", FLAG),
}
"""torchvision's files: their names carry the beginning of their own SHA-256."""
CAFFE_FILES = r"vgg16-00b39a1b\.pth|vgg19-d01eb7cb\.pth"
"""The original networks under torchvision's names: BGR from 0 to 255 less the mean, which these files do not say."""
RAREST = 0.05
"""Mean activation of the rarest filters, as a share of the mean over all: on photographs none of VGG-19 is below that."""
BUNDLED = Path(__file__).parent / "weights" / "vgg19-relu2_1.safetensors"
"""VGG-19's conv1_1, conv1_2 and conv2_1 (CC BY 4.0, Simonyan and Zisserman), which decoders ship for."""
BUNDLED_LAYERS = ("1_1", "1_2", "2_1")
CAFFE_MEAN = (123.68 / 255, 116.779 / 255, 103.939 / 255)


def shipped(network: str, layer: str) -> Path | None:
    """The file of the package that holds the layer; None where none does."""
    return BUNDLED if network == "vgg19" and layer[4:] in BUNDLED_LAYERS else None


def build_vgg(network: str, layer: str, *, weights: Path | None, normalise: bool) -> VggEncoder:
    """The encoder from a file, the package, the cache or the download. Raises WeightsError where none of them serves."""
    path = find_weights(SOURCES[network], weights or shipped(network, layer))
    tensors, metadata = read_tensors(path, SOURCES[network])
    # Whose file it is says what its network wants of the input: AdaIN's RGB as it is, Caffe's BGR less its mean.
    divided = tensors.get("0.weight", torch.empty(0)).shape == (3, 3, 1, 1)
    if divided:
        tensors, mean, std = _from_adain(tensors), torch.zeros(3), torch.ones(3)
    elif re.search(CAFFE_FILES, path.name) and "features.0.weight" in tensors:
        tensors = {**tensors, "features.0.weight": tensors["features.0.weight"].flip(1)}
        mean, std = torch.tensor(CAFFE_MEAN), torch.full((3,), 1 / 255)
    else:
        mean, std = input_statistics(metadata, path)
    encoder = partial(VggEncoder, network, layer, tensors, mean=mean, std=std, source=str(path))
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
    # Few files bring their own means. On the town each filter's is within a factor of two of that on photographs (VGG-19,
    # standard deviation of the log 0.19 at relu2_1, 0.35 at relu3_1), but for filters that find nothing there to answer to.
    scale = vgg_activations(encoder(scale=torch.ones(1)), street()).float()
    return encoder(scale=scale.clamp_min(RAREST * float(scale.mean())))


def _from_adain(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """VGG-19 from AdaIN's list of layers: padding, convolution and ReLU take three places, a pool one after each block.

    The 1x1 convolution at its start turns colours; it goes into the first 3x3 one, which mirrored borders leave exact.
    """
    # Their places to torchvision's.
    renamed = {}
    for at, (name, place) in enumerate(CONVOLUTIONS["vgg19"].items()):
        theirs = 2 + 3 * at + int(name[0]) - 1
        for part in ("weight", "bias"):
            if f"{theirs}.{part}" in tensors:
                renamed[f"features.{place}.{part}"] = tensors[f"{theirs}.{part}"]
    # w3 * (w1 x + b1) + b3 is one convolution: (w3 w1) * x + (sum w3 b1 + b3).
    if {"features.0.weight", "features.0.bias"} <= renamed.keys() and "0.bias" in tensors:
        first = renamed["features.0.weight"].double()
        turn, shift = tensors["0.weight"][:, :, 0, 0].double(), tensors["0.bias"].double()
        renamed["features.0.weight"] = torch.einsum("okyx,ki->oiyx", first, turn).float()
        renamed["features.0.bias"] = (renamed["features.0.bias"] + torch.einsum("okyx,k->o", first, shift)).float()
    return renamed
