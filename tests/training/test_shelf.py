"""Blocks on a shelf: fetched when points meet them, the least recently used put back, nothing changed by it."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from block_world import BlockWorld

from fprf.blocks.routing import chart_of
from fprf.errors import CheckpointError
from fprf.training.blocks import SURROUNDINGS, folder_of, load_boxes, load_finished, restore, surroundings
from fprf.training.loading import Shelf, load_run
from fprf.training.run import Run
from fprf.training.views import render_view

_MIB = 1 << 20


def shelf_of(root: Path, limit: int | None, told: list[int] | None = None) -> Shelf:
    run = Run(root)
    config, _ = run.load_config()
    boxes = load_boxes(root)
    around = surroundings(config, run.load_known().facts, boxes).member
    restore(around, "member", load_finished(folder_of(root, SURROUNDINGS)).tensors)
    note = (lambda block: None) if told is None else told.append
    return Shelf(root, boxes, around, device=torch.device("cpu"), limit=limit, told=note)


def size_of(root: Path) -> int:
    """Bytes of one member."""
    return sum(t.numel() * 4 for t in shelf_of(root, None).held[0].state_dict().values())


@pytest.mark.parametrize("room", [1, 2, 3])
def test_the_least_recently_used_goes_first(block_world: BlockWorld, room: int) -> None:
    told: list[int] = []
    shelf = shelf_of(block_world.root, (room + 1) * size_of(block_world.root), told)
    kept: list[int] = []
    fetched = []
    for block in (0, 1, 0, 2, 1, 0, 0, 2, 1, 2):
        if block in kept:
            kept.remove(block)
        else:
            fetched.append(block)
        kept = [*kept, block][-room:]
        shelf.member(block)
        assert list(shelf.here) == kept
    assert told == fetched


def test_one_block_stays_however_small_the_limit_is(block_world: BlockWorld) -> None:
    shelf = shelf_of(block_world.root, 1)
    for block in (0, 1, 2):
        assert not next(iter(shelf.member(block).parameters())).requires_grad
        assert shelf.here == (block,)


def test_members_are_the_finished_blocks_in_their_own_charts(block_world: BlockWorld) -> None:
    shelf = shelf_of(block_world.root, 1)
    boxes = load_boxes(block_world.root)
    for block in (2, 0, 1, 0):
        member = shelf.member(block)
        saved = load_finished(folder_of(block_world.root, block)).tensors
        for name, tensor in member.state_dict().items():
            assert torch.equal(tensor, saved[f"member.{name}"])
        chart = chart_of(boxes, block)
        assert torch.equal(member.chart.low, chart.low) and not member.chart.contracted
    assert shelf.member(3) is shelf.held[0]


def test_pictures_do_not_depend_on_the_limit(block_world: BlockWorld) -> None:
    pictures = []
    for limit in (None, 1e-6, 2.5 * size_of(block_world.root) / _MIB):
        trained = load_run(block_world.root, "cpu", limit)
        config = replace(trained.config.render, chunk=100)
        pictures.append(render_view(trained.model, trained.known.facts, trained.known.cameras, 0, config).rgb)
    assert torch.equal(pictures[0], pictures[1]) and torch.equal(pictures[0], pictures[2])


def test_a_damaged_block_is_found_when_it_is_first_met(block_world: BlockWorld, tmp_path: Path) -> None:
    root = tmp_path / "run"
    shutil.copytree(block_world.root, root)
    file = root / "blocks/01/block.safetensors"
    data = bytearray(file.read_bytes())
    data[-5] ^= 1
    file.write_bytes(bytes(data))
    shelf = shelf_of(root, None)
    shelf.member(0)
    with pytest.raises(CheckpointError, match="is damaged"):
        shelf.member(1)
