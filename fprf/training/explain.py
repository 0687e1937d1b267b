"""A scene's regions, as a user picks them: where each is seen best, how large it is, and what it takes from the references."""

import math
from typing import Annotated, Any, NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from ..io.images import Picture, to_uint8
from ..io.sheet import Tile, highlight
from .regions import Regions, membership_view, shrunk
from .restyle import Styled

__all__ = ["Region", "Taken", "explain", "region_row", "region_tile"]

_VIEWS = 24
"""Views that are looked through for where each region is largest, evenly over all."""

_COARSE, _FINE = 32, 160
"""Longest side of the views that are looked through, and of the thumbnails."""


class Taken(NamedTuple):
    """What a region takes from one reference."""

    name: str
    share: float
    """Of the region's attention; what it would be, where the region is kept."""
    score: float
    """Cosine with the nearest of the reference's codes, in [-1, 1]."""


class Region(NamedTuple):
    """One of the scene's regions."""

    number: int
    share: float
    """Of the scene's weight."""
    view: str
    """Where it is largest."""
    pixel: tuple[int, int]
    """A place in that view, in the middle of it: what to point at to mean it."""
    picture: Picture
    """That view with the region highlighted."""
    taken: tuple[Taken, ...] = ()
    """All references, the most used first."""
    entropy: float = 0.0
    """Bits, over the style codes."""
    strength: float = 1.0
    """0 = it stays as it is."""
    restricted: bool = False
    """It may not take from all references."""


@torch.inference_mode()
def explain(regions: Regions, styled: Styled | None = None) -> list[Region]:
    """All regions in their order, with what they take where there is a style."""
    names, count = regions.views.names, len(regions.scene.share)
    looked = sorted({round(i * (len(names) - 1) / max(1, _VIEWS - 1)) for i in range(_VIEWS)})
    mass = torch.stack([_mass(regions, view) for view in looked])
    best = [looked[int(mass[:, k].argmax())] for k in range(count)]
    seen = {view: _seen(regions, view) for view in sorted(set(best))}
    rows = []
    for k, view in enumerate(best):
        colour, share = seen[view]
        width, height = regions.views.cameras.size[view].tolist()
        pixel = _middle(share[..., k], (width, height))
        rows.append(Region(k, float(regions.scene.share[k]), names[view], pixel, highlight(colour, share[..., k])))
    if styled is None:
        return rows
    attention = styled.restyle.stylizer.match(regions.scene.keys.to(regions.views.device)).cpu().double()
    return [_matched(region, styled, attention[region.number]) for region in rows]


def region_row(region: Region) -> dict[str, Any]:
    """A region for JSON."""
    row: dict[str, Any] = {"region": region.number, "share": region.share, "view": region.view, "pixel": list(region.pixel)}
    if region.taken:
        row |= {
            "references": [taken._asdict() for taken in region.taken],
            "entropy_bits": region.entropy,
            "strength": region.strength,
            "restricted": region.restricted,
        }
    return row


def region_tile(region: Region, names: tuple[str, ...]) -> Tile:
    """A region for a sheet; `names` are the references in the order of their colours."""
    lines = [f"{region.number}: {region.share:.1%} of the scene"]
    lines.append(f"{region.view}:{region.pixel[0]},{region.pixel[1]}")
    if not region.taken:
        return Tile(region.picture, tuple(lines))
    best = region.taken[0]
    lines.append("kept as it is" if region.strength == 0 else f"{best.name} {best.share:.0%}, score {best.score:.2f}")
    by_name = {taken.name: taken.share * region.strength for taken in region.taken}
    return Tile(region.picture, tuple(lines), tuple(by_name[name] for name in names))


def _mass(regions: Regions, view: int) -> Annotated[Tensor, "K"]:
    """Share of a view's pixels in each region."""
    share, opacity = membership_view(regions, view, _COARSE)
    return (share * opacity[..., None]).mean((0, 1))


def _seen(regions: Regions, view: int) -> tuple[Picture, Annotated[Tensor, "H W K"]]:
    """A view as it is, small, and where its regions are."""
    share, opacity = membership_view(regions, view, _FINE)
    return to_uint8(regions.views.render(shrunk(regions.views.cameras, view, _FINE), 0).rgb), share * opacity[..., None]


def _middle(share: Annotated[Tensor, "H W"], size: tuple[int, int]) -> tuple[int, int]:
    """The pixel, of the full view, about which most of the region lies."""
    reach = 2 * (max(share.shape) // 12) + 1
    smooth = cv2.blur(share.cpu().numpy(), (reach, reach), borderType=cv2.BORDER_CONSTANT)
    y, x = np.unravel_index(int(np.argmax(smooth * (share.cpu().numpy() > 0.5) + 1e-3 * smooth)), smooth.shape)
    height, width = share.shape
    return int((x + 0.5) * size[0] / width), int((y + 0.5) * size[1] / height)


def _matched(region: Region, styled: Styled, attention: Annotated[Tensor, "T"]) -> Region:
    reference, score, controls = styled.dictionary.reference, styled.controls.score[region.number], styled.controls
    rows = [
        Taken(name, float(attention[reference == i].sum()), float(score[reference == i].max()))
        for i, name in enumerate(styled.dictionary.names)
    ]
    return region._replace(
        taken=tuple(sorted(rows, key=lambda row: (-row.share, -row.score))),
        entropy=float(torch.special.entr(attention).sum()) / math.log(2),
        strength=float(controls.strength[region.number]),
        restricted=not bool(controls.allowed[region.number].all()),
    )
