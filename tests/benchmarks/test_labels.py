from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tiny_world import World, rays_of
from torch.autograd.profiler import profile

from benchmarks.profiling import PREFIX, REST, Range, attribute, exclusive, labelled
from fprf.rendering.renderer import render_rays
from fprf.types import Want


@dataclass
class Node:
    """A tree of calls, as ranges lie in one another."""

    name: str
    own: float
    inner: list["Node"] = field(default_factory=list)


TREES = st.recursive(
    st.builds(Node, st.sampled_from("abc"), st.floats(0.5, 9)),
    lambda inner: st.builds(Node, st.sampled_from("abc"), st.floats(0.5, 9), st.lists(inner, max_size=3)),
    max_leaves=9,
)


def lay(node: Node, start: float, ranges: list[Range], own: dict[str, float]) -> float:
    """Own time before each inner call and after the last; the answer is the end."""
    pieces = len(node.inner) + 1
    at = start
    for inner in node.inner:
        at = lay(inner, at + node.own / pieces, ranges, own)
    end = at + node.own / pieces
    ranges.append(Range(node.name, start, end))
    own[node.name] = own.get(node.name, 0.0) + node.own
    return end


@given(st.lists(TREES, max_size=3))
def test_each_range_keeps_what_none_within_it_takes(trees: list[Node]) -> None:
    ranges: list[Range] = []
    own: dict[str, float] = {}
    at = 0.0
    for tree in trees:
        at = lay(tree, at + 1, ranges, own)
    assert exclusive(ranges) == pytest.approx(own)


def event(name: str, start: float, end: float, number: int = -1, scope: int = 0) -> Any:
    return SimpleNamespace(name=name, sequence_nr=number, scope=scope, time_range=SimpleNamespace(start=start, end=end))


def test_backward_goes_to_the_innermost_part_of_the_operation_that_last_showed_its_number() -> None:
    ranges = [Range("outer", 0, 10), Range("inner", 4, 6), Range("later", 10, 20)]
    node = "autograd::engine::evaluate_function: "
    events = [
        event("without gradient", 1, 2, 0),
        event("mm", 5, 6, 0),
        event("relu", 8, 9, 1),
        event(node + "Relu", 30, 31, 1),
        event("Relu", 30, 31, 1, scope=1),
        event(node + "Mm", 31, 34, 0),
        event("mm inside", 32, 33, -1),
        event(node + "AccumulateGrad", 35, 36),
        event(node + "Unknown", 36, 38, 77),
    ]
    assert attribute(events, ranges) == {"outer": 1, "inner": 3, REST: 3}


def test_a_model_carries_names_for_a_while_and_computes_the_same(world: World) -> None:
    trained = world.load()
    batch = world.prepared.manager.batch(0)
    rays = rays_of(world, trained, batch)

    def render() -> torch.Tensor:
        out = render_rays(rays, trained.model.parts, want=Want.COLOUR | Want.SEMANTIC, budget=0.0)
        assert out.rgb is not None and out.semantic is not None
        return torch.cat([out.rgb, out.semantic], -1)

    with torch.no_grad():
        before = render()
        with profile() as recorder, labelled(trained.model):
            assert torch.equal(render(), before)
    seen = {e.name for e in recorder.function_events or () if e.name.startswith(PREFIX)}
    assert seen == {PREFIX + part for part in ("sampler", "density", "content", "semantic", "decoder")}
    for module in trained.model.modules():
        assert not {"forward", "density", "content", "restyled", "penalties"} & vars(module).keys()
