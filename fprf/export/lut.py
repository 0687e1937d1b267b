"""A style as 3D lookup tables (.cube) for video editors: one for the whole scene, and one for each of its regions.

What depends on a pixel's place is averaged within a region. D [3 n n n] is how far colours at nodes, h = 1 / (n - 1) apart, are
moved (axes blue, green, red); trilinear, it minimises over pairs x -> y of weight w (sum 1)

    sum_i w_i |x_i + D(x_i) - y_i|^2  +  s ( integral |grad D|^2  +  integral |D|^2 / r^2 )
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import torch
import torch.nn.functional as F
from torch import Tensor

from ..interfaces import Scene
from ..io.atomic import write_text
from ..rendering.cameras import pixel_grid
from ..style.look import Restyle
from ..style.scene_style import Membership

SMOOTH, REACH = 1e-3, 0.25
"""s: pairs in a fourteenth of the cube outweigh the bending of a twentieth of its side. r: away from pairs D fades over it."""
_PIXELS, _STEPS = 16384, 80
"""Pixels that a table is fitted to, about; steps, after which the energy falls by less than 1e-6 of it."""


def colour_pairs(
    scene: Scene, looks: Sequence[Restyle | None], views: Sequence[int]
) -> tuple[list[Annotated[Tensor, "R 3"]], Annotated[Tensor, "R K"]]:
    """Colours of R solid pixels of views in each look, and the share of each of the scene's regions in them."""
    # Views are shrunk together until they hold about as many pixels as a table is fitted to.
    weight, chosen = Membership(scene.measured()[0]), scene.cameras.select(torch.tensor(list(views)))
    small = chosen.scaled(max(1.0, float(chosen.size.double().prod(1).sum() / _PIXELS) ** 0.5))
    shown, shares = [list[Tensor]() for _ in looks], []

    def regions(semantic: Tensor, position: Tensor | None) -> Tensor:
        shares: Tensor = weight.to(semantic.device)(semantic)
        return shares

    for view in range(len(small)):
        share, opacity = scene.paint(small, view, pixel_grid(small, view), regions)
        solid = opacity > 0.5
        shares.append(share[solid])
        for rows, look in zip(shown, looks, strict=True):
            rows.append(scene.restyled(look).render(small, view, resolution=1.0).rgb.view(-1, 3)[solid])
    return [torch.cat(rows) for rows in shown], torch.cat(shares)


def moved(table: Annotated[Tensor, "3 n n n"], colour: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N 3"]:
    """Colours in [0, 1] moved by a table, trilinearly, as video editors do."""
    at = 2 * colour.to(table).clamp(0, 1) - 1
    return colour.to(table) + F.grid_sample(table[None], at[None, None, None], align_corners=True)[0, :, 0, 0].T


def fit_table(
    source: Annotated[Tensor, "N 3"], target: Annotated[Tensor, "N 3"], weight: Annotated[Tensor, "N"], size: int
) -> Annotated[Tensor, "3 n n n"]:
    """D of a colour map; 0 where no pair has weight. Float64, by L-BFGS."""
    x, y, h = source.double(), target.double(), 1 / (size - 1)
    w = weight.double()[:, None] / weight.double().sum().clamp_min(1e-12)
    unknown = torch.zeros(3, size, size, size, dtype=torch.float64, requires_grad=True)
    # Nodes near pairs are held firmly, others loosely: in units of the one or the other they are found alike fast.
    (near,) = torch.autograd.grad((w * moved(unknown, x)).sum(), unknown)
    unit = (near + 6 * SMOOTH * h + SMOOTH * h**3 / REACH**2).rsqrt()
    solver = torch.optim.LBFGS([unknown], max_iter=_STEPS, line_search_fn="strong_wolfe", tolerance_change=1e-12)

    def energy() -> Tensor:
        """The sum at the top of the file; integrals are sums over nodes times h^3, differences of neighbours are h grad D."""
        solver.zero_grad()
        table = unknown * unit
        bend = torch.stack([table.diff(dim=axis).square().sum() for axis in (1, 2, 3)]).sum()
        total = (w * (moved(table, x) - y).square()).sum() + SMOOTH * (h * bend + h**3 / REACH**2 * table.square().sum())
        total.backward()  # type: ignore[no-untyped-call]
        return total

    solver.step(energy)  # type: ignore[no-untyped-call]
    return (unknown * unit).detach()


def write_cube(path: Path, table: Annotated[Tensor, "3 n n n"], title: str) -> None:
    """A .cube file, red changing fastest."""
    size, name = table.shape[1], "".join(c for c in title if c.isascii() and c.isprintable() and c != '"')
    nodes = torch.stack(torch.meshgrid(*(torch.linspace(0, 1, size, dtype=torch.float64),) * 3, indexing="ij")[::-1])
    rows = (nodes + table).clamp(0, 1).flatten(1).T.tolist()
    head = [f'TITLE "{name}"', f"LUT_3D_SIZE {size}", "DOMAIN_MIN 0.0 0.0 0.0", "DOMAIN_MAX 1.0 1.0 1.0"]
    write_text(path, "\n".join([*head, *(f"{r:.6f} {g:.6f} {b:.6f}" for r, g, b in rows), ""]))
