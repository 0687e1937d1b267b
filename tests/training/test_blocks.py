"""Scenes of blocks: what each learns from, what makes it another task, finished blocks in files and in
memory.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from parts_world import BlockWorld, done_of, small, world_of_blocks

from fprf.blocks.config import AdaptiveConfig
from fprf.blocks.fields import Member
from fprf.blocks.partition import make_plan
from fprf.errors import CheckpointError
from fprf.io import tensorfiles
from fprf.training.blocks import (
    RAYS,
    BlockCache,
    Built,
    block_task,
    folder_of,
    load_blocks,
    load_finished,
    restore,
    surroundings,
)
from fprf.training.driver import train
from fprf.training.field_scene import load_run
from fprf.training.prepare import read_scene
from fprf.training.run import Run
from fprf.training.tasks import WHOLE


def around_of(world: BlockWorld) -> Built:
    """The surroundings at their start."""
    return surroundings(world.config, Run(world.root).load_known().facts, load_blocks(world.root))


def test_finished_blocks_come_back_and_what_does_not_fit_is_refused(block_world: BlockWorld) -> None:
    member = around_of(block_world).member
    done, tensors = load_finished(folder_of(block_world.root, WHOLE))
    assert done.step == block_world.config.steps
    restore(member, "member", tensors)
    for name, tensor in member.state_dict().items():
        assert torch.equal(tensor, tensors[f"member.{name}"])
    first = next(name for name in tensors if name.startswith("member."))
    for wrong in (
        {name: tensor for name, tensor in tensors.items() if name != first},
        tensors | {first: tensors[first][:1]},
        tensors | {"member.more": torch.zeros(1)},
    ):
        with pytest.raises(CheckpointError):
            restore(member, "member", wrong)


def asked(world: BlockWorld, block: int, moved: str = "", **change: Any) -> str:
    """Digest of a block's task in a config with other fields, or with a field of the cameras moved."""
    config = replace(world.config, **change)
    scene = read_scene(config)
    rays = tensorfiles.read(folder_of(world.root, block) / RAYS)
    cameras = {moved: getattr(scene.cameras, moved) + 1} if moved else {}
    scene = replace(scene, cameras=replace(scene.cameras, **cameras))
    cells = make_plan(scene, config.blocks).cells
    facts = Run(world.root).load_known().facts
    digest: str = block_task(config, facts, scene, cells, block, rays)["task"]
    return digest


def test_what_makes_it_another_task_and_what_does_not(block_world: BlockWorld) -> None:
    base = block_world.config
    was = asked(block_world, 1)
    assert was == done_of(block_world.root, "01")["asked"]["task"]
    assert was == asked(block_world, 1, steps=99, minutes=3.0, checkpoint_minutes=1.0, device="auto")
    others: list[dict[str, Any]] = [
        {"seed": 1},
        {"optimizer": replace(base.optimizer, rate=1e-3)},
        {"content": replace(base.content, moves_density=True)},
        {"loss": replace(base.loss, rgb=2.0)},
    ]
    others += [{"moved": name} for name in ("pose", "focal", "centre", "size", "distortion", "lens")]
    assert len({was, *(asked(block_world, 1, **other) for other in others)}) == 11


def test_each_block_knows_its_views_and_tiles(block_world: BlockWorld) -> None:
    scene = read_scene(block_world.config)
    plan = make_plan(scene, block_world.config.blocks)
    assert len(load_blocks(block_world.root)) == 3
    for block in range(3):
        rays = tensorfiles.read(folder_of(block_world.root, block) / RAYS)
        assert torch.equal(rays["views"], plan.views_of(block))
        assert torch.equal(rays["seen"].bool(), plan.seen[torch.isin(plan.views, rays["views"]), block])
    around = tensorfiles.read(folder_of(block_world.root, WHOLE) / RAYS)
    assert torch.equal(around["views"], scene.train) and bool(around["seen"].bool().all())


def size_of(world: BlockWorld) -> int:
    """Bytes of one member."""
    return sum(t.numel() * 4 for t in around_of(world).member.state_dict().values())


def test_the_least_recently_used_goes_first(block_world: BlockWorld) -> None:
    room = 2
    around = around_of(block_world).member
    restore(around, "member", load_finished(folder_of(block_world.root, WHOLE))[1])
    limit = (room + 1) * size_of(block_world)
    shelf = BlockCache(
        block_world.root, load_blocks(block_world.root), around, device=torch.device("cpu"), limit=limit
    )
    kept: dict[int, Member] = {}
    for block in (0, 1, 0, 2, 1, 0, 0, 2, 1, 2):
        old = kept.pop(block, None)
        found = shelf.member(block)
        assert old is None or found is old, "what is at hand is not fetched again"
        kept[block] = found
        if len(kept) > room:
            kept.pop(next(iter(kept)))
        assert shelf.here == tuple(kept)


def test_pictures_do_not_depend_on_the_limit(block_world: BlockWorld) -> None:
    pictures = []
    for limit in (None, 1e-6, 2.5 * size_of(block_world) / (1 << 20)):
        trained = load_run(block_world.root, "cpu", limit)
        trained = replace(
            trained, config=replace(trained.config, render=replace(trained.config.render, chunk=400))
        )
        pictures.append(trained.render(trained.cameras, 0).rgb)
    assert torch.equal(pictures[0], pictures[1]) and torch.equal(pictures[0], pictures[2])


def test_another_cut_trains_only_the_blocks_that_it_concerns(block_world: BlockWorld, tmp_path: Path) -> None:
    """Halving the heaviest block leaves the others what they were, under whatever number."""
    coarse = AdaptiveConfig(rays=3700, smallest=2.0)
    fine = AdaptiveConfig(rays=3300, smallest=2.0)
    config = replace(small(block_world.config.data, tmp_path / "run"), blocks=coarse)
    root = tmp_path / "run"
    train(config, "fprf-lite", quiet=True)
    first = {folder.name: done_of(root, folder.name) for folder in (root / "blocks").iterdir()}
    train(replace(config, blocks=fine), "fprf-lite", quiet=True)
    second = {folder.name: done_of(root, folder.name) for folder in (root / "blocks").iterdir()}
    assert (len(first), len(second)) == (4, 5)
    # The surroundings, and the two blocks that were not split, which have other numbers now.
    assert len([one for one in second.values() if one in first.values()]) == 3
    assert first["01"] == second["02"]
    load_run(root, "cpu")


@pytest.mark.parametrize(
    "name, text",
    [
        ("done.json", "{"),
        ("done.json", '{"format": 1, "step": 6}'),
        ("done.json", None),
        ("block.safetensors", "x" * 40),
    ],
)
def test_damaged_blocks_are_refused(
    block_world: BlockWorld, tmp_path: Path, name: str, text: str | None
) -> None:
    root = world_of_blocks(block_world.config, block_world.root).copy(tmp_path)
    file = root / "blocks/surroundings" / name
    file.unlink()
    if text is not None:
        file.write_text(text)
    with pytest.raises(CheckpointError):
        load_run(root, "cpu")
