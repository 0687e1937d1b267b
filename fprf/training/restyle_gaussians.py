"""A style on a scene of Gaussians: harmonics in, harmonics out.

    colour' = colour A + b,   0.5 + C0 dc' = (0.5 + C0 dc) A + b,   higher harmonics' = harmonics A

so an affine map of colours is exact, from every direction. Stylizers whose config says `colours` carry the colours of each
region over as a whole, and nothing else: content features and a decoder would add nothing, since single Gaussians have
colours that no photograph has. Others move the colours in the place of features. Luminance is kept as an affine map too.
"""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ..errors import ConfigError, UsageError
from ..fields.harmonics import harmonics as harmonic_functions
from ..interfaces import Encoder
from ..io.images import Picture, to_uint8
from ..rendering.cameras import Cameras
from ..splats.gaussians import HARMONIC
from ..splats.scene import SplatScene
from ..splats.views import camera_of, draw
from ..style.colours import ColourMaps, carried_colours
from ..style.config import NO_MASK, StyleConfig
from ..style.controls import luma
from ..style.dictionary import StyleDictionary, build_dictionary
from ..style.files import StyleFile, check_photographs, read_style
from ..style.look import Restyle
from ..style.matching import unit
from ..style.references import read_reference
from ..style.regional import RegionWeight, regional
from ..style.scene import SceneStyle, membership, own_style
from ..style.statistics import double
from ..style.wishes import labels
from .orders import take_orders
from .regions import Regions
from .restyle import Codes, Styled, mixed

__all__ = ["SplatViews", "as_drawn", "restyle_gaussians", "restyled_harmonics", "splat_regions"]

_DIRECTIONS = 48
"""In which harmonics are evaluated to find where renderers cut their colours."""
_ROWS = 1 << 15
"""Gaussians at a time: bounds the memory."""
_SHORTEST = 128
"""References are encoded at the size of the views, but not below this."""
_BACKDROP = 0.5


class Colours(Encoder):
    """Colours as content features."""

    @property
    def identity(self) -> str:
        """They have no weights."""
        return "colours"

    @property
    def channels(self) -> int:
        """Red, green and blue."""
        return 3

    def forward(self, image: Annotated[Tensor, "B 3 H W"]) -> Annotated[Tensor, "B 3 H W"]:
        """The image itself."""
        return image


class SplatViews(NamedTuple):
    """Views of a scene of Gaussians, in which its regions are shown and pointed at (`regions.RegionViews`)."""

    scene: SplatScene

    @property
    def names(self) -> tuple[str, ...]:
        """Of the views."""
        return self.scene.names

    @property
    def cameras(self) -> Cameras:
        """Of the views."""
        return self.scene.cameras

    @property
    def semantic_encoder(self) -> str:
        """Its identity."""
        return self.scene.encoder

    @property
    def device(self) -> torch.device:
        """The CPU."""
        return torch.device("cpu")

    def membership(
        self, scene: SceneStyle, cameras: Cameras, view: int, pixel: Annotated[Tensor, "N 2"]
    ) -> tuple[Annotated[Tensor, "N K"], Annotated[Tensor, "N"]]:
        """The Gaussians' own memberships, drawn."""
        belongs = RegionWeight(scene, torch.eye(len(scene.share)))(self.scene.semantic)
        camera = camera_of(cameras, view)
        drawn = draw(self.scene.gaussians, camera, antialiased=self.scene.antialiased, features=belongs)
        at = pixel.long()[:, 1] * camera.width + pixel.long()[:, 0]
        opacity = drawn.opacity.flatten()[at]
        return drawn.features.flatten(0, 1)[at] / opacity.clamp_min(1e-10)[:, None], opacity

    def picture(self, cameras: Cameras, view: int, harmonics: Annotated[Tensor, "N K 3"] | None = None) -> Picture:
        """The scene as it is, or with other harmonics, on grey."""
        gaussians = self.scene.gaussians if harmonics is None else self.scene.gaussians.recoloured(harmonics)
        camera = camera_of(cameras, view)
        return to_uint8(draw(gaussians, camera, antialiased=self.scene.antialiased, background=_BACKDROP).image)


def splat_regions(scene: SplatScene, file: StyleFile) -> Regions:
    """The regions of a scene, as they are named by number, by a pixel of a view, or in the style file."""
    return Regions(SplatViews(scene), scene.style, scene.basis, file.regions, file.semantic_encoder)


@torch.inference_mode()
def restyle_gaussians(scene: SplatScene, file: StyleFile, encoder: Encoder, trail: tuple[Path, ...] = ()) -> Styled:
    """The counterpart of `restyle.apply_style`. Raises the same errors."""
    style = file.style
    if not style.references:
        raise UsageError("--references: at least one photograph is needed, for example --references autumn.jpg night.jpg")
    styled = _dressed(scene, file, _dictionary(scene, style, encoder))
    if style.between is None or style.at == 0:
        return styled
    path = style.between.resolve()
    if path in trail:
        raise ConfigError(f"{style.between}: lies between styles that lead back to it; end the circle")
    other = read_style(style.between)
    check_photographs(style.between, other)
    return mixed(styled, restyle_gaussians(scene, other, encoder, (*trail, path)), style.at)


@torch.inference_mode()
def restyled_harmonics(
    scene: SplatScene, look: Restyle, progress: Callable[[int, int], None] = lambda done, total: None
) -> Annotated[Tensor, "N K 3"]:
    """New harmonics. Gaussians that the look leaves alone (strength 0) keep theirs, bit for bit."""
    before, out = scene.gaussians.harmonics, []
    if look.idle:
        return before
    kept = sum(part.share * part.luminance for part in look.parts)
    for start in range(0, len(before), _ROWS):
        progress(start, len(before))
        rows = before[start : start + _ROWS]
        matrix, bias, weight = _change(look, scene.semantic[start : start + _ROWS])
        matrix = matrix + torch.eye(3)
        if kept > 0:  # what the map adds to luma is taken back from all channels alike
            ones = torch.ones(1, 3)
            matrix = matrix + kept * (luma(torch.eye(3)) - luma(matrix)) * ones
            bias = bias - kept * luma(bias) * ones
        drawn = as_drawn(rows)
        colour = 0.5 + HARMONIC * drawn[:, 0]
        moved = torch.einsum("nc,ncd->nd", colour, matrix) + bias
        # Within the range of colours, but for those that were outside: what is brighter than white would glow at soft edges.
        moved = moved.maximum(colour.clamp_max(0)).minimum(colour.clamp_min(1))
        new = torch.einsum("nkc,ncd->nkd", drawn, matrix)
        new[:, 0] = (moved - 0.5) / HARMONIC
        out.append(torch.where((weight > 0)[:, None, None], new, rows))
    return torch.cat(out)


def as_drawn(harmonics: Annotated[Tensor, "N K 3"]) -> Annotated[Tensor, "N K 3"]:
    """Harmonics of the colours that renderers show, which are cut at 0: a map would lift what was hidden below.

    Where some direction is cut, the cut colours of directions all around are fitted again, in least squares, by the harmonics
    up to degree 3.
    """
    at = torch.arange(_DIRECTIONS) + 0.5
    height, turn = 1 - 2 * at / _DIRECTIONS, at * (math.pi * (5**0.5 - 1))
    flat = (1 - height.square()).sqrt()
    around = torch.stack([flat * turn.cos(), flat * turn.sin(), height], 1)
    count = min(harmonics.shape[1], 16)
    basis = harmonic_functions(around, math.isqrt(count))
    colour = 0.5 + torch.einsum("db,nbc->ndc", basis, harmonics[:, :count])
    cut = (colour < 0).any(1).any(1)
    out = harmonics.clone()
    out[cut, :count] = torch.einsum("bd,ndc->nbc", torch.linalg.pinv(basis), colour[cut].clamp_min(0) - 0.5)
    return out


def _change(
    look: Restyle, semantic: Annotated[Tensor, "N D"]
) -> tuple[Annotated[Tensor, "N 3 3"], Annotated[Tensor, "N 3"], Annotated[Tensor, "N"]]:
    """What a look adds to the identity: A and b of each Gaussian, c' = c + c A + b, and how strongly it acts."""
    matrix, bias, weight = semantic.new_zeros(len(semantic), 3, 3), semantic.new_zeros(len(semantic), 3), semantic.new_zeros(())
    for part in look.parts:
        if part.share == 0 or part.strength == 0:
            continue
        acts = (
            part.share
            * part.strength
            * (semantic.new_ones(len(semantic), 1) if part.regions is None else part.regions(semantic))
        )
        if part.colours is not None:
            maps = part.colours
            belongs = membership(semantic, maps.semantic_mean, maps.units, maps.softness)
            added = torch.einsum("nk,kcd->ncd", belongs, maps.matrix), belongs @ maps.bias
        else:  # an affine stylizer is known by what it makes of black and of each channel alone
            black = part.stylizer(semantic.new_zeros(len(semantic), 3), semantic)
            rows = [part.stylizer(axis.expand(len(semantic), 3), semantic) - black for axis in torch.eye(3)]
            added = part.features * (torch.stack(rows, 1) - torch.eye(3)), part.features * black
        matrix, bias, weight = matrix + acts[..., None] * added[0], bias + acts * added[1], weight + acts[:, 0]
    return matrix, bias, weight


def _dressed(scene: SplatScene, file: StyleFile, dictionary: StyleDictionary) -> Styled:
    """The counterpart of `restyle.dress`."""
    style, own = file.style, scene.style
    dictionary = dictionary._replace(origin=scene.basis.origin())
    orders = take_orders(splat_regions(scene, file), dictionary, style)
    stylizer = regional(dictionary, own, orders.allowed, style.stylizer)
    colours = None
    if style.stylizer.colours > 0:
        # Matched with itself as with the photographs, the scene keeps its colours.
        mine = own_style(own, dictionary.blend)._replace(origin=dictionary.origin)
        table = double(style.stylizer.build(dictionary=mine, scene=own).match(own.keys))
        mean, covariances = table @ double(mine.mean), torch.einsum("kt,tij->kij", table, double(mine.covariance))
        taken = double(stylizer.match(own.keys))
        colours = ColourMaps(own, *carried_colours(mean, covariances, taken, dictionary), style.stylizer.colours)
    partly = bool((orders.strength != 1).any())
    look = Restyle(
        stylizer,
        style.strength,
        RegionWeight(own, orders.strength[:, None]) if partly else None,
        style.stylizer.features,
        colours,
        style.luminance,
    )
    codes = Codes(dictionary.reference, dictionary.names, unit(dictionary.keys, own.semantic_mean))
    return Styled(look, dictionary, own, codes, orders)


def _dictionary(scene: SplatScene, style: StyleConfig, encoder: Encoder) -> StyleDictionary:
    references = [
        read_reference(
            path,
            content=Colours(),
            semantic=encoder,
            basis=scene.basis,
            longest=max(int(scene.cameras.size.amax()), _SHORTEST),
            weight=style.weights[i] if style.weights else 1.0,
            mask=style.masks[i] if style.masks and style.masks[i] != NO_MASK else None,
            name=name,
        )
        for i, (path, name) in enumerate(zip(style.references, labels(style.references), strict=True))
    ]
    return build_dictionary(references, clusters=style.clusters, blend=style.blend)
