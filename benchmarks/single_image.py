"""Restyling of single pictures: a photograph as a scene of one point a pixel, and colour transfer between
pictures.

What tells pixels apart is given from outside, as features (`encoded`). `reinhard` and `histogram_matching`
are the baselines of restyling; colours [N 3] are sRGB in [0, 1], `style` is any set of pixels.
"""

from typing import Annotated, NamedTuple

import torch
from kornia.color import lab_to_rgb, rgb_to_lab
from torch import Tensor
from torch.nn.functional import interpolate, normalize

from fprf.datamanagers.basis import Basis
from fprf.errors import DataError
from fprf.interfaces import Decoder, Encoder
from fprf.ops.config import GuidedConfig
from fprf.ops.guided import upsample
from fprf.plugins.stylizers.config import StylizerConfig
from fprf.style.config import StyleConfig
from fprf.style.dictionary import StyleDictionary
from fprf.style.light import light_of
from fprf.style.look import Restyle, colour_maps, decoded_colours, region_maps
from fprf.style.placed_light import placed_light
from fprf.style.placing import (
    VIEW_SAMPLES,
    Keypoints,
    Landmarks,
    ViewSamples,
    blurred,
    close_keypoints,
    close_size,
    view_keypoints,
)
from fprf.style.scene_style import SceneStyle, scene_style
from fprf.types import Want

_CELL = 8
"""Pixels between guided-filter coefficients."""
_CHUNK = 65_536
"""Pixels that are restyled at a time."""
_SAMPLES = 2**16
"""Pixels whose statistics are taken, at most, in even steps."""


class Flat(NamedTuple):
    """A photograph, ready to be restyled. `semantic` is None where nothing tells its parts apart."""

    content: Annotated[Tensor, "N C"]
    semantic: Annotated[Tensor, "N D"] | None
    size: tuple[int, int]
    """Height, width; N is their product."""
    style: SceneStyle


@torch.no_grad()
def encoded(
    image: Annotated[Tensor, "H W 3"], encoder: Encoder, guided: GuidedConfig, basis: Basis | None = None
) -> Annotated[Tensor, "N C"]:
    """Features at every pixel through the guided filter, as a scene's targets are; projected on the basis
    first.
    """
    maps: Tensor = encoder(image.permute(2, 0, 1)[None])[0].float()
    if basis is not None:
        maps = basis.project(maps.flatten(1).T).T.reshape(-1, *maps.shape[1:])
    radius = round(guided.radius * min(image.shape[:2]))
    return upsample(maps, image, radius=radius, eps=guided.eps, stride=min(guided.stride, _CELL)).flatten(
        0, 1
    )


def flat_scene(
    content: Annotated[Tensor, "N C"],
    semantic: Annotated[Tensor, "N D"] | None,
    size: tuple[int, int],
    *,
    regions: int = 16,
    seed: int = 0,
) -> Flat:
    """The photograph of these features, with its statistics; all pixels weigh alike."""
    some = slice(0, None, max(1, -(-len(content) // _SAMPLES)))
    parts = None if semantic is None else semantic[some]
    style = scene_style(content[some], parts, content.new_ones(len(content[some])), None, regions, seed)
    return Flat(content, semantic, size, style)


class _Colours(Decoder):
    """Colours that are their own content, as those of Gaussians are."""

    def forward(self, content: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N 3"]:
        return content.clamp(0, 1)


def flat_look(
    flat: Flat,
    dictionary: StyleDictionary,
    config: StylizerConfig,
    decoder: Decoder | None,
    bold: float = StyleConfig.bold,
) -> Restyle:
    """Restyle the photograph as `fprf stylize` would. Without a decoder its content is its colours, as in
    `splats.restyle`.
    """
    device = flat.content.device
    stylizer = config.build(dictionary=dictionary, scene=flat.style).to(device)
    light = None
    placed = None
    everywhere = torch.ones(len(flat.style.share), len(dictionary.names)).bool()
    if config.light:
        own = decoded_colours(stylizer, flat.style, decoder, features=0.0)
        placed = placed_light(flat.style, dictionary, everywhere, own)
        light = light_of(flat.style, dictionary, config, own, bold=bold)
        light = None if light is None else light.to(device)
    if decoder is None:
        maps = region_maps(stylizer, dictionary, flat.style, config, everywhere)
        features = config.features if maps is None else 0.0
        return Restyle(stylizer, features=features, colours=maps, light=light, placed=placed)
    smoothing = config.smoothing(flat.style)
    colours = colour_maps(
        stylizer,
        dictionary,
        flat.style,
        decoder,
        features=config.features,
        share=config.colours,
        smoothing=smoothing,
    )
    return Restyle(
        stylizer,
        features=config.features,
        colours=None if colours is None else colours.to(device),
        light=light,
        placed=None if placed is None else placed.to(device),
    )


def _pixels(at: Annotated[Tensor, "M"], size: tuple[int, int]) -> Annotated[Tensor, "M 2"]:
    """Centres of pixels by number."""
    return torch.stack([at % size[1], at // size[1]], 1) + 0.5


def _points(pixel: Annotated[Tensor, "M 2"], size: tuple[int, int]) -> Annotated[Tensor, "M 3"]:
    """Points that an eye at the origin sees at pixels of a picture (height, width): its longer side is seen under 53
    degrees.
    """
    away = (pixel - pixel.new_tensor([size[1] / 2, size[0] / 2])) / max(size)
    return torch.cat([away, torch.ones_like(away[:, :1])], 1)


def flat_landmarks(image: Annotated[Tensor, "H W 3"], semantic: Annotated[Tensor, "N D"]) -> Landmarks:
    """The picture as the only view by which photographs of the very place are told."""
    height, width = image.shape[:2]
    at = torch.arange(0, height * width, max(1, height * width // VIEW_SAMPLES))
    pixel = _pixels(at, (height, width))

    def rays(pixel: Annotated[Tensor, "M 2"]) -> Annotated[Tensor, "M 3"]:
        return normalize(_points(pixel, (height, width)), dim=1)

    samples = ViewSamples(pixel, blurred(image).flatten(0, 1)[at], semantic[at], torch.zeros(3), rays)

    def closer(view: int) -> Keypoints:
        pixels = image.permute(2, 0, 1)[None]
        larger = interpolate(pixels, close_size((width, height))[::-1], mode="bicubic")[0].permute(1, 2, 0)
        return close_keypoints(larger.clamp(0, 1), (width, height))

    return Landmarks((view_keypoints(image),), lambda view: samples, closer)


@torch.no_grad()
def render_flat(flat: Flat, look: Restyle, decoder: Decoder | None) -> Annotated[Tensor, "H W 3"]:
    """The photograph in a new style, in [0, 1]."""
    parts = []
    decoder = decoder or _Colours()
    pixels = _pixels(torch.arange(len(flat.content)), flat.size)
    for start in range(0, len(flat.content), _CHUNK):
        rows = slice(start, start + _CHUNK)
        semantic = flat.semantic[rows] if flat.semantic is not None and Want.SEMANTIC in look.needs else None
        points = _points(pixels[rows], flat.size)
        parts.append(look.colour(decoder, flat.content[rows], semantic, points=points))
    return torch.cat(parts).reshape(*flat.size, 3)


_STILL = 1e-3
"""Units of Lab (whose lightness goes to 100): a channel that deviates less has no contrast to scale."""


def reinhard(content: Annotated[Tensor, "N 3"], style: Annotated[Tensor, "M 3"]) -> Annotated[Tensor, "N 3"]:
    """Mean and deviation of every channel of CIE Lab from the style (Reinhard et al. 2001); clipped to the
    gamut.

    Raises DataError where a side has no pixel.
    """
    _filled(content, style)
    here = _lab(content)
    there = _lab(style)
    deviation = here.std(0, correction=0)
    gain = torch.where(deviation > _STILL, there.std(0, correction=0) / deviation.clamp_min(_STILL), 1.0)
    moved = (here - here.mean(0)) * gain + there.mean(0)
    # A colour beyond the gamut is clipped; so are the intermediate values of Lab's cubes, which must not be
    # negative.
    return lab_to_rgb(moved.T.reshape(1, 3, -1, 1), clip=True)[0, :, :, 0].T.clamp(0, 1)


def histogram_matching(
    content: Annotated[Tensor, "N 3"], style: Annotated[Tensor, "M 3"]
) -> Annotated[Tensor, "N 3"]:
    """Each channel of sRGB gets the style's distribution: a colour goes to the one of the same rank.

    Equal values stay equal (they take the middle of their ranks). Raises DataError where a side has no pixel.
    """
    _filled(content, style)
    columns = []
    for here, there in zip(content.double().T, style.double().T, strict=True):
        _, which, count = torch.unique(here, return_inverse=True, return_counts=True)
        rank = (count.cumsum(0) - 0.5 * count).double() / len(here)
        at = rank * len(there) - 0.5
        low = at.floor().clamp(0, len(there) - 1)
        ordered = there.sort().values
        high = ordered[(low + 1).clamp_max(len(there) - 1).long()]
        columns.append(torch.lerp(ordered[low.long()], high, (at - low).clamp(0, 1))[which])
    return torch.stack(columns, 1).to(content)


def _filled(content: Tensor, style: Tensor) -> None:
    if len(content) == 0 or len(style) == 0:
        raise DataError(
            f"colour transfer: {len(content)} pixels and {len(style)} of the style; both need at least one"
        )


def _lab(colours: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N 3"]:
    lab: Tensor = rgb_to_lab(colours.T.reshape(1, 3, -1, 1))[0, :, :, 0].T
    return lab
