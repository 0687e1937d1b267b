"""Depth and matching as pictures: what the geometry is, and which reference each place took its style from.

Several pictures as one: thumbnails of a scene's regions with what they take from references, or a view in
several styles.
"""

import math
from collections.abc import Sequence
from typing import Annotated, NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from ..errors import DataError
from .images import Picture, checked, resized, to_uint8

_EMPTY = (0.50, 0.51, 0.53)
"""Colour of pixels that hit nothing: a grey that neither map uses."""

_KEPT = (0.86, 0.87, 0.88)
"""Colour of pixels that a style leaves as they are: paler than anything that takes part."""

_COLOURS = (
    (0.902, 0.624, 0.000),  # orange
    (0.337, 0.706, 0.914),  # sky blue
    (0.835, 0.369, 0.000),  # vermilion
    (0.000, 0.620, 0.451),  # bluish green
    (0.800, 0.475, 0.655),  # reddish purple
    (0.000, 0.447, 0.698),  # blue
    (0.941, 0.894, 0.259),  # yellow
)
"""Okabe and Ito's colours, told apart with any of the usual colour blindnesses; ordered for contrast between
neighbours.
"""


def palette(count: int) -> Annotated[Tensor, "T 3"]:
    """sRGB colours in [0, 1] of `count` references. From the eighth on the hues repeat, a third darker or
    lighter.
    """
    rows = []
    for index in range(count):
        colour = torch.tensor(_COLOURS[index % len(_COLOURS)])
        turn = index // len(_COLOURS)
        # 1st repeat darker, 2nd lighter, 3rd darker still: lightness then is all that is left to tell them
        # apart.
        strength = 1 - 0.65 ** ((turn + 1) // 2)
        rows.append(torch.lerp(colour, torch.full((3,), float(turn % 2 == 0)), strength))
    return torch.stack(rows) if rows else torch.zeros(0, 3)


def depth_limits(
    depths: Sequence[Annotated[Tensor, "H W"]], opacities: Sequence[Annotated[Tensor, "H W"]]
) -> tuple[float, float]:
    """Disparity (1 / depth) range of several views, so that they share one scale: 1st and 99th percentile
    where solid.

    (0, 1) where nothing is solid in any view.
    """
    seen = []
    for depth, opacity in zip(depths, opacities, strict=True):
        seen.append((1 / depth[_solid(depth, opacity)]).cpu().numpy())
    disparity = np.concatenate([np.zeros(0, np.float32), *seen])
    if not len(disparity):
        return 0.0, 1.0
    low, high = (float(value) for value in np.percentile(disparity, (1, 99)))
    return low, high


def depth_image(
    depth: Annotated[Tensor, "H W"],
    opacity: Annotated[Tensor, "H W"],
    limits: tuple[float, float] | None = None,
) -> Picture:
    """Depth (any unit, > 0) as colour: near is bright, far is dark, nothing is grey. `limits` as from
    `depth_limits`.

    The colour is even in disparity, which is how much a place moves between views. Inferno: perceptually
    even, legible in greyscale and to the colour-blind.
    """
    if limits is None:
        low, high = depth_limits([depth], [opacity])
    else:
        low, high = limits
    solid = _solid(depth, opacity, 0.0)
    disparity = torch.where(
        solid, 1 / torch.where(solid, depth, torch.ones_like(depth)), torch.zeros_like(depth)
    )
    # A plane square to the view has one disparity: shown as halfway, not as noise.
    if high > low:
        even = (disparity - low) / (high - low)
    else:
        even = torch.full_like(disparity, 0.5)
    # Inferno's first steps are black: stay off them, so that far places keep some hue.
    return _over_empty(
        _mapped(even.clamp(0, 1) * 235 + 20, cv2.COLORMAP_INFERNO), torch.where(solid, opacity, 0.0)
    )


def match_image(
    attention: Annotated[Tensor, "H W T"],
    reference: Annotated[Tensor, "T"],
    names: Sequence[str],
    opacity: Annotated[Tensor, "H W"] | None = None,
    kept: Annotated[Tensor, "H W"] | None = None,
) -> Picture:
    """Picture of the reference of each pixel: its hue (`palette`), the code of it as a shade, doubt as
    darkness.

    `attention` as `Stylizer.match` gives it (rows sum to 1); `reference` is the dictionary's; `kept` is how
    much of each pixel takes no style at all, shown pale. Raises DataError for numbers that do not fit
    together.
    """
    _fitting(attention, reference, names)
    # Each code has its reference's hue, from a quarter darker to a quarter lighter in the order of the codes.
    hues = palette(len(names))
    colours = torch.empty(len(reference), 3)
    for index in range(len(names)):
        codes = (reference.cpu() == index).nonzero()[:, 0]
        for place, code in enumerate(codes.tolist()):
            if len(codes) == 1:
                shade = 0.0
            else:
                shade = 0.5 * place / (len(codes) - 1) - 0.25
            colours[code] = torch.lerp(hues[index], torch.full((3,), float(shade > 0)), abs(shade))
    weights = attention.detach().cpu().float()
    # Doubt never hides the hue: the darkest is 45 %.
    light = 0.45 + 0.55 * (1 - _entropy(weights) / math.log(max(2, weights.shape[-1])))
    picture = colours[weights.argmax(dim=-1)] * light.clamp(0, 1)[..., None]
    if kept is not None:
        picture = torch.lerp(picture, torch.tensor(_KEPT), kept.detach().cpu().float().clamp(0, 1)[..., None])
    return _over_empty(picture, opacity)


def scale_image(
    values: Annotated[Tensor, "H W"], low: float, high: float, opacity: Annotated[Tensor, "H W"] | None = None
) -> Picture:
    """Numbers as colour on a fixed scale: `low` and below dark blue, `high` and above yellow (viridis),
    nothing grey.
    """
    even = ((values.detach().cpu().float() - low) / (high - low)).nan_to_num(0.0).clamp(0, 1)
    return _over_empty(_mapped(even * 255, cv2.COLORMAP_VIRIDIS), opacity)


def match_summary(
    attention: Annotated[Tensor, "H W T"],
    reference: Annotated[Tensor, "T"],
    names: Sequence[str],
    opacity: Annotated[Tensor, "H W"] | None = None,
) -> dict[str, object]:
    """Use of the references: their `share` of the attention (sums to 1), the mean of the best code's
    attention (`mean_score`, 1 = certain) and the mean `entropy` in bits (0 = certain). Pixels count by their
    opacity.
    """
    _fitting(attention, reference, names)
    weights = attention.detach().cpu()
    if opacity is None:
        cover = torch.ones(weights.shape[:2])
    else:
        cover = opacity.detach().cpu()
    each = cover.double().clamp(min=0)
    # An empty view has no shares to speak of; dividing by 1 leaves them at 0.
    total = float(each.sum()) or 1.0
    codes = weighted_sum(weights, each) / total
    shares = torch.zeros(len(names), dtype=torch.float64).index_add_(0, reference.cpu(), codes)
    return {
        "references": [
            {"name": name, "share": float(share)} for name, share in zip(names, shares, strict=True)
        ],
        "mean_score": float((weights.amax(dim=-1) * each).sum()) / total,
        "entropy_bits": float((_entropy(weights) * each).sum()) / total / math.log(2),
    }


def weighted_sum(
    values: Annotated[Tensor, "H W T"], weight: Annotated[Tensor, "H W"]
) -> Annotated[Tensor, "T"]:
    """Sum over the pixels, in float64; the products of a row are summed in the precision of `values`."""
    return torch.bmm(weight.to(values.dtype)[:, None], values)[:, 0].double().sum(0)


_TILE_PIXELS = 240
"""Width of a tile; pictures are enlarged or reduced to it. By eye, as all of these."""
_LINE_PIXELS = 17
"""Height of a line of text."""
_GAP_PIXELS = 8
"""Between tiles."""
_BAR_PIXELS = 6
"""Height of the bar of shares."""
_INK = (30, 32, 36)
"""Colour of texts."""
_PAPER = (250, 250, 248)
"""Colour behind them."""
_FAINT = (215, 216, 218)
"""Colour of the rest of a bar."""
_OUTLINE = (255, 214, 10)
"""Colour of the border of a region: a yellow that few photographs have."""
_MAX_TILES_PER_ROW = 4
"""Tiles side by side: about as wide as a page."""


class Tile(NamedTuple):
    """A picture with lines of text below."""

    picture: Picture
    lines: tuple[str, ...]
    shares: tuple[float, ...] = ()
    """Of each reference, drawn as a bar in their colours; what is missing to 1 stays pale."""


def highlight(picture: Picture, inside: Annotated[Tensor, "H W"]) -> Picture:
    """A picture in which one part keeps its colours, with an outline, and the rest is dim and grey.

    `inside` lies in [0, 1], at any size.
    """
    height, width = checked(picture).shape[:2]
    share = np.clip(
        cv2.resize(inside.detach().cpu().float().numpy(), (width, height), interpolation=cv2.INTER_LINEAR),
        0,
        1,
    )
    # Outside half as bright and without colour, mixed by the share; then the edge of what is more than half
    # inside.
    grey = cv2.cvtColor(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2RGB).astype(np.float32)
    dim = 0.35 * grey + 40
    mixed = np.asarray(dim + (picture - dim) * share[..., None]).clip(0, 255).astype(np.uint8)
    edges, _ = cv2.findContours((share > 0.5).astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    return np.asarray(cv2.drawContours(mixed, edges, -1, _OUTLINE, 1), dtype=np.uint8)


def contact_sheet(tiles: Sequence[Tile]) -> Picture:
    """The tiles in rows of four, in their order. Letters beyond ASCII are shown as '?'."""
    if not tiles:
        return np.full((_GAP_PIXELS, _GAP_PIXELS, 3), _PAPER, dtype=np.uint8)
    drawn = []
    for tile in tiles:
        drawn.append(_tile(tile))
    columns = min(_MAX_TILES_PER_ROW, len(drawn))
    height = max(len(each) for each in drawn)
    rows = math.ceil(len(drawn) / columns)
    page_height = rows * (height + _GAP_PIXELS) + _GAP_PIXELS
    page_width = columns * (_TILE_PIXELS + _GAP_PIXELS) + _GAP_PIXELS
    page = np.full((page_height, page_width, 3), _PAPER, np.uint8)
    for i, each in enumerate(drawn):
        top = _GAP_PIXELS + (i // columns) * (height + _GAP_PIXELS)
        left = _GAP_PIXELS + (i % columns) * (_TILE_PIXELS + _GAP_PIXELS)
        page[top : top + len(each), left : left + _TILE_PIXELS] = each
    return page


def _tile(tile: Tile) -> Picture:
    height, width = checked(tile.picture).shape[:2]
    picture = resized(tile.picture, _TILE_PIXELS, max(1, round(height * _TILE_PIXELS / width)))
    below = np.full(
        (_BAR_PIXELS + _LINE_PIXELS * len(tile.lines) + _GAP_PIXELS, _TILE_PIXELS, 3), _PAPER, dtype=np.uint8
    )
    # A bar of the references' shares, one after the other; what is missing to 1 stays pale.
    if tile.shares:
        below[:_BAR_PIXELS] = _FAINT
        edge = 0.0
        colours = (palette(len(tile.shares)) * 255).round().int().tolist()
        for share, colour in zip(tile.shares, colours, strict=True):
            below[:_BAR_PIXELS, round(edge * _TILE_PIXELS) : round((edge + share) * _TILE_PIXELS)] = colour
            edge += share
    # As much of each line as the tile is wide.
    for i, line in enumerate(tile.lines):
        text = line.encode("ascii", "replace").decode()
        scale = 0.42
        font = cv2.FONT_HERSHEY_SIMPLEX
        while text and cv2.getTextSize(text, font, scale, 1)[0][0] > _TILE_PIXELS - 2:
            text = text[:-1]
        cv2.putText(below, text, (1, _BAR_PIXELS + _LINE_PIXELS * i + 14), font, scale, _INK, 1, cv2.LINE_AA)
    return np.concatenate([picture, below])


_SEAM_PIXELS = 2
"""Width of the line between pictures: by eye."""


def side_by_side(pictures: Sequence[Picture]) -> Picture:
    """The pictures from left to right, with a thin line between them. Raises DataError where their heights
    differ.
    """
    if len({checked(picture).shape[0] for picture in pictures}) != 1:
        raise DataError(
            f"pictures of heights {[picture.shape[0] for picture in pictures]} cannot lie beside each other"
        )
    line = np.full((pictures[0].shape[0], _SEAM_PIXELS, 3), 255, np.uint8)
    parts = [part for picture in pictures for part in (line, picture)][1:]
    return np.concatenate(parts, axis=1)


def _solid(depth: Tensor, opacity: Tensor, least: float = 0.5) -> Tensor:
    return torch.isfinite(depth) & (depth > 0) & (opacity > least)


def _mapped(steps: Annotated[Tensor, "H W"], colours: int) -> Annotated[Tensor, "H W 3"]:
    """Colours in [0, 1] of one of OpenCV's maps at its steps, 0 to 255."""
    picture = cv2.applyColorMap(steps.to(torch.uint8).cpu().numpy(), colours)
    return torch.from_numpy(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)).float() / 255


def _over_empty(picture: Annotated[Tensor, "H W 3"], opacity: Annotated[Tensor, "H W"] | None) -> Picture:
    if opacity is None:
        return to_uint8(picture)
    cover = opacity.detach().cpu().float().clamp(0, 1)
    return to_uint8(torch.lerp(torch.tensor(_EMPTY).expand_as(picture), picture, cover[..., None]))


def _entropy(weights: Annotated[Tensor, "H W T"]) -> Annotated[Tensor, "H W"]:
    """In nats; 0 log 0 = 0."""
    entropy: Tensor = torch.special.entr(weights.clamp(min=0)).sum(dim=-1)
    return entropy


def _fitting(attention: Tensor, reference: Tensor, names: Sequence[str]) -> None:
    if attention.ndim != 3 or attention.shape[-1] != len(reference) or not len(reference):
        raise DataError(
            f"attention {tuple(attention.shape)} does not fit {len(reference)} style codes; it must be [H W T]"
        )
    if int(reference.min()) < 0 or int(reference.max()) >= len(names):
        raise DataError(
            f"style codes name reference {int(reference.max())}, but there are {len(names)} references"
        )
