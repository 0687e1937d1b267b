"""VGG's weights as the various files hold them: torchvision's, Caffe's and Keras's, and the normalised ones of AdaIN.

VGG-19 up to relu2_1, the paper's content encoder, ships with the package.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ...errors import WeightsError
from .calibration import street
from .vgg import CONVOLUTIONS, VggEncoder, vgg_activations
from .weight_sources import IMAGENET_MEAN, IMAGENET_STD, find_weights, read_tensors, stated_triple, torchvision_file

__all__ = ["build_vgg16", "build_vgg19"]

FLAG = "--content.encoder.weights"
SOURCES = {
    "vgg16": torchvision_file("VGG-16", "vgg16-397923af.pth", FLAG),
    "vgg19": torchvision_file("VGG-19", "vgg19-dcbb9e9d.pth", FLAG),
}
CAFFE_FILES = r"vgg16-00b39a1b\.pth|vgg19-d01eb7cb\.pth"
"""The original networks under torchvision's names: BGR from 0 to 255 less the mean, which these files do not say."""
RAREST = 0.05
"""Mean activation of the rarest filters, as a share of the mean over all: on photographs none of VGG-19 is below that."""
BUNDLED = Path(__file__).parent / "weights" / "vgg19-relu2_1.safetensors"
"""VGG-19's conv1_1, conv1_2 and conv2_1 (CC BY 4.0, Simonyan and Zisserman), which decoders ship for."""
BUNDLED_LAYERS = ("1_1", "1_2", "2_1")
CAFFE_MEAN = (123.68 / 255, 116.779 / 255, 103.939 / 255)


class _Held(NamedTuple):
    """A file's tensors for RGB input under torchvision's names, and what they want of the input."""

    tensors: Mapping[str, Tensor]
    mean: Annotated[Tensor, "3"]
    std: Annotated[Tensor, "3"]
    normalised: bool
    """Each filter is divided by its mean activation already."""


def build_vgg16(layer: str, *, weights: Path | None, normalise: bool) -> VggEncoder:
    """The encoder from a file, the cache or the download. Raises WeightsError where none of them serves."""
    return _build("vgg16", layer, weights=weights, normalise=normalise)


def build_vgg19(layer: str, *, weights: Path | None, normalise: bool) -> VggEncoder:
    """The encoder from a file, the package, the cache or the download. Raises WeightsError where none of them serves."""
    if weights is None and layer[4:] in BUNDLED_LAYERS:
        weights = BUNDLED
    return _build("vgg19", layer, weights=weights, normalise=normalise)


def _build(network: str, layer: str, *, weights: Path | None, normalise: bool) -> VggEncoder:
    path = find_weights(SOURCES[network], weights)
    held = _read(network, path)

    def encoder(scale: Tensor | None) -> VggEncoder:
        return VggEncoder(network, layer, held.tensors, mean=held.mean, std=held.std, scale=scale, source=str(path))

    if not normalise:
        if held.normalised:
            raise WeightsError(
                f"{path}: holds the normalised VGG-19 of AdaIN, which cannot be made plain again; "
                f"leave normalise on, or name a file of plain weights with {FLAG} FILE"
            )
        return encoder(None)
    if held.normalised:
        return encoder(torch.ones(1))
    scale = held.tensors.get(f"mean_activation.conv{layer[4:]}")
    if scale is not None:
        return encoder(scale.clamp_min(1e-3 * float(scale.mean())))
    # Few files bring their own means. On the town each filter's is within a factor of two of that on photographs (VGG-19,
    # standard deviation of the log 0.19 at relu2_1, 0.35 at relu3_1), but for filters that find nothing there to answer to.
    scale = vgg_activations(encoder(torch.ones(1)), street()).float()
    return encoder(scale.clamp_min(RAREST * float(scale.mean())))


def _read(network: str, path: Path) -> _Held:
    tensors, metadata = read_tensors(path, SOURCES[network])
    if tensors.get("0.weight", torch.empty(0)).shape == (3, 3, 1, 1):
        return _Held(_from_adain(tensors), torch.zeros(3), torch.ones(3), normalised=True)
    if re.search(CAFFE_FILES, path.name) and "features.0.weight" in tensors:
        turned = {**tensors, "features.0.weight": tensors["features.0.weight"].flip(1)}
        return _Held(turned, torch.tensor(CAFFE_MEAN), torch.full((3,), 1 / 255), normalised=False)
    mean, std = (
        stated_triple(metadata, key, default, path) for key, default in (("mean", IMAGENET_MEAN), ("std", IMAGENET_STD))
    )
    return _Held(tensors, mean, std, normalised=False)


def _from_adain(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """VGG-19 from AdaIN's list of layers: padding, convolution and ReLU take three places, a pool one after each block.

    The 1x1 convolution at its start turns colours; it goes into the first 3x3 one, which mirrored borders leave exact.
    """
    found = {}
    for at, (name, place) in enumerate(CONVOLUTIONS["vgg19"].items()):
        theirs = 2 + 3 * at + int(name[0]) - 1
        for part in ("weight", "bias"):
            if f"{theirs}.{part}" in tensors:
                found[f"features.{place}.{part}"] = tensors[f"{theirs}.{part}"]
    if {"features.0.weight", "features.0.bias"} <= found.keys() and "0.bias" in tensors:
        first = found["features.0.weight"].double()
        turn, shift = tensors["0.weight"][:, :, 0, 0].double(), tensors["0.bias"].double()
        found["features.0.weight"] = torch.einsum("okyx,ki->oiyx", first, turn).float()
        found["features.0.bias"] = (found["features.0.bias"] + torch.einsum("okyx,k->o", first, shift)).float()
    return found
