"""Costs of many blocks (time of a view, memory of a process), and jumps of colour across the borders of blocks."""

import json
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from fprf.blocks.partition import write_cells
from fprf.rendering.renderer import render_rays
from fprf.style.look import Restyle
from fprf.training.blocks import folder_of, load_blocks
from fprf.training.loading import Trained, load_run
from fprf.training.tasks import WHOLE
from fprf.training.views import render_view
from fprf.types import Cell, Want

_PART = """
import json, sys
from pathlib import Path
sys.path.insert(0, {here!r})
from benchmarks.blocks import peak_mib, seconds_of
row = seconds_of(Path({root!r}), {limit!r}, {views!r})
print(json.dumps(row | {{"peak_rss_mib": peak_mib()}}))
"""

Row = dict[str, float | int | str]


def row_of(source: Path, target: Path, count: int) -> None:
    """A run folder of `count` blocks in a row, from one whose blocks are a row along axis 0."""
    cells = load_blocks(source)
    order = sorted(range(len(cells)), key=lambda block: float(cells[block].low[0]))
    total = float(max(cell.high[0] for cell in cells) - min(cell.low[0] for cell in cells))
    shutil.rmtree(target, ignore_errors=True)
    for name in ("config.json", "scene.json", "basis.safetensors", "style.safetensors"):
        target.mkdir(parents=True, exist_ok=True)
        shutil.copy(source / name, target / name)
    _copy(source, WHOLE, target, WHOLE)
    row = []
    for number in range(count):
        block, lap = order[number % len(order)], number // len(order)
        shift = torch.tensor([lap * total, 0.0, 0.0], dtype=torch.float64)
        row.append(replace(cells[block], low=cells[block].low + shift, high=cells[block].high + shift))
        _copy(source, block, target, number)
    write_cells(target / "blocks.json", row)


def _copy(source: Path, block: int, target: Path, number: int) -> None:
    folder = folder_of(target, number)
    folder.mkdir(parents=True)
    for name in ("block.safetensors", "done.json"):
        (folder / name).hardlink_to(folder_of(source, block) / name)


def seconds_of(root: Path, limit: float | None, views: list[int]) -> Row:
    """Seconds a view (the second time that it is rendered, blocks at hand as far as the limit allows), and blocks met."""
    trained = load_run(root, "cpu", limit)
    shelf = trained.model.field.members  # type: ignore[union-attr]
    times, first = [], []
    for view in views:
        for kept in (first, times):
            start = time.perf_counter()
            render_view(trained.model, trained.known.facts, trained.known.cameras, view, trained.config.render)
            kept.append(time.perf_counter() - start)
    return {
        "seconds_per_view": statistics.median(times),
        "seconds_of_first": statistics.median(first),
        "blocks_in_memory": len(shelf.here),
    }


def peak_mib() -> float:
    """Most memory that this program has held; `ru_maxrss` would also count what the process that started it held."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) / 1024
    raise RuntimeError("/proc/self/status has no VmHWM; memory is measured on Linux alone")


def apart(root: Path, limit: float | None, views: list[int]) -> Row:
    """`seconds_of` in a process of its own, with the memory that it took at most."""
    script = _PART.format(here=str(Path(__file__).parent), root=str(root), limit=limit, views=views)
    done = subprocess.run([sys.executable, "-c", script], check=True, capture_output=True, text=True)
    row: Row = json.loads(done.stdout.splitlines()[-1])
    return row


def middle_views(root: Path, count: int, blocks: int) -> list[int]:
    """Views whose cameras stand in the first `blocks` blocks of the row, spread evenly."""
    trained = load_run(root, "cpu")
    space = trained.model.space
    cells = sorted(load_blocks(root), key=lambda cell: float(cell.low[0]))[:blocks]
    low, high = cells[0].low[0], max(cell.high[0] for cell in cells)
    position = trained.known.cameras.pose[:, :, 3] - torch.tensor(space.centre, dtype=torch.float64)
    x = (position @ torch.tensor(space.rotation, dtype=torch.float64).T * space.scale)[:, 0]
    inside = ((x >= low) & (x <= high)).nonzero()[:, 0].tolist()
    return inside[:: max(1, len(inside) // count)][:count]


def costs(source: Path, scratch: Path, counts: tuple[int, ...], views: int, cache_blocks: int) -> dict[str, list[Row]]:
    """Time with each number of blocks, all in memory; memory with 2 blocks and with all, room for `cache_blocks`."""
    size = (source / "blocks/00/block.safetensors").stat().st_size / 2**20
    chosen = middle_views(source, views, 2)
    timed, memory = [], []
    for count in counts:
        row_of(source, scratch / f"row{count}", count)
        timed.append({"blocks": count} | apart(scratch / f"row{count}", None, chosen))
    total = len(load_blocks(source))
    for count in (2, total):
        row_of(source, scratch / f"row{count}", count)
        limit = (cache_blocks + 1) * size
        every = middle_views(source, 2 * count, count)
        memory.append({"blocks": count, "limit_mib": limit} | apart(scratch / f"row{count}", limit, every))
    for count in {*counts, 2, total}:
        shutil.rmtree(scratch / f"row{count}", ignore_errors=True)
    return {"render": timed, "memory": memory}


APART = 1e-3
"""World units between the two rays of a pair."""


class Border(NamedTuple):
    """A face that two blocks share."""

    block: int
    axis: int
    middle: Tensor
    """[3] of the face, in the space."""


def borders(cells: Sequence[Cell]) -> list[Border]:
    """High faces along axes 0 and 1 of each block behind which another one begins."""
    found = []
    for block, cell in enumerate(cells):
        for axis in (0, 1):
            middle = (cell.low + cell.high) / 2
            middle[axis] = cell.high[axis]
            beyond = middle.clone()
            beyond[axis] += 1e-6
            if any(other is not cell and bool(other.holds(beyond[None])) for other in cells):
                found.append(Border(block, axis, middle))
    return found


def _pairs(trained: Trained, cells: Sequence[Cell], border: Border, shift: float, count: int) -> tuple[Tensor, Tensor, Tensor]:
    """Origins on either side and directions, in the space: heights of cameras, level to a little up and down."""
    draw = torch.Generator().manual_seed(17 * border.block + border.axis)
    axes, unit = torch.eye(3, dtype=torch.float64), 1 / trained.model.space.scale
    normal, along, up = axes[border.axis], axes[1 - border.axis], axes[2]
    cell = cells[border.block]
    half = (cell.high - cell.low)[1 - border.axis] / 2
    space = trained.model.space
    pose = trained.known.cameras.pose[:, :, 3] - torch.tensor(space.centre, dtype=torch.float64)
    heights = (pose @ torch.tensor(space.rotation, dtype=torch.float64).T * space.scale)[:, 2]
    height = heights[torch.randint(len(heights), (count,), generator=draw)]
    across = (torch.rand(count, generator=draw).double() - 0.5) * half
    angle = (torch.rand(count, generator=draw).double() - 0.4) * 0.8
    sign = torch.where(torch.rand(count, generator=draw) < 0.5, 1.0, -1.0).double()
    direction = (sign * angle.cos())[:, None] * along + angle.sin()[:, None] * up
    start = border.middle + (shift - 0) * normal + across[:, None] * along
    start = start - (start @ up)[:, None] * up + height[:, None] * up
    step = APART / unit / 2 * normal
    return start - step, start + step, direction


def _seen(trained: Trained, origin: Tensor, direction: Tensor, restyle: Restyle | None) -> tuple[Tensor, Tensor]:
    space = trained.model.space
    world = origin / space.scale @ torch.tensor(space.rotation, dtype=torch.float64)
    world = world + torch.tensor(space.centre, dtype=torch.float64)
    rays = space.rays(world, direction @ torch.tensor(space.rotation, dtype=torch.float64))
    with torch.inference_mode():
        out = render_rays(rays, trained.model.parts, want=Want.COLOUR, budget=trained.config.render.budget, restyle=restyle)
    assert out.rgb is not None
    return out.rgb, out.depth / space.scale


def jumps(trained: Trained, cells: Sequence[Cell], restyle: Restyle, *, count: int, say: Callable[[str], None]) -> list[Row]:
    """One row a border: mean differences of colour, depth and stylised colour of the pairs, there and inside its block."""
    rows: list[Row] = []
    for border in borders(cells):
        row: Row = {"block": border.block, "axis": border.axis, "pairs": count}
        extent = float((cells[border.block].high - cells[border.block].low)[border.axis])
        for place, shift in (("border", 0.0), ("inside", -extent / 2)):
            first, second, direction = _pairs(trained, cells, border, shift, count)
            for look, restyle_or_none in (("", None), ("styled_", restyle)):
                a, b = (_seen(trained, origin, direction, restyle_or_none) for origin in (first, second))
                row[f"{look}colour_{place}"] = float((a[0] - b[0]).abs().mean())
                if not look:
                    # Relative, since a ray that ends in the wood is not as certain as one that ends on a wall.
                    row[f"depth_{place}"] = float(((a[1] - b[1]).abs() / (0.5 * (a[1] + b[1]))).mean())
        rows.append(row)
        say(f"border of block {border.block}: {row}")
    return rows


def ratios(rows: list[Row]) -> dict[str, float]:
    """Mean jump at borders over the mean jump inside blocks, and that of the worst border."""
    found = {}
    for kind in ("colour", "depth", "styled_colour"):
        at = torch.tensor([float(row[f"{kind}_border"]) for row in rows])
        inside = torch.tensor([float(row[f"{kind}_inside"]) for row in rows]).mean()
        found[f"{kind}_mean_ratio"] = float(at.mean() / inside)
        found[f"{kind}_worst_ratio"] = float(at.max() / inside)
        found[f"{kind}_inside"] = float(inside)
    return found
