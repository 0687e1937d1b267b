"""A block starts as the surroundings it is trained in: what they have learnt of its place is not learnt again.

Planes are laid anew over the block's chart, each node with the value that the old planes have there; networks are copied. The
finer nodes then hold the coarse scene, which training sharpens. Parts that consist of anything else start from their seed.
"""

from typing import Annotated

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..fields.planes import Planes
from ..ops.triplane import AXES, split
from .charts import Chart
from .members import Member

__all__ = ["inherit", "relay"]


def inherit(member: Member, around: Member) -> None:
    """Let a member of the same config start as `around` is where it lies."""
    pairs: list[tuple[nn.Module | None, nn.Module | None]] = [
        (member.sampler, around.sampler),
        (member.field, around.field),
        (member.semantic, around.semantic),
    ]
    for own, other in pairs:
        if own is None or other is None or not _understood(own):
            continue
        own.load_state_dict(other.state_dict())
        for mine, theirs in zip(own.modules(), other.modules(), strict=True):
            if isinstance(mine, Planes) and isinstance(theirs, Planes):
                with torch.no_grad():
                    mine.table.copy_(relay(theirs, member.chart, around.chart))


def relay(planes: Planes, chart: Chart, old: Chart) -> Annotated[Tensor, "rows F"]:
    """The table of planes over `chart` that say what `planes` say over `old`: exact at the nodes where axes agree.

    Of a turned chart each axis takes the plane of the old axis that it follows most.
    """
    follows = [int(row.abs().argmax()) for row in chart.turn @ old.turn.T]
    if len(set(follows)) < len(follows):
        follows = [0, 1, 2]
    parts = []
    for grids in split(planes.table.detach(), planes.resolutions):
        nodes = torch.linspace(-1, 1, grids.shape[1], dtype=torch.float64)
        for a, b in AXES:
            cube = torch.zeros(len(nodes), len(nodes), 3, dtype=torch.float64)
            cube[..., a], cube[..., b] = nodes[None, :], nodes[:, None]
            at = old.locate(_leave(chart, cube.view(-1, 3))).view(cube.shape)
            first, second = sorted((follows[a], follows[b]))
            grid = grids[AXES.index((first, second))]
            where = torch.stack([at[..., first], at[..., second]], -1)[None].to(grid)
            found = F.grid_sample(grid.permute(2, 0, 1)[None], where, align_corners=True, padding_mode="border")
            parts.append(found[0].permute(1, 2, 0).reshape(-1, grid.shape[2]))
    return torch.cat(parts)


def _leave(chart: Chart, cube: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N 3"]:
    """From the cube of a block's chart to the space."""
    middle, half = (chart.low + chart.high) / 2, (chart.high - chart.low) / 2
    return (cube * half + middle) @ chart.turn


def _understood(part: nn.Module) -> bool:
    """Whether all that a part has learnt lies in planes, linear maps and offsets."""
    place = {id(p) for module in part.modules() if isinstance(module, Planes) for p in module.parameters()}
    maps = {id(p) for module in part.modules() if isinstance(module, nn.Linear) for p in module.parameters()}
    return bool(place) and all(id(p) in place | maps or p.ndim == 1 for p in part.parameters())
