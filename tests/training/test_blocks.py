"""Models of blocks for training, and finished blocks in files."""

import json
from pathlib import Path

import pytest
import torch
from block_world import BlockWorld

from fprf.blocks.routing import chart_of
from fprf.errors import CheckpointError
from fprf.training.blocks import (
    inset,
    load_boxes,
    load_finished,
    read_done,
    restore,
    save_finished,
    surroundings,
)
from fprf.training.run import Run


@pytest.fixture
def parts(block_world: BlockWorld):  # type: ignore[no-untyped-def]
    run = Run(block_world.root)
    return run.load_config()[0], run.load_known().facts, load_boxes(block_world.root)


def test_finished_blocks_come_back_as_they_were(parts, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    config, facts, boxes = parts
    built = surroundings(config, facts, boxes)
    folder = tmp_path / "run/blocks/surroundings"
    folder.mkdir(parents=True)
    assert read_done(folder) is None
    save_finished(folder, built, asked={"task": "x"}, step=7, seconds=1.5)
    found = load_finished(folder)
    assert (found.step, found.seconds) == (7, 1.5)
    other = surroundings(config, facts, boxes)
    with torch.no_grad():
        for parameter in other.member.parameters():
            parameter.zero_()
    restore(other.member, "member", found.tensors)
    for name, tensor in built.member.state_dict().items():
        assert torch.equal(other.member.state_dict()[name], tensor)


def test_what_does_not_fit_is_named(parts) -> None:  # type: ignore[no-untyped-def]
    config, facts, boxes = parts
    member = surroundings(config, facts, boxes).member
    tensors = {f"member.{name}": t for name, t in member.state_dict().items()}
    first = next(iter(tensors))
    for wrong in (
        {k: v for k, v in tensors.items() if k != first},
        tensors | {first: tensors[first][:1]},
        tensors | {"member.more": torch.zeros(1)},
    ):
        with pytest.raises(CheckpointError, match="does not fit the config"):
            restore(member, "member", wrong)
    restore(member, "member", tensors | {"decoder.other": torch.zeros(1)})


def test_a_folder_of_another_format_is_not_finished(tmp_path: Path) -> None:
    (tmp_path / "done.json").write_text(json.dumps({"format": 9}))
    assert read_done(tmp_path) is None
    with pytest.raises(CheckpointError, match=r"not finished; go on with `fprf train .*config.json`"):
        load_finished(tmp_path)


def test_an_inset_block_shares_nothing_with_what_it_was_cut_from(parts) -> None:  # type: ignore[no-untyped-def]
    config, facts, boxes = parts
    around = surroundings(config, facts, boxes)
    before = {name: t.clone() for name, t in around.member.state_dict().items()}
    built = inset(config, facts, boxes, 1, around)
    learned = built.model.learned()
    assert {id(p) for p in built.member.parameters()} <= {id(p) for p in learned}
    assert not {id(p) for p in around.member.parameters()} & {id(p) for p in learned}
    assert not any(p.requires_grad for p in built.model.decoder.parameters())
    with torch.no_grad():
        for parameter in learned:
            parameter.add_(1)
    assert all(torch.equal(t, before[name]) for name, t in around.member.state_dict().items())
    assert torch.equal(built.member.chart.low, chart_of(boxes, 1).low)
