"""What many blocks cost: time of a view and memory of a process, with rows of blocks of one size.

A row of N blocks repeats those of a trained street: the first ones where N is smaller, all over again where it is larger. So
each block shows something, and views look at the same few blocks however long the row is.
"""

import json
import shutil
import statistics
import subprocess
import sys
import time
from pathlib import Path

import torch

from fprf.blocks.plan import boxes_to
from fprf.io.atomic import write_json
from fprf.training.blocks import SURROUNDINGS, folder_of
from fprf.training.lay_out import load_boxes
from fprf.training.loading import load_run
from fprf.training.views import render_view
from fprf.types import Boxes

Row = dict[str, float | int]
_PART = """
import json, sys
from pathlib import Path
sys.path.insert(0, {here!r})
from blocks_cost import peak_mib, seconds_of
row = seconds_of(Path({root!r}), {limit!r}, {views!r})
print(json.dumps(row | {{"peak_rss_mib": peak_mib()}}))
"""


def row_of(source: Path, target: Path, count: int) -> None:
    """A run folder of `count` blocks in a row, from one whose blocks are a row along axis 0."""
    boxes = load_boxes(source)
    order = boxes.low[:, 0].argsort().tolist()
    total = float(boxes.high[:, 0].amax() - boxes.low[:, 0].amin())
    shutil.rmtree(target, ignore_errors=True)
    for name in ("config.json", "scene.json", "basis.safetensors", "style.safetensors"):
        target.mkdir(parents=True, exist_ok=True)
        shutil.copy(source / name, target / name)
    _copy(source, SURROUNDINGS, target, SURROUNDINGS)
    lows, highs, turns = [], [], []
    for number in range(count):
        block, lap = order[number % len(order)], number // len(order)
        shift = torch.tensor([lap * total, 0.0, 0.0], dtype=torch.float64) @ boxes.turn[block].T
        lows.append(boxes.low[block] + shift)
        highs.append(boxes.high[block] + shift)
        turns.append(boxes.turn[block])
        _copy(source, block, target, number)
    row = Boxes(torch.stack(lows), torch.stack(highs), torch.stack(turns), boxes.margin)
    write_json(target / "blocks.json", {"format": 1, "boxes": boxes_to(row), "rays": [], "views": []})


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
    boxes, space = load_boxes(root), trained.model.space
    order = boxes.low[:, 0].argsort().tolist()[:blocks]
    low, high = boxes.low[order, 0].amin(), boxes.high[order, 0].amax()
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
    total = len(load_boxes(source).low)
    for count in (2, total):
        row_of(source, scratch / f"row{count}", count)
        limit = (cache_blocks + 1) * size
        every = middle_views(source, 2 * count, count)
        memory.append({"blocks": count, "limit_mib": limit} | apart(scratch / f"row{count}", limit, every))
    for count in {*counts, 2, total}:
        shutil.rmtree(scratch / f"row{count}", ignore_errors=True)
    return {"render": timed, "memory": memory}
