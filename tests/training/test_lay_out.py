"""What a scene of blocks writes down before its first step, and what makes a block another block."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from block_world import BlockWorld, small

from fprf.blocks.plan import boxes_from, boxes_to
from fprf.errors import CheckpointError
from fprf.training import tensorfiles
from fprf.training.block_plan import plan_scene
from fprf.training.blocks import FREE, SURROUNDINGS, asked_of, load_boxes
from fprf.training.run import Run


def asked(world: BlockWorld, block: int, **change: Any) -> str:
    """Digest of a block's task in a config with other fields."""
    config = replace(world.config, **change)
    scene, plan = plan_scene(config)
    name = "surroundings" if block == SURROUNDINGS else f"{block:02d}"
    rays = tensorfiles.read(world.root / "blocks" / name / "rays.safetensors")
    digest: str = asked_of(config, Run(world.root).load_known().facts, scene, plan.boxes, block, rays)["task"]
    return digest


def test_each_block_knows_its_views_and_tiles(block_world: BlockWorld) -> None:
    scene, plan = plan_scene(block_world.config)
    document = json.loads((block_world.root / "blocks.json").read_text())
    assert document["rays"] == plan.rays.tolist() and len(document["rays"]) == 3
    for block in range(3):
        rays = tensorfiles.read(block_world.root / f"blocks/{block:02d}/rays.safetensors")
        assert torch.equal(rays["views"], plan.views_of(block))
        counted = 0
        for view, seen in zip(rays["views"].tolist(), rays["seen"], strict=True):
            mask = plan.mask(block, view, (32, 24))
            at = int((plan.views == view).nonzero()[0, 0])
            assert torch.equal(seen.bool(), plan.seen[at, block])
            counted += int(mask.sum())
        assert counted == document["rays"][block]
    around = tensorfiles.read(block_world.root / "blocks/surroundings/rays.safetensors")
    assert torch.equal(around["views"], scene.train) and bool(around["seen"].bool().all())


def test_the_cut_comes_back_from_its_file(block_world: BlockWorld) -> None:
    _, plan = plan_scene(block_world.config)
    found = load_boxes(block_world.root)
    for mine, theirs in zip(found[:3], plan.boxes[:3], strict=True):
        assert torch.equal(torch.as_tensor(mine), torch.as_tensor(theirs))
    assert found.margin == plan.boxes.margin
    again = boxes_from(json.loads(json.dumps(boxes_to(found))))
    assert torch.equal(again.low, found.low) and torch.equal(again.turn, found.turn)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{}",
        '{"format": 2, "boxes": {}}',
        '{"format": 1, "boxes": {"low": [[0]], "high": [[1]], "turn": [], "margin": 0}}',
        "[]",
    ],
)
def test_a_cut_that_cannot_be_read_is_named(tmp_path: Path, text: str) -> None:
    (tmp_path / "blocks.json").write_text(text)
    with pytest.raises(CheckpointError, match=r"blocks\.json: cannot be read"):
        load_boxes(tmp_path)


@pytest.mark.parametrize("block", [SURROUNDINGS, 1])
def test_what_may_change_without_training_again(block_world: BlockWorld, block: int) -> None:
    was = asked(block_world, block)
    assert was == asked(block_world, block, steps=99, minutes=3.0, checkpoint_minutes=1.0, device="auto")
    assert was == asked(block_world, block, render=replace(block_world.config.render, chunk=7))
    assert set(FREE) <= set(vars(block_world.config))


@pytest.mark.parametrize("block", [SURROUNDINGS, 1])
def test_what_makes_it_another_task(block_world: BlockWorld, block: int) -> None:
    base = block_world.config
    digests = {
        asked(block_world, block),
        asked(block_world, block, seed=1),
        asked(block_world, block, optimizer=replace(base.optimizer, rate=1e-3)),
        asked(block_world, block, content=replace(base.content, moves_density=True)),
        asked(block_world, block, loss=replace(base.loss, rgb=2.0)),
    }
    assert len(digests) == 5


def test_small_configs_agree_with_their_flags(block_world: BlockWorld, tmp_path: Path) -> None:
    """The killed run of the fault tests must be the calm one."""
    from block_world import block_flags

    from fprf.cli.parsing import load_method, parse

    method, _ = load_method("fprf-lite")
    parsed = parse(method, block_flags(block_world.config.data, tmp_path), prog="x", description="")
    assert parsed == small(block_world.config.data, tmp_path)
