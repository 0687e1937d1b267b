"""Train D_VGG: the colour of a photograph's pixel from its guided-filtered features, as scenes have them.

Identity is what scenes are reconstructed by; the paper's content and style losses on restyled crops are added
where they have a weight. AdaIN happens in the encoder's own space, on guided-filtered features as scenes have
them. The content loss compares structure: relu2_1 of the decoded crop with AdaIN of the content's and the
style's relu2_1. The style loss is that of AdaIN (Huang and Belongie 2017): means and standard deviations at
relu1_1, relu2_1, relu3_1 and relu4_1, in units of each filter's own deviation. Weights that end before
relu4_1 take relu3_4, the last layer before it.
"""

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..errors import WeightsError
from ..interfaces import Decoder, Encoder
from ..ops.backend import double, float32_convolutions
from ..plugins.decoders.decoders import DECODER_KIND, MlpDecoder, load_decoder
from ..plugins.encoders.vgg import VggEncoder, build_vgg
from ..plugins.weights import write_weights
from ..style.statistics import deviation
from ..training.prepare import device_of
from .config import PretrainDecoderConfig
from .loop import generator_of, train
from .photos import filtered_at, filtered_crop, filtered_whole, find_photos, load_photo, random_pixels, split

Report = dict[str, float | int | str]
Decode = Callable[[Annotated[Tensor, "N C"]], Annotated[Tensor, "N 3"]]
CONTENT = 1
"""Index of the activations that the content loss compares: relu2_1, the paper's layer."""
EPS = 1e-4
"""Added to variances, which are in units of the filters' own: keeps the root's gradient finite where a filter
is constant.
"""


class StyleNetwork(nn.Module):
    """VGG-19 that gradients pass through, frozen. `unit` divides the activations of each layer: 1 until
    measured.
    """

    def __init__(self, encoder: VggEncoder) -> None:
        super().__init__()
        self.encoder = encoder
        tapped = {"1_1", "2_1", "3_1", encoder.names[-1]}
        self._places = [place for place, name in enumerate(encoder.names) if name in tapped]
        self.layers = [f"relu{encoder.names[place]}" for place in self._places]
        """Names of the activations that `forward` gives."""
        for place, layer in zip(self._places, self.layers, strict=True):
            self.register_buffer(f"unit_{layer}", torch.ones(len(encoder.get_buffer(f"bias{place}")), 1, 1))

    def forward(self, images: Annotated[Tensor, "B 3 H W"]) -> list[Annotated[Tensor, "B C h w"]]:
        """Activations of sRGB images in [0, 1], at every layer of `layers`."""
        with float32_convolutions(images.device):
            found = []
            for place, x in enumerate(self.encoder.activations(images)):
                if place in self._places:
                    found.append(x)
        result: list[Annotated[Tensor, "B C h w"]] = []
        for x, layer in zip(found, self.layers, strict=True):
            result.append(x / self.get_buffer(f"unit_{layer}"))
        return result

    @torch.no_grad()
    def measure(self, images: Sequence[Annotated[Tensor, "3 H W"]]) -> None:
        """Take each filter's mean deviation over the images as its unit; filters that hardly fire are not
        blown up.
        """
        deviations = []
        for image in images:
            deviations.append([double(x[0]).std((1, 2), correction=0) for x in self(image[None])])
        for layer, own_deviations in zip(self.layers, zip(*deviations, strict=True), strict=True):
            unit = self.get_buffer(f"unit_{layer}")
            own = torch.stack(own_deviations).mean(0).to(unit) * unit[:, 0, 0]
            unit.copy_(own.clamp_min(0.01 * float(own.mean()))[:, None, None])


def load_style_network(weights: Path | None) -> StyleNetwork:
    """The network from a file of VGG-19's weights (None = the download that `vgg19` uses). Raises
    WeightsError.
    """
    try:
        return StyleNetwork(build_vgg("relu4_1", weights=weights, normalise=True))
    except WeightsError:  # they may end before it
        return StyleNetwork(build_vgg("relu3_4", weights=weights, normalise=True))


def style_statistics(activations: Sequence[Annotated[Tensor, "B C h w"]]) -> list[Annotated[Tensor, "B 2C"]]:
    """Mean and standard deviation of every filter, layer by layer."""
    found: list[Annotated[Tensor, "B 2C"]] = []
    for x in activations:
        found.append(torch.cat([x.mean((2, 3)), (x.var((2, 3), correction=0) + EPS).sqrt()], 1))
    return found


def style_distance(
    styled: Sequence[Annotated[Tensor, "B 2C"]], wanted: Sequence[Annotated[Tensor, "B 2C"]]
) -> Annotated[Tensor, ""]:
    """The style loss: mean squared differences, in the filters' units, summed over the layers."""
    parts = []
    for a, b in zip(styled, wanted, strict=True):
        parts.append(F.mse_loss(a, b))
    return torch.stack(parts).sum()


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
    """One square of each photograph that is large enough on both sides (else as large as it gets). Draws by
    `seed`.

    `measure` sets the network's units from these crops. Encoder and network must be on `device`; None = the
    CPU.
    """
    # Crops of one size, small enough for every photograph.
    loaded = []
    for path in photos:
        loaded.append(load_photo(path, longest).to(device))
    side = min(side, *(min(photo.shape[:2]) for photo in loaded))
    made = []
    for i, photo in enumerate(loaded):
        made.append(filtered_crop(encoder, photo, side, generator_of(seed, i)))
    # Units first: activations below are divided by them.
    images = []
    for _, rgb in made:
        images.append(rgb.view(side, side, 3).permute(2, 0, 1))
    if measure:
        network.measure(images)
    # The content's structure is its normalised activations: they take the deviation of any style later
    # (AdaIN).
    seen = []
    for image in images:
        seen.append(network(image[None]))
    structure = []
    for each in seen:
        mean, std = (half[:, :, None, None] for half in style_statistics([each[CONTENT]])[0].chunk(2, 1))
        structure.append(((each[CONTENT] - mean) / std).half())
    statistics = []
    for each in seen:
        statistics.append(style_statistics(each))
    # Moments of features in float64; the features themselves are kept in half precision, since there are
    # many.
    wide = []
    for features, _ in made:
        wide.append(double(features))
    own = []
    for each in wide:
        own.append((each.mean(0), each.var(0, correction=0)))
    return Crops(
        side,
        torch.stack([features.half() for features, _ in made]),
        torch.stack([mean for mean, _ in own]).to(made[0][0]),
        torch.stack([deviation(mean, variance) for mean, variance in own]).to(made[0][0]),
        torch.cat(structure),
        tuple(torch.cat(layer) for layer in zip(*statistics, strict=True)),
    )


def restyling_losses(
    crops: Crops,
    network: StyleNetwork,
    decode: Decode,
    content: Annotated[Tensor, "B"],
    style: Annotated[Tensor, "B"],
) -> tuple[Annotated[Tensor, ""], Annotated[Tensor, ""]]:
    """Content loss and style loss (paper, L_c and L_s) of crops `content` in the styles of crops `style`."""
    # The paper's training pair: content features with the moments of the style, decoded to a picture (t, and
    # g(t)).
    features = adain(
        crops.features[content].float(),
        (crops.mean[content], crops.std[content]),
        (crops.mean[style], crops.std[style]),
    )
    colour = decode(features.flatten(0, 1)).view(len(content), crops.side, crops.side, 3)
    activations = network(colour.permute(0, 3, 1, 2))
    wanted = []
    for layer in crops.style:
        wanted.append(layer[style])
    # L_c compares with AdaIN in VGG's own space, L_s with the style's moments layer by layer.
    mean, std = (half[:, :, None, None] for half in wanted[CONTENT].chunk(2, 1))
    structure = F.mse_loss(activations[CONTENT], crops.structure[content].float() * std + mean)
    return structure, style_distance(style_statistics(activations), wanted)


REPORT_PHOTOS = 20
"""Held-out photographs that a decoder is measured on, at most: bounds the time."""
LONGEST_PIXELS = 384
"""Longest side at which photographs are encoded; by eye."""


def pretrain_decoder(config: PretrainDecoderConfig, output: Path, say: Callable[[str], None]) -> Report:
    """Train, write `output`, and measure it on held-out photographs."""
    device = device_of(config.device)
    encoder = config.encoder.build().to(device)
    measured = config.style_weights is not None or config.content > 0 or config.style > 0
    network = None
    if measured:
        network = load_style_network(config.style_weights).to(device)
    photos, held = split(find_photos(config.images)[: config.photos])
    say(f"{len(photos)} photographs to learn from, {len(held)} held out")
    # Pixels of all photographs, on the CPU: they may be more than an accelerator holds.
    parts = []
    for index, path in enumerate(photos):
        photo = load_photo(path, LONGEST_PIXELS).to(device)
        pixels = random_pixels(photo, config.pixels, generator_of(config.seed + 1, index))
        parts.append([each.cpu() for each in filtered_at(encoder, photo, pixels)])
    features, colours = (torch.cat(column) for column in zip(*parts, strict=True))
    mean = features.mean(0).to(device)
    std = (
        features.std(0, correction=0).clamp_min(1e-3 * float(features.std())).to(device)
    )  # dead channels are not blown up
    say(f"{len(features)} pixels prepared")
    crops = None
    if network is not None:
        chosen = photos[: config.crops]
        seed = config.seed + 2
        crops = prepare_crops(
            encoder,
            network,
            chosen,
            side=config.size,
            longest=LONGEST_PIXELS,
            seed=seed,
            measure=True,
            device=device,
        )
    torch.manual_seed(config.seed)
    decoder = MlpDecoder(encoder.channels, config.hidden).to(device)

    def decode(content: Annotated[Tensor, "N C"]) -> Annotated[Tensor, "N 3"]:
        colour: Tensor = decoder((content - mean) / std)
        return colour

    def loss(generator: torch.Generator) -> Tensor:
        # Identity: the colour of a pixel from its features; noise on these makes the decoder smooth.
        index = torch.randint(0, len(features), (config.batch,), generator=generator)
        content = (features[index].to(device) - mean) / std
        noise = torch.randn(content.shape, generator=generator).to(device)
        identity = F.mse_loss(decoder(content + config.noise * noise), colours[index].to(device))
        if crops is None or network is None or config.content == config.style == 0:
            return identity
        # lambda_c L_c + lambda_s L_s (paper), in one step of so many, where it weighs as many times more.
        if int(torch.randint(0, config.every, (), generator=generator)) != 0:
            return identity
        # Two different crops, where there are two.
        one = torch.randint(0, len(crops.mean), (config.pairs,), generator=generator)
        further = torch.randint(1, max(2, len(crops.mean)), (config.pairs,), generator=generator)
        pair = one.to(device), ((one + further) % len(crops.mean)).to(device)
        structure, style = restyling_losses(crops, network, decode, *pair)
        return identity + config.every * (config.content * structure + config.style * style)

    steps = train(decoder, loss, config, output, say)
    # W (f - mean) / std + b as one linear layer of f, in float64.
    with torch.no_grad():
        weight = double(decoder.first.weight) / double(std)
        decoder.first.bias.copy_(double(decoder.first.bias) - weight @ double(mean))
        decoder.first.weight.copy_(weight)
    metadata = {
        "kind": DECODER_KIND,
        "encoder": encoder.identity,
        "objective": "identity" if config.content == config.style == 0 else "paper",
        "made_by": f"fprf pretrain decoder, {steps} steps on {len(photos)} photographs, seed {config.seed}",
        "licence": "Apache-2.0; trained by this project",
    }
    write_weights(output, decoder.state_dict(), metadata)
    # What is measured is the file.
    trained = load_decoder(output, encoder=encoder.identity, channels=encoder.channels).to(device)
    report: Report = {"encoder": encoder.identity, "steps": steps, "learned_photos": len(photos)}
    report |= decoder_report(encoder, trained, held[:REPORT_PHOTOS], device)
    if network is not None:
        chosen = held[:REPORT_PHOTOS]
        seed = config.seed + 3
        others = prepare_crops(
            encoder,
            network,
            chosen,
            side=config.size,
            longest=LONGEST_PIXELS,
            seed=seed,
            measure=False,
            device=device,
        )
        report |= restyling_report(others, network, trained)
    return report


@torch.no_grad()
def decoder_report(
    encoder: Encoder, decoder: Decoder, photos: Sequence[Path], device: torch.device | None = None
) -> Report:
    """PSNR of decode(encode(photo)) over whole photographs: the mean of the photographs' own, and the
    worst.
    """
    psnr = []
    for path in photos:
        photo = load_photo(path, LONGEST_PIXELS).to(device)
        content = filtered_whole(encoder, photo)
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
    content = 0.0
    style = 0.0
    for i in index:
        losses = restyling_losses(crops, network, decode, i[None], (i[None] + 1) % count)
        content += float(losses[0])
        style += float(losses[1])
    return {"content_loss": round(content / count, 4), "style_loss": round(style / count, 4)}
