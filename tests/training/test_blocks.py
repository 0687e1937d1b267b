"""Models of blocks for training, and finished blocks in files."""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch
from block_world import BlockWorld

from fprf.blocks.routing import chart_of, surroundings_of
from fprf.errors import CheckpointError, PluginError
from fprf.fields.config import PlanesConfig
from fprf.fields.fields import PlanesField
from fprf.training.blocks import (
    SURROUNDINGS,
    folder_of,
    inset,
    load_boxes,
    load_finished,
    read_done,
    restore,
    save_finished,
    surroundings,
)
from fprf.training.run import Run
from fprf.types import Boxes, FieldSample


@pytest.fixture
def parts(block_world: BlockWorld):  # type: ignore[no-untyped-def]
    run = Run(block_world.root)
    return run.load_config()[0], run.load_known().facts, load_boxes(block_world.root)


def test_folders(tmp_path: Path) -> None:
    assert folder_of(tmp_path, SURROUNDINGS) == tmp_path / "blocks/surroundings"
    assert [folder_of(tmp_path, b).name for b in (0, 7, 12, 123)] == ["00", "07", "12", "123"]


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


def test_the_surroundings_span_all_blocks_however_they_are_cut() -> None:
    eye = torch.eye(3, dtype=torch.float64)
    whole = Boxes(torch.tensor([[0.0, -1, 0]]).double(), torch.tensor([[4.0, 1, 2]]).double(), eye[None], 0.0)
    low = torch.tensor([[0.0, -1, 0], [2.0, -1, 0]]).double()
    high = torch.tensor([[2.0, 1, 2], [4.0, 1, 2]]).double()
    halves = Boxes(low, high, eye.expand(2, 3, 3), 0.25)
    one, two = surroundings_of(whole), surroundings_of(halves)
    assert torch.equal(one.low, two.low) and torch.equal(one.high, two.high)


def test_a_part_that_breaks_its_contract_is_told_before_a_block_is_trained(parts) -> None:  # type: ignore[no-untyped-def]
    """Each block is made of the same parts as the surroundings, which come first."""
    config, facts, boxes = parts
    wrong = replace(config, content=replace(config.content, field=Negative()))
    with pytest.raises(PluginError, match="test_blocks:Negative: density: expected numbers in"):
        surroundings(wrong, facts, boxes)


class Thin(PlanesField):
    """A field whose densities are below 0."""

    def density(self, points: torch.Tensor) -> FieldSample:
        sample = super().density(points)
        return sample._replace(density=-sample.density)


@dataclass(frozen=True, kw_only=True)
class Negative(PlanesConfig):
    """A stranger's field."""

    def build(self, *, channels: int, seed: int) -> Thin:
        return Thin(self, channels=channels, seed=seed)
