"""A style as 3D lookup tables (.cube) for video editors: one for the whole scene, and one for each of its regions.

A table knows nothing but a pixel's colour. What the style does to one colour in one way is kept; what depends on where the
pixel lies is averaged within a region, so that tables of regions, behind mattes, are closer than the one for all.

Letters of the fit: n nodes a side, h = 1 / (n - 1) their distance in colour, D [n n n 3] how far a node's colour is moved (red
first). It minimises, over all pairs x -> y of weight w (sum 1),

    sum_i w_i |x_i + D(x_i) - y_i|^2  +  s ( integral |grad D|^2  +  integral |D|^2 / r^2 )

with D trilinear between nodes. s is the smoothness; away from pairs D fades as exp(-distance / r). Float64; solved by
conjugate gradients.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ..config import RenderConfig
from ..io.atomic import write_text
from ..memory import chunk_size, in_parts
from ..rendering.cameras import Cameras, rays_through
from ..rendering.renderer import composite
from ..style.look import Restyle
from ..style.scene import Membership, SceneStyle
from ..training.model import Model
from ..training.style_pass import lattice
from ..types import Rays
from .colours import colours_in_styles

SMOOTH = 1e-3
"""s: pairs in a fourteenth of the colour cube outweigh the bending of a twentieth of its side."""
REACH = 0.25
"""r: in units of the colour range."""
_STEPS = 1000
_CLOSE = 1e-8
"""Residual at which the fit has converged, relative to the start's."""


def identity(size: int) -> Annotated[Tensor, "n n n 3"]:
    """The colours of the nodes, indexed [red, green, blue]."""
    axis = torch.linspace(0, 1, size, dtype=torch.float64)
    return torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)


def apply_lattice(table: Annotated[Tensor, "n n n 3"], colour: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N 3"]:
    """Colours in [0, 1] through a table, trilinearly, as video editors do."""
    index, part = _corners(colour.to(table), table.shape[0])
    return (table.reshape(-1, 3)[index] * part[:, :, None]).sum(1)


def fit_lattice(
    source: Annotated[Tensor, "N 3"], target: Annotated[Tensor, "N 3"], weight: Annotated[Tensor, "N"], size: int
) -> Annotated[Tensor, "n n n 3"]:
    """The table of a colour map, in [0, 1]; the identity where no pair has weight."""
    whole = identity(size)
    total = weight.double().sum()
    if float(total) <= 0:
        return whole
    x, move, w = _binned(source.double(), (target - source).double(), weight.double() / total, 2 * size)
    index, part = _corners(x, size)
    h = 1 / (size - 1)
    smooth, pull = SMOOTH * h, SMOOTH * h**3 / REACH**2
    flat = index.view(-1)

    def spread(values: Annotated[Tensor, "B 3"]) -> Tensor:
        """The transpose of looking up, weighted."""
        each = (values * w[:, None])[:, None] * part[:, :, None]
        return whole.new_zeros(size**3, 3).index_add(0, flat, each.view(-1, 3)).view_as(whole)

    def curved(d: Tensor) -> Tensor:
        """The matrix of the normal equations."""
        looked = (d.reshape(-1, 3)[index] * part[:, :, None]).sum(1)
        return spread(looked) + smooth * _stiffness(d) + pull * d

    data = whole.new_zeros(size**3).index_add(0, flat, (w[:, None] * part.square()).view(-1)).view(size, size, size, 1)
    moved = _solve(curved, spread(move), 1 / (data + 6 * smooth + pull))
    return (whole + moved).clamp(0, 1)


def _solve(matrix: Callable[[Tensor], Tensor], right: Tensor, scale: Tensor) -> Tensor:
    """Conjugate gradients, preconditioned by a diagonal."""
    solution, residual = torch.zeros_like(right), right
    ready = scale * residual
    way, force = ready, (residual * ready).sum()
    enough = _CLOSE**2 * force
    for _ in range(_STEPS):
        if float(force) <= float(enough):
            break
        bent = matrix(way)
        step = force / (way * bent).sum()
        solution, residual = solution + step * way, residual - step * bent
        ready = scale * residual
        before, force = force, (residual * ready).sum()
        way = ready + force / before * way
    return solution


def _stiffness(d: Tensor) -> Tensor:
    """Sum of differences to the neighbours along each axis: the lattice's Laplacian, free at the cube's faces."""
    out = torch.zeros_like(d)
    for axis in range(3):
        step = d.diff(dim=axis)
        zero = torch.zeros_like(d.narrow(axis, 0, 1))
        out = out + torch.cat([zero, step], axis) - torch.cat([step, zero], axis)
    return out


def _corners(colour: Annotated[Tensor, "N 3"], size: int) -> tuple[Annotated[Tensor, "N 8"], Annotated[Tensor, "N 8"]]:
    """The nodes round each colour and their trilinear shares."""
    at = colour.clamp(0, 1) * (size - 1)
    low = at.long().clamp(max=size - 2)
    part = at - low
    index, share = [], []
    for corner in range(8):
        bit = torch.tensor([corner >> 2 & 1, corner >> 1 & 1, corner & 1])
        node = low + bit
        index.append((node[:, 0] * size + node[:, 1]) * size + node[:, 2])
        share.append(torch.where(bit.bool(), part, 1 - part).prod(-1))
    return torch.stack(index, 1), torch.stack(share, 1)


def _binned(x: Tensor, move: Tensor, w: Tensor, bins: int) -> tuple[Tensor, Tensor, Tensor]:
    """Pairs of one small cell of colours as one: the fit cannot tell them apart, and need not look at each."""
    cell = (x.clamp(0, 1) * bins).long().clamp(max=bins - 1)
    key, group = torch.unique((cell[:, 0] * bins + cell[:, 1]) * bins + cell[:, 2], return_inverse=True)
    total = w.new_zeros(len(key)).index_add(0, group, w)
    sums = w.new_zeros(len(key), 6).index_add(0, group, torch.cat([x, move], 1) * w[:, None])
    keep = total > 0
    mean = sums[keep] / total[keep, None]
    return mean[:, :3], mean[:, 3:], total[keep]


RAYS = 16384
"""Pixels that a table is fitted to."""


class ColourPairs(NamedTuple):
    """Colours of R pixels, as they are and in each of S looks."""

    plain: Annotated[Tensor, "R 3"]
    styled: Annotated[Tensor, "S R 3"]
    share: Annotated[Tensor, "R K"]
    """Share of each pixel's light from each region of the scene; rows sum to the pixel's opacity."""


@torch.inference_mode()
def colour_pairs(
    model: Model,
    scene: SceneStyle,
    cameras: Cameras,
    views: Sequence[int],
    config: RenderConfig,
    styles: Sequence[Restyle],
    rays: int = RAYS,
) -> ColourPairs:
    """Pixels spread evenly over the views, without any background."""
    device = model.device
    weight = Membership(scene).to(device)
    view, pixel = lattice(cameras, torch.tensor(list(views)), rays)
    every = model.space.rays(*rays_through(cameras, view, pixel))

    def looked(here: slice) -> Tensor:
        part, looks = Rays(*(x[here].to(device) for x in every)), [None, *styles]
        marched, colours, semantic = colours_in_styles(part, model.parts, config.budget, looks, semantic=weight.divided)
        kept = marched.kept
        shares = weight(kept.point[:, :0] if semantic is None or not weight.divided else semantic)
        return torch.cat([*colours, composite(kept, shares, len(part.near))], 1)

    whole = torch.cat(list(in_parts(len(view), chunk_size(config.chunk, device), looked))).cpu()
    count = 3 * (1 + len(styles))
    colours, share = whole[:, :count], whole[:, count:]
    colour = (colours / share.sum(1).clamp_min(1e-6)[:, None]).clamp(0, 1).view(len(whole), -1, 3)
    return ColourPairs(colour[:, 0], colour[:, 1:].transpose(0, 1), share)


def fit_quality(
    pairs: ColourPairs, look: int, weight: Annotated[Tensor, "R"], size: int
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
