"""Trains D_VGG for identity: the colour of a photograph's pixel from its guided-filtered features, as scenes have them."""

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..datamanagers.config import GuidedConfig
from ..interfaces import Decoder, Encoder
from ..plugins.decoders.mlp import DECODER_KIND, MlpDecoder, load_decoder
from ..plugins.weightfiles import write_weights
from .config import PretrainDecoderConfig
from .filtered import filtered_at, filtered_whole, random_pixels
from .loop import generator_of, train
from .photos import find_photos, load_photo, split

__all__ = ["decoder_report", "pretrain_decoder"]

REPORT_PHOTOS = 20
LONGEST = 384
Report = dict[str, float | int | str]


def pretrain_decoder(config: PretrainDecoderConfig, output: Path, say: Callable[[str], None]) -> Report:
    """Train, write `output`, and measure it on held-out photographs."""
    encoder = config.encoder.build()
    photos, held = split(find_photos(config.images)[: config.photos])
    say(f"{len(photos)} photographs to learn from, {len(held)} held out")
    features, colours = _samples(encoder, photos, config)
    mean = features.mean(0)
    std = features.std(0, correction=0).clamp_min(1e-3 * float(features.std()))  # dead channels are not blown up
    say(f"{len(features)} pixels prepared")

    torch.manual_seed(config.seed)
    decoder = MlpDecoder(encoder.channels, config.hidden)

    def loss(generator: torch.Generator) -> Tensor:
        index = torch.randint(0, len(features), (config.batch,), generator=generator)
        content = (features[index] - mean) / std
        noise = torch.randn(content.shape, generator=generator)
        return F.mse_loss(decoder(content + config.noise * noise), colours[index])

    steps = train(decoder, loss, config, output, say)
    _fold(decoder.first, mean, std)
    metadata = {
        "kind": DECODER_KIND,
        "encoder": encoder.identity,
        "made_by": f"fprf pretrain decoder, {steps} steps on {len(photos)} photographs, seed {config.seed}",
        "licence": "Apache-2.0; trained by this project",
    }
    write_weights(output, decoder.state_dict(), metadata)
    trained = load_decoder(output, encoder=encoder.identity, channels=encoder.channels)
    return {"encoder": encoder.identity, "steps": steps, **decoder_report(encoder, trained, held[:REPORT_PHOTOS])}


@torch.no_grad()
def decoder_report(encoder: Encoder, decoder: Decoder, photos: Sequence[Path]) -> Report:
    """PSNR of decode(encode(photo)) over whole photographs: the mean of the photographs' own, and the worst."""
    found = []
    for path in photos:
        photo = load_photo(path, LONGEST)
        content = filtered_whole(encoder, photo, GuidedConfig())
        error = float((decoder(content) - photo.flatten(0, 1)).double().square().mean())
        found.append(-10 * math.log10(max(error, 1e-10)))
    return {
        "photos": len(found),
        "psnr_db": round(sum(found) / len(found), 2),
        "psnr_worst_db": round(min(found), 2),
    }


def _samples(
    encoder: Encoder, photos: Sequence[Path], config: PretrainDecoderConfig
) -> tuple[Annotated[Tensor, "N C"], Annotated[Tensor, "N 3"]]:
    features, colours = [], []
    for index, path in enumerate(photos):
        photo = load_photo(path, LONGEST)
        pixels = random_pixels(photo, config.pixels, generator_of(config.seed + 1, index))
        content, rgb = filtered_at(encoder, photo, pixels, GuidedConfig())
        features.append(content)
        colours.append(rgb)
    return torch.cat(features), torch.cat(colours)


@torch.no_grad()
def _fold(layer: nn.Linear, mean: Annotated[Tensor, "C"], std: Annotated[Tensor, "C"]) -> None:
    """W (f - mean) / std + b as one linear layer of f, in float64."""
    weight = layer.weight.double() / std.double()
    layer.bias.copy_(layer.bias.double() - weight @ mean.double())
    layer.weight.copy_(weight)
