"""A style as 3D lookup tables (.cube) for video editors: one for the whole scene, and one for each of its regions.

A table knows nothing but a pixel's colour. What the style does to one colour in one way is kept; what depends on where the
pixel lies is averaged within a region, so that tables of regions, behind mattes, are closer than the one for all.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ..config import RenderConfig
from ..io.atomic import write_text
from ..memory import chunk_size
from ..rendering.cameras import Cameras, rays_through
from ..rendering.renderer import Restyle, composite, march
from ..style.regional import RegionWeight
from ..style.scene import SceneStyle
from ..training.model import Model
from ..training.style_pass import lattice
from ..types import Rays
from .colours import paint
from .lattice import apply_lattice, fit_lattice

__all__ = ["RAYS", "Pairs", "fit_quality", "look_pairs", "write_cube"]

RAYS = 16384
"""Pixels that a table is fitted to."""


class Pairs(NamedTuple):
    """Colours of R pixels, as they are and in each of S looks."""

    plain: Annotated[Tensor, "R 3"]
    styled: Annotated[Tensor, "S R 3"]
    share: Annotated[Tensor, "R K"]
    """How much of each pixel's light comes from each region of the scene; rows sum to the pixel's opacity."""


@torch.inference_mode()
def look_pairs(
    model: Model,
    scene: SceneStyle,
    cameras: Cameras,
    views: Sequence[int],
    config: RenderConfig,
    styles: Sequence[Restyle],
    rays: int = RAYS,
) -> Pairs:
    """Pixels spread evenly over the views, without any background."""
    device = model.device
    weight = RegionWeight(scene, torch.eye(len(scene.share))).to(device)
    view, pixel = lattice(cameras, torch.tensor(list(views)), rays)
    every = model.space.rays(*rays_through(cameras, view, pixel))
    found = []
    size = chunk_size(config.chunk, device)
    for start in range(0, len(view), size):
        part = Rays(*(x[start : start + size].to(device) for x in every))
        kept = march(part, model.parts, budget=config.budget).kept
        colours = paint(kept, model.parts, [None, *styles])
        semantic = model.semantic(kept.point) if model.semantic is not None and weight.divided else kept.point[:, :0]
        found.append(composite(kept, torch.cat([*colours, weight(semantic)], 1), len(part.near)))
    whole = torch.cat(found).cpu()
    solid = whole[:, 3 * len(styles) + 3 :].sum(1).clamp_min(1e-6)
    colour = (whole[:, : 3 * len(styles) + 3] / solid[:, None]).clamp(0, 1).view(len(whole), -1, 3)
    return Pairs(colour[:, 0], colour[:, 1:].transpose(0, 1), whole[:, 3 * len(styles) + 3 :])


def fit_quality(
    pairs: Pairs, look: int, weight: Annotated[Tensor, "R"], size: int
) -> tuple[Annotated[Tensor, "n n n 3"], dict[str, float]]:
    """The table of a look for pixels of some weight; RMS error in colour that it leaves, and that doing nothing leaves."""
    table = fit_lattice(pairs.plain, pairs.styled[look], weight, size)
    share = weight.double() / weight.double().sum().clamp_min(1e-12)

    def rms(colour: Tensor) -> float:
        return float((share[:, None] * (colour - pairs.styled[look]).double().square()).sum().div(3).sqrt())

    return table, {"rms": rms(apply_lattice(table, pairs.plain)), "rms_without": rms(pairs.plain.double())}


def write_cube(path: Path, table: Annotated[Tensor, "n n n 3"], title: str) -> None:
    """A .cube file, red changing fastest."""
    size = table.shape[0]
    name = "".join(c for c in title if c.isascii() and c.isprintable() and c != '"')
    rows = table.permute(2, 1, 0, 3).reshape(-1, 3).tolist()
    lines = [f'TITLE "{name}"', f"LUT_3D_SIZE {size}", "DOMAIN_MIN 0.0 0.0 0.0", "DOMAIN_MAX 1.0 1.0 1.0"]
    write_text(path, "\n".join([*lines, *(f"{r:.6f} {g:.6f} {b:.6f}" for r, g, b in rows), ""]))
