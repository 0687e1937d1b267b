from dataclasses import replace

import pytest
import torch
from tiny_world import World

from fprf.errors import WeightsError
from fprf.training.model import build_model


def test_the_start_is_a_function_of_the_seed(world: World) -> None:
    facts = world.prepared.facts
    torch.manual_seed(1)
    first = build_model(world.config, facts).state_dict()
    torch.manual_seed(2)
    second = build_model(world.config, facts).state_dict()
    other = build_model(replace(world.config, seed=1), facts).state_dict()
    assert first.keys() == second.keys() == other.keys()
    assert all(torch.equal(first[name], second[name]) for name in first)
    moved = {name for name in first if not torch.equal(first[name], other[name])}
    assert moved == {name for name in first if not name.startswith("decoder.")} - {"field.offset"}, "that one starts at 0"


def test_the_parts_draw_independently(world: World) -> None:
    model = build_model(world.config, world.prepared.facts)
    tables = [value.flatten()[:8] for name, value in model.state_dict().items() if name.endswith("planes.table")]
    assert len(tables) == 3
    assert not any(torch.equal(a, b) for i, a in enumerate(tables) for b in tables[:i])


def test_all_but_the_decoder_learns(world: World) -> None:
    model = build_model(world.config, world.prepared.facts)
    frozen = {id(p) for p in model.decoder.parameters()}
    assert frozen and not any(p.requires_grad for p in model.decoder.parameters())
    assert {id(p) for p in model.learned()} == {id(p) for p in model.parameters()} - frozen


def test_a_decoder_of_another_encoder_is_refused(world: World) -> None:
    with pytest.raises(WeightsError, match="fprf pretrain decoder"):
        build_model(world.config, replace(world.prepared.facts, content_encoder="somebody:else"))
