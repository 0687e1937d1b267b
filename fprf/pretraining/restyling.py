"""The paper's training of D_VGG: AdaIN between crops of photographs, decoded pixel by pixel, against content and style.

AdaIN happens in the encoder's own space, on guided-filtered features as scenes have them. The content loss compares
structure: relu2_1 of the decoded crop with AdaIN of the content's and the style's relu2_1, which for the paper's encoder
is the feature that was decoded.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from ..datamanagers.config import GuidedConfig
from ..interfaces import Encoder
from ..style.statistics import deviation, double
from .filtered import filtered_crop
from .loop import generator_of
from .perceptual import CONTENT, StyleNetwork, style_distance, style_statistics
from .photos import load_photo

__all__ = ["Crops", "adain", "prepare_crops", "restyling_losses"]


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
    found = network(colour.permute(0, 3, 1, 2))
    wanted = [layer[style] for layer in crops.style]
    mean, std = (half[:, :, None, None] for half in wanted[CONTENT].chunk(2, 1))
    structure = F.mse_loss(found[CONTENT], crops.structure[content].float() * std + mean)
    return structure, style_distance(style_statistics(found), wanted)


def _whitened(activation: Annotated[Tensor, "1 K h w"]) -> Annotated[Tensor, "1 K h w"]:
    mean, std = (half[:, :, None, None] for half in style_statistics([activation])[0].chunk(2, 1))
    return (activation - mean) / std
