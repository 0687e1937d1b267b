"""What tiles of an image show: the compiled search and sort against each Gaussian and pixel in float64."""

import numba
import numpy as np
import pytest
import torch
from test_rasterise import camera, cloud

from fprf.ops.rasterise import MIN_ALPHA
from fprf.ops.rasterise import rendering as rasterise
from fprf.ops.rasterise.tile_kernels import SIDE, SLOTS, Tiles, tiles_of

_BLUR_ROUNDING = 1e-3
"""log2 alpha by which a pixel may miss MIN_ALPHA unseen: polynomials of some hundred pixels in float32, whose terms
reach 2^7, err by 2^7 eps times some operations.
"""


def seen(count: int, size: float, width: int = 150, height: int = 100) -> Tiles:
    """A cloud in memory as `see` leaves it, a third of it far larger."""
    given = cloud(count, bands=1, size=size)
    given[2][::3] += 1.5
    view = rasterise._view(*given[:5], camera(width, height), False)
    found: Tiles = view.tiles
    return found


def slow_order(tiles: Tiles) -> list[list[int]]:
    """Slots of each tile by depth, then by Gaussian."""
    drawn = np.diff(tiles.first_slot[: tiles.total + 1]) > 0
    depth = tiles.splats.reshape(-1, SLOTS)[:, 9].view(np.int32)[: tiles.total].astype(np.int64)
    span = int(np.ptp(depth[drawn]))
    depth = (depth - depth[drawn].min()) >> max(0, span.bit_length() - 22)
    of_slot = np.repeat(np.arange(tiles.total), np.diff(tiles.first_slot[: tiles.total + 1]))
    lists = []
    for tile in range(len(tiles.start) - 1):
        slots = np.sort(tiles.slots[tiles.start[tile] : tiles.start[tile + 1]])
        order = np.lexsort((of_slot[slots], depth[of_slot[slots]]))
        lists.append(slots[order].tolist())
    return lists


@pytest.mark.parametrize(("count", "size"), [(1, -1.5), (700, -3.0), (20_000, -3.5)])
def test_each_tile_has_its_entries_by_depth(count: int, size: float) -> None:
    tiles = seen(count, size)
    assert sorted(tiles.slots.tolist()) == list(range(tiles.first_slot[tiles.total]))
    assert (tiles.first_slot[tiles.ids] <= tiles.slots).all()
    assert (tiles.slots < tiles.first_slot[tiles.ids + 1]).all()
    for tile, wanted in enumerate(slow_order(tiles)):
        assert tiles.slots[tiles.start[tile] : tiles.start[tile + 1]].tolist() == wanted
    assert int(tiles.skipped.sum()) + int((np.diff(tiles.first_slot[: count + 1]) > 0).sum()) == count


def test_each_pixel_that_a_gaussian_reaches_is_in_a_block_of_an_entry() -> None:
    tiles = seen(700, -3.0)
    across = -(-tiles.width // SIDE)
    listed = np.zeros((tiles.total, -(-tiles.height // SIDE) * 4, across * 4), bool)
    for tile in range(len(tiles.start) - 1):
        for entry in range(tiles.start[tile], tiles.start[tile + 1]):
            bits = (int(tiles.blocks[entry]) >> np.arange(16) & 1).reshape(4, 4).astype(bool)
            y = 4 * (tile // across)
            x = 4 * (tile % across)
            listed[tiles.ids[entry], y : y + 4, x : x + 4] |= bits
    reached = 0
    rows = tiles.splats.reshape(-1, SLOTS)[: tiles.total].astype(np.float64)
    y, x = np.mgrid[: tiles.height, : tiles.width] + 0.5
    for i, (px, py, a, b, c, d, *_) in enumerate(rows):
        if not rows[i, 10] > 0:
            continue
        dx = x - px
        dy = y - py
        shows = a * dx * dx + b * dx * dy + c * dy * dy + d > np.log2(MIN_ALPHA) + _BLUR_ROUNDING
        reached += int(shows.sum())
        by_block = listed[i].repeat(4, 0).repeat(4, 1)[: tiles.height, : tiles.width]
        assert not (shows & ~by_block).any()
    assert reached > 10_000


def test_neither_threads_nor_room_change_what_tiles_show(monkeypatch: pytest.MonkeyPatch) -> None:
    """Parts of the Gaussians depend on threads, and the first of them needs more room than there is."""
    few = seen(40_000, -3.5)
    splats = few.splats.copy()
    rows = splats.reshape(-1, SLOTS)
    order = np.argsort(-rows[: few.total, 10], kind="stable")
    rows[: few.total] = rows[order]
    found = []
    for threads in (1, 4):
        monkeypatch.setattr(numba, "get_num_threads", lambda threads=threads: threads)
        found.append(tiles_of(splats, few.total, few.width, few.height))
    entries = np.diff(found[0].first_slot[: few.total + 1])
    assert entries[: few.total // 4].mean() > 4 + 1024 / (few.total // 4), "too small to run out of room"
    for one, other in zip(*found, strict=True):
        assert np.array_equal(one, other)


def test_nothing_has_no_entries() -> None:
    tiles = tiles_of(np.zeros(0, np.float32), 0, 40, 30)
    assert not len(tiles.ids) and not tiles.start.any() and not tiles.first_slot.any()
    assert torch.equal(
        rasterise.rasterise(*cloud(0)[:5], camera()).opacity, torch.zeros(30, 40, dtype=torch.float32)
    )
