from dataclasses import replace

import pytest
import torch
from tiny_world import World, rays_of

from fprf.errors import WeightsError
from fprf.plugins.samplers.config import UniformConfig
from fprf.rendering.renderer import render_rays
from fprf.training.model import background_of, build_model
from fprf.types import Want


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


def test_penalties_come_from_every_part(world: World) -> None:
    model = build_model(world.config, world.prepared.facts)
    assert set(model.penalties()) == {"variation", "proposal_variation"}
    plain = build_model(replace(world.config, sampler=UniformConfig(samples=8)), replace(world.prepared.facts, dim=0))
    assert plain.semantic is None and set(plain.penalties()) == {"variation"}


def test_penalties_of_one_name_are_added_up(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    model = build_model(world.config, world.prepared.facts)
    assert model.semantic is not None
    before = {name: value.detach() for name, value in model.penalties().items()}
    monkeypatch.setattr(model.semantic, "penalties", lambda: {"variation": torch.tensor(2.0), "own": torch.tensor(5.0)})
    after = {name: value.detach() for name, value in model.penalties().items()}
    assert list(after) == ["variation", "proposal_variation", "own"] and float(after["own"]) == 5
    assert float(after["variation"]) == pytest.approx(float(before["variation"]) + 2)
    assert torch.equal(after["proposal_variation"], before["proposal_variation"])


def test_a_model_without_semantics_renders(world: World) -> None:
    model = build_model(world.config, replace(world.prepared.facts, dim=0))
    rays = rays_of(world, world.load(), world.prepared.manager.batch(0))
    out = render_rays(rays, model.parts, want=Want.COLOUR | Want.SEMANTIC, budget=0.0)
    assert out.semantic is None and out.rgb is not None and bool(out.rgb.isfinite().all())


def test_a_decoder_of_another_encoder_is_refused(world: World) -> None:
    with pytest.raises(WeightsError, match="fprf pretrain decoder"):
        build_model(world.config, replace(world.prepared.facts, content_encoder="somebody:else"))


def test_the_background(world: World) -> None:
    cpu = torch.device("cpu")
    assert background_of(world.prepared.facts, cpu) is None
    found = background_of(replace(world.prepared.facts, background=(0.0, 0.5, 1.0)), cpu)
    assert found is not None and found.tolist() == [0.0, 0.5, 1.0] and found.dtype == torch.float32
