"""Choice of a scene's regions: by number, by name in a style file, by a pixel of a view, by a mask over one."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ..datamanagers.basis import Basis
from ..datamanagers.images import load_image
from ..errors import UsageError
from ..interfaces import Scene
from ..rendering.cameras import Cameras, pixel_grid
from .config import Pixel, pixel_of
from .files import Key
from .matching import scores, unit
from .scene import Membership, SceneStyle

ALIKE = 0.5
"""Least cosine of a region with a key from elsewhere: below, the scene has no such region.

Between the embedded towns in all lights and a photographed street, right matches lay from 0.53 to 0.98 (bundled semantic
encoder, 8 regions a scene); of the regions of scenes with nothing in common 9 in 10 lay below.
"""

_SIDE = 128
"""Longest side in pixels at which a mask over a view is looked at."""

_SOLID = 0.01
"""Less opacity is nothing to point at."""


class Regions(NamedTuple):
    """A scene's regions, and what is needed to find them."""

    views: Scene
    scene: SceneStyle
    basis: Basis | None
    keys: Mapping[str, Key] = {}
    """Regions that a style file names."""
    encoder: str = ""
    """Identity of the encoder that the keys are of, if the file tells."""


class RegionMatch(NamedTuple):
    """One region that somebody meant."""

    number: int
    name: str
    """Its name in the style file, or the number as text."""
    alike: float = 1.0
    """Cosine with the key of that name; 1 where the region was pointed at."""


def key_of(regions: Regions, number: int) -> Key:
    """The semantics of a region in the encoder's own channels, to six digits: what it can be found by on another scene."""
    if regions.basis is None:
        return ()
    return tuple(float(f"{x:.6g}") for x in regions.basis.lift(regions.scene.keys[number]).tolist())


def find_regions(regions: Regions, text: str) -> list[RegionMatch]:
    """The regions that a text means: one, those that a mask covers, or those like a region of the style file, if there are.

    Raises UsageError for what names nothing on this scene, DataError for an unreadable mask.
    """
    count, names = len(regions.scene.share), regions.views.names
    if text.isascii() and text.isdigit():
        if int(text) >= count:
            raise UsageError(f"region {text}: regions go from 0 to {count - 1}; --explain lists them")
        return [RegionMatch(int(text), text)]
    if text in regions.keys:
        return _like(regions, text)
    for view in sorted(range(len(names)), key=lambda v: -len(names[v])):
        if text.startswith(f"{names[view]}:"):
            rest = text[len(names[view]) + 1 :]
            pixel = pixel_of(rest)
            numbers = _covered(regions, view, Path(rest)) if pixel is None else _at(regions, view, pixel)
            return [RegionMatch(k, str(k)) for k in numbers]
    named = f", a name in the style file ({', '.join(regions.keys)})" if regions.keys else ""
    raise UsageError(
        f"region {text!r}: neither a number{named}, nor VIEW:X,Y or VIEW:MASK.png with a view of the run "
        f"({names[0]} … {names[-1]})"
    )


def memberships(
    scene: Scene, style: SceneStyle, cameras: Cameras, view: int, pixel: Annotated[Tensor, "N 2"]
) -> tuple[Annotated[Tensor, "N K"], Annotated[Tensor, "N"]]:
    """Share of what pixels (centres) see that belongs to each region of a scene's style, and their opacity."""
    belongs = Membership(style).to(scene.device)
    return scene.paint(cameras, view, pixel, lambda features, points: belongs(features), semantic=belongs.divided)


def membership_view(regions: Regions, view: int, size: int) -> tuple[Annotated[Tensor, "H W K"], Annotated[Tensor, "H W"]]:
    """Share of each pixel that belongs to each region, and its opacity, with the longest side at most `size` pixels."""
    cameras = shrunk(regions.views.cameras, view, size)
    share, opacity = memberships(regions.views, regions.scene, cameras, 0, pixel_grid(cameras, 0))
    width, height = (int(v) for v in cameras.size[0])
    return share.view(height, width, -1), opacity.view(height, width)


def shrunk(cameras: Cameras, view: int, size: int) -> Cameras:
    """One view alone, with the longest side at most `size` pixels."""
    one = cameras.select(torch.tensor([view]))
    return one.scaled(max(1.0, float(one.size.amax()) / size))


def _like(regions: Regions, name: str) -> list[RegionMatch]:
    """The regions that, of all that the style file knows, are most like the one of that name, and really like it."""
    encoder, scene, lengths = regions.views.semantic_encoder, regions.scene, {*map(len, regions.keys.values())}
    if regions.basis is None or lengths != {len(regions.basis.mean)} or regions.encoder not in ("", encoder):
        raise UsageError(
            f"region {name!r}: the style file knows it by the semantic encoder {regions.encoder or '(unnamed)'}, the scene has "
            f"{encoder or 'none'}; name the region by its number or a pixel of a view instead, or choose "
            "that encoder with --semantic.encoder"
        )
    if len(scene.share) == 1:
        return [RegionMatch(0, name)]
    there = regions.basis.project(torch.tensor(list(regions.keys.values())))
    alike, nearest = scores(unit(scene.keys, scene.semantic_mean), unit(there, scene.semantic_mean)).max(1)
    mine = (nearest == list(regions.keys).index(name)) & (alike >= ALIKE)
    return [RegionMatch(k, name, float(alike[k])) for k in mine.nonzero().flatten().tolist()]


def _at(regions: Regions, view: int, pixel: Pixel) -> list[int]:
    cameras = regions.views.cameras
    name, (width, height) = regions.views.names[view], cameras.size[view].tolist()
    if not (0 <= pixel.x < width and 0 <= pixel.y < height):
        raise UsageError(
            f"{name}:{pixel.x:g},{pixel.y:g}: outside of the view; x goes from 0 to {width - 1}, y from 0 to {height - 1}"
        )
    centre = torch.tensor([[int(pixel.x) + 0.5, int(pixel.y) + 0.5]], dtype=torch.float64)
    share, opacity = memberships(regions.views, regions.scene, cameras, view, centre)
    if float(opacity[0]) < _SOLID:
        raise UsageError(f"{name}:{pixel.x:g},{pixel.y:g}: there is nothing at that pixel; choose another")
    return [int(share[0].argmax())]


def _covered(regions: Regions, view: int, mask: Path) -> list[int]:
    """Regions of which the mask covers more than half of what the view shows, and the one that fills most of the mask."""
    share, opacity = membership_view(regions, view, _SIDE)
    height, width = opacity.shape
    white = torch.from_numpy(load_image(mask, (width, height))).float().mean(-1) / 255
    mass = (share * opacity[..., None]).flatten(0, 1)
    inside, total = white.flatten() @ mass, mass.sum(0)
    if float(inside.sum()) < _SOLID:
        raise UsageError(f"{mask}: the mask selects nothing of view {regions.views.names[view]}; paint white what counts")
    most = inside / total.clamp_min(1e-10)
    return sorted({int(inside.argmax()), *((most > 0.5) & (inside >= 1)).nonzero().flatten().tolist()})
