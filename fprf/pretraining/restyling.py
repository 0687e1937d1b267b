"""Content and style losses of the paper's D_VGG: AdaIN between crops of photographs, decoded and seen by VGG-19.

AdaIN happens in the encoder's own space, on guided-filtered features as scenes have them. The content loss compares
structure: relu2_1 of the decoded crop with AdaIN of the content's and the style's relu2_1. The style loss is that of AdaIN
(Huang and Belongie 2017): means and standard deviations at relu1_1, relu2_1, relu3_1 and relu4_1, in units of each filter's
own deviation. Weights that end before relu4_1 take relu3_4, the last layer before it.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..datamanagers.config import GuidedConfig
from ..errors import WeightsError
from ..interfaces import Encoder
from ..ops.precision import double
from ..plugins.encoders.config import Vgg19Config
from ..plugins.encoders.frozen import reflect_pad
from ..style.statistics import deviation
from .loop import generator_of
from .photos import filtered_crop, load_photo

__all__ = [
    "CONTENT",
    "Crops",
    "StyleNetwork",
    "adain",
    "load_style_network",
    "prepare_crops",
    "restyling_losses",
    "style_distance",
    "style_statistics",
]


NAMES = ("1_1", "1_2", "2_1", "2_2", "3_1", "3_2", "3_3", "3_4", "4_1")
LAST = ("relu4_1", "relu3_4")
"""The deepest layer of the style, the first of these that the weights reach."""
CONTENT = 1
"""Index of the activations that the content loss compares: relu2_1, the paper's layer."""
EPS = 1e-4
"""Added to variances, which are in units of the filters' own: keeps the root's gradient finite where a filter is constant."""


class StyleNetwork(nn.Module):
    """VGG-19 that gradients pass through, frozen. `unit` divides the activations of each layer: 1 until measured."""

    def __init__(self, tensors: Sequence[tuple[Tensor, Tensor]], mean: Annotated[Tensor, "3"], std: Annotated[Tensor, "3"]):
        super().__init__()
        self.register_buffer("mean", mean.view(-1, 1, 1))
        self.register_buffer("std", std.view(-1, 1, 1))
        self._names = NAMES[: len(tensors)]
        self._taps = {"1_1", "2_1", "3_1", self._names[-1]}
        for name, (weight, bias) in zip(self._names, tensors, strict=True):
            self.register_buffer(f"weight{name}", weight)
            self.register_buffer(f"bias{name}", bias)
            if name in self._taps:
                self.register_buffer(f"unit{name}", torch.ones(len(bias), 1, 1))

    @property
    def layers(self) -> list[str]:
        """Names of the activations that `forward` gives."""
        return [f"relu{name}" for name in self._names if name in self._taps]

    def forward(self, images: Annotated[Tensor, "B 3 H W"]) -> list[Annotated[Tensor, "B C h w"]]:
        """Activations of sRGB images in [0, 1], at every layer of `layers`."""
        activations = []
        x = (images - self.get_buffer("mean")) / self.get_buffer("std")
        for name in self._names:
            if name in ("2_1", "3_1", "4_1"):
                x = F.max_pool2d(x, 2, ceil_mode=True)
            x = F.relu(F.conv2d(reflect_pad(x), self.get_buffer(f"weight{name}"), self.get_buffer(f"bias{name}")))
            if name in self._taps:
                activations.append(x / self.get_buffer(f"unit{name}"))
        return activations

    @torch.no_grad()
    def measure(self, images: Sequence[Annotated[Tensor, "3 H W"]]) -> None:
        """Take each filter's mean deviation over the images as its unit; filters that hardly fire are not blown up."""
        deviations = [[double(x[0]).std((1, 2), correction=0) for x in self(image[None])] for image in images]
        for layer, own_deviations in zip(self.layers, zip(*deviations, strict=True), strict=True):
            unit = self.get_buffer(f"unit{layer.removeprefix('relu')}")
            own = torch.stack(own_deviations).mean(0).to(unit) * unit[:, 0, 0]
            unit.copy_(own.clamp_min(0.01 * float(own.mean()))[:, None, None])


def load_style_network(weights: Path | None) -> StyleNetwork:
    """The network from a file of VGG-19's weights (None = the download that `vgg19` uses). Raises WeightsError."""
    for layer in LAST:
        try:
            encoder = Vgg19Config(layer=layer, weights=weights, normalise=False).build()
        except WeightsError:
            if layer == LAST[-1]:
                raise
            continue
        break
    count = NAMES.index(layer.removeprefix("relu")) + 1
    tensors = [(encoder.get_buffer(f"weight{i}"), encoder.get_buffer(f"bias{i}")) for i in range(count)]
    return StyleNetwork(tensors, encoder.get_buffer("mean"), encoder.get_buffer("std"))


def style_statistics(activations: Sequence[Annotated[Tensor, "B C h w"]]) -> list[Annotated[Tensor, "B 2C"]]:
    """Mean and standard deviation of every filter, layer by layer."""
    return [torch.cat([x.mean((2, 3)), (x.var((2, 3), correction=0) + EPS).sqrt()], 1) for x in activations]


def style_distance(
    styled: Sequence[Annotated[Tensor, "B 2C"]], wanted: Sequence[Annotated[Tensor, "B 2C"]]
) -> Annotated[Tensor, ""]:
    """The style loss: mean squared differences, in the filters' units, summed over the layers."""
    return torch.stack([F.mse_loss(a, b) for a, b in zip(styled, wanted, strict=True)]).sum()


class Crops(NamedTuple):
    """P crops of photographs, each of `side` x `side` pixels."""

    side: int
    features: Annotated[Tensor, "P N C"]
    """Guided-filtered features of every pixel, in half precision."""
    mean: Annotated[Tensor, "P C"]
    std: Annotated[Tensor, "P C"]
    structure: Annotated[Tensor, "P K h w"]
    """relu2_1, every filter of mean 0 and deviation 1, in half precision."""
    style: tuple[Annotated[Tensor, "P 2K"], ...]
    """Means and deviations of VGG's layers."""


def adain(
    content: Annotated[Tensor, "B N C"],
    own: tuple[Annotated[Tensor, "B C"], Annotated[Tensor, "B C"]],
    style: tuple[Annotated[Tensor, "B C"], Annotated[Tensor, "B C"]],
) -> Annotated[Tensor, "B N C"]:
    """Features moved from their own (mean, deviation) to a style's."""
    gain = style[1] / own[1]
    return (content - own[0][:, None]) * gain[:, None] + style[0][:, None]


@torch.no_grad()
def prepare_crops(
    encoder: Encoder,
    network: StyleNetwork,
    photos: Sequence[Path],
    *,
    side: int,
    longest: int,
    seed: int,
    measure: bool,
    device: torch.device | None = None,
) -> Crops:
    """One square of each photograph that is large enough on both sides (else as large as it gets). Draws by `seed`.

    `measure` sets the network's units from these crops. Encoder and network must be on `device`; None = the CPU.
    """
    loaded = [load_photo(path, longest).to(device) for path in photos]
    side = min(side, *(min(photo.shape[:2]) for photo in loaded))
    made = [filtered_crop(encoder, photo, side, GuidedConfig(), generator_of(seed, i)) for i, photo in enumerate(loaded)]
    images = [rgb.view(side, side, 3).permute(2, 0, 1) for _, rgb in made]
    if measure:
        network.measure(images)
    seen = [network(image[None]) for image in images]
    statistics = [style_statistics(each) for each in seen]
    wide = [double(features) for features, _ in made]
    own = [(each.mean(0), each.var(0, correction=0)) for each in wide]
    return Crops(
        side,
        torch.stack([features.half() for features, _ in made]),
        torch.stack([mean for mean, _ in own]).to(made[0][0]),
        torch.stack([deviation(mean, variance) for mean, variance in own]).to(made[0][0]),
        torch.cat([_whitened(each[CONTENT]).half() for each in seen]),
        tuple(torch.cat(layer) for layer in zip(*statistics, strict=True)),
    )


def restyling_losses(
    crops: Crops,
    network: StyleNetwork,
    decode: Callable[[Annotated[Tensor, "N C"]], Annotated[Tensor, "N 3"]],
    content: Annotated[Tensor, "B"],
    style: Annotated[Tensor, "B"],
) -> tuple[Annotated[Tensor, ""], Annotated[Tensor, ""]]:
    """Content loss and style loss (paper, L_c and L_s) of crops `content` in the styles of crops `style`."""
    features = adain(
        crops.features[content].float(), (crops.mean[content], crops.std[content]), (crops.mean[style], crops.std[style])
    )
    colour = decode(features.flatten(0, 1)).view(len(content), crops.side, crops.side, 3)
    activations = network(colour.permute(0, 3, 1, 2))
    wanted = [layer[style] for layer in crops.style]
    mean, std = (half[:, :, None, None] for half in wanted[CONTENT].chunk(2, 1))
    structure = F.mse_loss(activations[CONTENT], crops.structure[content].float() * std + mean)
    return structure, style_distance(style_statistics(activations), wanted)


def _whitened(activation: Annotated[Tensor, "1 K h w"]) -> Annotated[Tensor, "1 K h w"]:
    mean, std = (half[:, :, None, None] for half in style_statistics([activation])[0].chunk(2, 1))
    return (activation - mean) / std
