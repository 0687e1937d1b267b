"""Trains D_VGG: the colour of a photograph's pixel from its guided-filtered features, as scenes have them.

Identity is what scenes are reconstructed by; the paper's content and style losses on restyled crops are added where they
have a weight (`restyling`).
"""

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..datamanagers.config import GuidedConfig
from ..interfaces import Decoder, Encoder
from ..ops.precision import double
from ..plugins.decoders.decoders import DECODER_KIND, MlpDecoder, load_decoder
from ..plugins.weights import write_weights
from ..style.statistics import deviation
from ..training.prepare import device_of
from .config import PretrainDecoderConfig
from .loop import generator_of, sheet, train
from .photos import filtered_at, filtered_whole, find_photos, load_photo, random_pixels, split
from .restyling import Crops, StyleNetwork, adain, load_style_network, prepare_crops, restyling_losses

__all__ = ["decoder_report", "pretrain_decoder", "restyling_report"]

REPORT_PHOTOS = 20
LONGEST = 384
SAMPLE_PHOTOS, SAMPLE_LONGEST = 3, 192
Report = dict[str, float | int | str]
Decode = Callable[[Annotated[Tensor, "N C"]], Annotated[Tensor, "N 3"]]


def pretrain_decoder(config: PretrainDecoderConfig, output: Path, say: Callable[[str], None]) -> Report:
    """Train, write `output`, and measure it on held-out photographs."""
    device = device_of(config.device)
    encoder = config.encoder.build().to(device)
    network = _style_network(config)
    photos, held = split(find_photos(config.images)[: config.photos])
    say(f"{len(photos)} photographs to learn from, {len(held)} held out")
    features, colours = _samples(encoder, photos, config)
    mean = features.mean(0).to(device)
    std = features.std(0, correction=0).clamp_min(1e-3 * float(features.std())).to(device)  # dead channels are not blown up
    say(f"{len(features)} pixels prepared")
    crops = _crops(encoder, network, photos[: config.crops], config, measure=True)

    torch.manual_seed(config.seed)
    decoder = MlpDecoder(encoder.channels, config.hidden).to(device)

    def decode(content: Annotated[Tensor, "N C"]) -> Annotated[Tensor, "N 3"]:
        colour: Tensor = decoder((content - mean) / std)
        return colour

    def loss(generator: torch.Generator) -> Tensor:
        index = torch.randint(0, len(features), (config.batch,), generator=generator)
        content = (features[index].to(device) - mean) / std
        noise = torch.randn(content.shape, generator=generator).to(device)
        identity = F.mse_loss(decoder(content + config.noise * noise), colours[index].to(device))
        if network is None or crops is None or config.content == config.style == 0:
            return identity
        if int(torch.randint(0, config.every, (), generator=generator)) != 0:
            return identity
        pairs = (each.to(device) for each in _pairs(len(crops.mean), config.pairs, generator))
        structure, style = restyling_losses(crops, network, decode, *pairs)
        return identity + config.every * (config.content * structure + config.style * style)

    steps = train(decoder, loss, config, output, say, _picture(encoder, held, decode, device))
    _fold(decoder.first, mean, std)
    metadata = {
        "kind": DECODER_KIND,
        "encoder": encoder.identity,
        "objective": "identity" if config.content == config.style == 0 else "paper",
        "made_by": f"fprf pretrain decoder, {steps} steps on {len(photos)} photographs, seed {config.seed}",
        "licence": "Apache-2.0; trained by this project",
    }
    write_weights(output, decoder.state_dict(), metadata)
    trained = load_decoder(output, encoder=encoder.identity, channels=encoder.channels).to(device)
    report: Report = {"encoder": encoder.identity, "steps": steps, "learned_photos": len(photos)}
    report |= decoder_report(encoder, trained, held[:REPORT_PHOTOS], device)
    others = _crops(encoder, network, held[:REPORT_PHOTOS], config, measure=False)
    return report | (restyling_report(others, network, trained) if others is not None and network is not None else {})


@torch.no_grad()
def decoder_report(encoder: Encoder, decoder: Decoder, photos: Sequence[Path], device: torch.device | None = None) -> Report:
    """PSNR of decode(encode(photo)) over whole photographs: the mean of the photographs' own, and the worst."""
    psnr = []
    for path in photos:
        photo = load_photo(path, LONGEST).to(device)
        content = filtered_whole(encoder, photo, GuidedConfig())
        error = float(double(decoder(content) - photo.flatten(0, 1)).square().mean())
        psnr.append(-10 * math.log10(max(error, 1e-10)))
    return {
        "photos": len(psnr),
        "psnr_db": round(sum(psnr) / len(psnr), 2),
        "psnr_worst_db": round(min(psnr), 2),
    }


@torch.no_grad()
def restyling_report(crops: Crops, network: StyleNetwork, decode: Decode) -> Report:
    """Content and style loss of every crop in the style of the next one, in the units of `network`."""
    count = len(crops.mean)
    index = torch.arange(count, device=crops.mean.device)
    losses = [restyling_losses(crops, network, decode, i[None], (i[None] + 1) % count) for i in index]
    content, style = (sum(float(each) for each in column) / count for column in zip(*losses, strict=True))
    return {"content_loss": round(content, 4), "style_loss": round(style, 4)}


def _style_network(config: PretrainDecoderConfig) -> StyleNetwork | None:
    """None where neither loss counts and nobody named the weights to measure them with."""
    if config.style_weights is None and config.content == config.style == 0:
        return None
    return load_style_network(config.style_weights).to(device_of(config.device))


def _crops(
    encoder: Encoder, network: StyleNetwork | None, photos: Sequence[Path], config: PretrainDecoderConfig, *, measure: bool
) -> Crops | None:
    if network is None:
        return None
    seed = config.seed + (2 if measure else 3)
    return prepare_crops(
        encoder, network, photos, side=config.size, longest=LONGEST, seed=seed, measure=measure, device=device_of(config.device)
    )


def _pairs(count: int, size: int, generator: torch.Generator) -> tuple[Annotated[Tensor, "B"], Annotated[Tensor, "B"]]:
    """Content and style of each pair: two different crops, where there are two."""
    content = torch.randint(0, count, (size,), generator=generator)
    further = torch.randint(1, max(2, count), (size,), generator=generator)
    return content, (content + further) % count


def _picture(
    encoder: Encoder, held: Sequence[Path], decode: Decode, device: torch.device
) -> Callable[[], Annotated[Tensor, "H W 3"]]:
    """Rows of photo | decoded | decoded in the style of the next photo."""
    photos = [load_photo(path, SAMPLE_LONGEST).to(device) for path in held[:SAMPLE_PHOTOS]]
    features = [filtered_whole(encoder, photo, GuidedConfig())[None] for photo in photos]
    styles = []
    for each in features:
        mean = each.mean(1)
        styles.append((mean, deviation(mean, each.var(1, correction=0))))

    def picture() -> Annotated[Tensor, "H W 3"]:
        rows = []
        for i, photo in enumerate(photos):
            styled = adain(features[i], styles[i], styles[(i + 1) % len(photos)])
            rows.append([photo, decode(features[i][0]).view_as(photo), decode(styled[0]).view_as(photo)])
        return sheet(rows)

    return picture


def _samples(
    encoder: Encoder, photos: Sequence[Path], config: PretrainDecoderConfig
) -> tuple[Annotated[Tensor, "N C"], Annotated[Tensor, "N 3"]]:
    """On the CPU: they may be more than an accelerator holds."""
    device, features, colours = device_of(config.device), [], []
    for index, path in enumerate(photos):
        photo = load_photo(path, LONGEST).to(device)
        pixels = random_pixels(photo, config.pixels, generator_of(config.seed + 1, index))
        content, rgb = filtered_at(encoder, photo, pixels, GuidedConfig())
        features.append(content.cpu())
        colours.append(rgb.cpu())
    return torch.cat(features), torch.cat(colours)


@torch.no_grad()
def _fold(layer: nn.Linear, mean: Annotated[Tensor, "C"], std: Annotated[Tensor, "C"]) -> None:
    """W (f - mean) / std + b as one linear layer of f, in float64."""
    weight = double(layer.weight) / double(std)
    layer.bias.copy_(double(layer.bias) - weight @ double(mean))
    layer.weight.copy_(weight)
