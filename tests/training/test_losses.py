"""Terms of the training loss: their values, whom they move, those of packages, depths and sky."""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from pretend_cuda import CUDA, pretend_cuda
from tiny_world import World, rays_of, trained_for
from torch import Tensor

from fprf.config import LossConfig
from fprf.errors import ConfigError, PluginError
from fprf.interfaces import LossTerm
from fprf.plugins.losses.config import LossTermConfig
from fprf.rendering.renderer import Parts, render_rays
from fprf.training.losses import SHELL, check_penalties, emptiness, ending, extra_term, terms, total, wanted
from fprf.training.model import Model, build_model
from fprf.types import Batch, Rendered, Want

ZERO: dict[str, float] = {
    "rgb": 0.0,
    "content": 0.0,
    "semantic": 0.0,
    "variation": 0.0,
    "proposal_variation": 0.0,
    "interlevel": 0.0,
    "distortion": 0.0,
}


def only(**weights: float) -> LossConfig:
    return LossConfig(**{**ZERO, **weights})  # type: ignore[arg-type]


def rendered(world: World, model: Model, batch: Batch, config: LossConfig, *, content_moves_density: bool = False) -> Rendered:
    return render_rays(
        rays_of(world, world.load(), batch),
        model.parts,
        want=wanted(config, batch),
        budget=0.0,
        step=0,
        semantic_rays=len(batch.semantic) if batch.semantic is not None else None,
        semantic_samples=2,
        content_moves_density=content_moves_density,
    )


def test_each_term_is_what_it_says(world: World) -> None:
    model, batch, facts = world.load().model, world.prepared.manager.batch(0), world.prepared.facts
    config = LossConfig()
    out = rendered(world, model, batch, config)
    found = terms(config, facts, out, batch, model, step=0)
    assert set(found) == set(ZERO)
    assert out.rgb is not None and out.content is not None and out.semantic is not None
    assert batch.content is not None and batch.semantic is not None
    oracle = (out.rgb.double() - batch.rgb.double()).square().mean()
    assert float(found["rgb"]) == pytest.approx(float(oracle), rel=1e-5)
    oracle = (out.content.double() - batch.content.double()).square().mean() / facts.content_scale**2
    assert float(found["content"]) == pytest.approx(float(oracle), rel=1e-5)
    oracle = (out.semantic.double() - batch.semantic.double()).abs().mean() / facts.semantic_scale
    assert float(found["semantic"]) == pytest.approx(float(oracle), rel=1e-5)


def test_penalties_come_when_they_are_due_and_weigh_as_many_times_more(world: World) -> None:
    model, batch = world.load().model, world.prepared.manager.batch(0)
    config = replace(LossConfig(), penalty_every=4)
    out = rendered(world, model, batch, config)
    due = [step for step in range(9) if "variation" in terms(config, world.prepared.facts, out, batch, model, step=step)]
    assert due == [0, 4, 8]
    parts = {"variation": torch.tensor(2.0), "proposal_variation": torch.tensor(3.0)}
    assert float(total(config, parts)) == pytest.approx(4 * (2 * config.variation + 3 * config.proposal_variation))


def test_a_penalty_of_any_name_counts(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """At the weight that the plug-in states, unless a weight is named."""
    model, batch = world.load().model, world.prepared.manager.batch(0)
    monkeypatch.setattr(model.field, "penalties", lambda: {"entropy": torch.tensor(3.0)})
    for penalties, weight in (((), 1.0), ((("entropy", 0.5),), 0.5), ((("entropy", 0.0),), 0.0)):
        config = replace(only(rgb=1.0), penalties=penalties, penalty_every=4)
        check_penalties(config, model)
        out = rendered(world, model, batch, config)
        found = terms(config, world.prepared.facts, out, batch, model, step=4)
        assert set(found) == {"rgb", *(["entropy"] if weight else [])}
        assert float(total(config, found)) == pytest.approx(float(found["rgb"]) + 4 * weight * 3, rel=1e-6)
        assert set(terms(config, world.prepared.facts, out, batch, model, step=3)) == {"rgb"}
    with pytest.raises(ConfigError, match=r"no part of this model has a penalty 'entrpy'; did you mean 'entropy'\?") as caught:
        check_penalties(LossConfig(penalties=(("entrpy", 1.0),)), model)
    assert "(penalties that can be named: entropy)" in str(caught.value)


def test_a_penalty_that_is_called_like_a_term_is_refused(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    model = world.load().model
    monkeypatch.setattr(model.field, "penalties", lambda: {"content": torch.tensor(3.0)})
    with pytest.raises(PluginError, match="is called 'content'"):
        check_penalties(LossConfig(), model)


class Weights(LossTerm):
    """Mean square of the weights, times noise."""

    def __init__(self, wrong: str = "") -> None:
        self.wrong = wrong

    @property
    def needs(self) -> Want:
        return Want.SEMANTIC

    def __call__(
        self, rendered: Rendered, batch: Batch, parts: Parts, *, step: int, generator: torch.Generator | None
    ) -> torch.Tensor:
        assert rendered.semantic is not None and rendered.weights is not None and parts.space is not None and step >= 0
        value = rendered.weights.square().mean() * (1 if generator is None else torch.rand((), generator=generator))
        wrong = {"type": 3.0, "shape": value[None], "dtype": value.double(), "device": value.to("meta")}
        return wrong.get(self.wrong, value)  # type: ignore[return-value]


@dataclass(frozen=True, kw_only=True)
class WeightsConfig(LossTermConfig):
    wrong: str = ""

    def build(self) -> LossTerm:
        return Weights(self.wrong)


def test_a_term_of_a_package_counts(world: World) -> None:
    model, batch = build_model(world.config, world.prepared.facts), world.prepared.manager.batch(0)
    config = replace(only(rgb=1.0), extra=WeightsConfig(weight=0.5))
    extra = extra_term(config)
    assert extra is not None and wanted(config, batch, extra) == Want.DENSITY | Want.COLOUR | Want.SEMANTIC
    out = render_rays(rays_of(world, world.load(), batch), model.parts, want=wanted(config, batch, extra), budget=0.0, step=0)
    found = terms(config, world.prepared.facts, out, batch, model, step=7, extra=extra)
    assert out.weights is not None and set(found) == {"rgb", "extra"}
    assert float(found["extra"].detach()) == pytest.approx(float(out.weights.detach().square().mean()))
    summed = float(found["rgb"].detach()) + 0.5 * float(found["extra"].detach())
    assert float(total(config, found).detach()) == pytest.approx(summed)
    total(config, found).backward()  # type: ignore[no-untyped-call]
    assert extra_term(replace(config, extra=WeightsConfig(weight=0.0))) is None
    for wrong in ("type", "shape", "dtype", "device"):
        bad = replace(config, extra=WeightsConfig(wrong=wrong))
        with pytest.raises(PluginError, match=r"WeightsConfig: the term: expected float32 \[\] on cpu, found"):
            terms(bad, world.prepared.facts, out, batch, model, step=0, extra=extra_term(bad))


@pytest.mark.parametrize("name", ["semantic", "content"])
def test_features_never_move_density(world: World, name: str) -> None:
    """Paper: semantics are rendered with detached weights; a method may ask so for content too."""
    model = build_model(world.config, world.prepared.facts)
    batch, config = world.prepared.manager.batch(0), only(**{name: 1.0})
    parts = terms(config, world.prepared.facts, rendered(world, model, batch, config), batch, model, step=0)
    assert set(parts) == {name}
    total(config, parts).backward()  # type: ignore[no-untyped-call]
    moved = {n for n, p in model.named_parameters() if p.grad is not None and bool((p.grad != 0).any())}
    assert moved and not any(n.startswith(("sampler.", "decoder.")) or "density" in n for n in moved), moved
    if name == "semantic":
        assert all(n.startswith("semantic.") for n in moved), moved


NAN = float("nan")
EDGES = torch.linspace(0.0, 10.0, 101)


def straight_rays(count: int) -> Tensor:
    return EDGES.expand(count, -1)


def spike(*at: float) -> Tensor:
    """All weight of each ray in the interval around a distance."""
    weights = torch.zeros(len(at), 100)
    for row, t in enumerate(at):
        weights[row, int(t * 10)] = 1.0
    return weights


def test_a_ray_that_ends_at_its_point_costs_nothing() -> None:
    found = ending(straight_rays(3), spike(3.0, 5.0, 9.5), torch.tensor([3.0, 5.0, 9.5]))
    assert found is not None and float(found) == 0.0


def test_before_the_point_costs_two_behind_it_one() -> None:
    before, behind = (ending(straight_rays(1), spike(t), torch.tensor([5.0])) for t in (3.0, 8.0))
    assert before is not None and behind is not None
    assert float(before) == 2.0 and float(behind) == 1.0


@settings(deadline=None)
@given(st.lists(st.floats(0.5, 9.5) | st.just(float("nan")), min_size=1, max_size=6), st.integers(0, 1000))
def test_only_known_rays_count_and_the_mean_is_theirs(distances: list[float], seed: int) -> None:
    count = len(distances)
    weights = torch.rand(count, 100, generator=torch.Generator().manual_seed(seed))
    weights = weights / weights.sum(1, keepdim=True)
    distance = torch.tensor(distances)
    found = ending(straight_rays(count), weights, distance)
    each = [
        float(one)
        for k in range(count)
        if (one := ending(straight_rays(1), weights[k : k + 1], distance[k : k + 1])) is not None
    ]
    if not each:
        assert found is None
        return
    assert found is not None and 0 <= float(found) <= 2
    torch.testing.assert_close(found, torch.tensor(each).mean(), atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("found", [3.0, 5.0, 8.0])
def test_in_device_coordinates_it_is_about_depths_too(found: float) -> None:
    """Straight ahead of a near plane at 1, depth z has the ray parameter 1 - 1/z."""
    depths, end = straight_rays(1)[:, 10:], torch.tensor([5.0])
    weights = spike(found)[:, 10:]
    expected = ending(depths, weights, end)
    assert expected is not None
    torch.testing.assert_close(ending(1 - 1 / depths, weights, 1 - 1 / end, ndc=True), expected)


@pytest.mark.parametrize("known", [[1.0, NAN, 5.0, NAN], [NAN] * 4])
def test_depths_on_a_device_are_the_same_without_waiting(known: list[float]) -> None:
    """But for 0 where nothing is known."""
    weights, distance = torch.rand(4, 100), torch.tensor(known)
    here = weights.clone().requires_grad_()
    expected = ending(straight_rays(4), here, distance)
    if expected is not None:
        expected.backward()
    with pretend_cuda() as seen:
        there = weights.to(CUDA).requires_grad_()
        given = straight_rays(4).to(CUDA), there, distance.to(CUDA)
        found = ending(*given)
        assert found is not None
        found.backward()
        assert not seen.syncs
        gradient = there.grad
        assert gradient is not None
        torch.testing.assert_close(found.detach().cpu(), torch.zeros(()) if expected is None else expected.detach())
        torch.testing.assert_close(gradient.cpu(), torch.zeros_like(weights) if here.grad is None else here.grad)


@pytest.mark.parametrize(("shell", "wanted"), [(4.0, (0.3**2 + 1.0**2) / 2), (math.inf, (0.9**2 + 1.0**2) / 2), (0.5, 0.0)])
def test_what_sky_rays_meet_before_the_shell(shell: float, wanted: float) -> None:
    t = torch.tensor([[1.0, 3.0, 6.0]]).repeat(3, 1)
    weights = torch.tensor([[0.3, 0.6], [0.5, 0.5], [1.0, 0.0]], requires_grad=True)
    found = emptiness(t, weights, torch.tensor([True, False, True]), within=shell)
    assert found is not None and found.item() == pytest.approx(wanted)
    found.backward()
    assert weights.grad is not None and not weights.grad[1].any()


@pytest.mark.parametrize("sky", [[True, False, True], [False] * 3])
def test_sky_on_a_device_is_the_same_without_waiting(sky: list[bool]) -> None:
    """But for 0 where there is none."""
    t, weights = torch.tensor([[1.0, 3.0, 6.0]]).repeat(3, 1), torch.tensor([[0.3, 0.6], [0.5, 0.5], [1.0, 0.0]])
    expected = emptiness(t, weights, torch.tensor(sky), within=SHELL)
    with pretend_cuda() as seen:
        given = t.to(CUDA), weights.to(CUDA), torch.tensor(sky).to(CUDA)
        found = emptiness(*given, within=SHELL)
        assert found is not None and not seen.syncs
        assert found.item() == pytest.approx(0.0 if expected is None else expected.item())


def test_the_sky_is_cleared(world: World, tmp_path: Path) -> None:
    """Rays of the upper third are said to be sky: they are emptied where that counts; at weight 0 nothing is computed."""

    def mark(step: int, batch: Batch) -> Batch:
        return batch._replace(sky=batch.pixel[:, 1] < 8)

    last = {}
    for weight in (1.0, 1e-9, 0.0):
        events = []
        config = replace(world.config, steps=40, loss=replace(world.config.loss, sky=weight))
        trained_for(world, tmp_path / str(weight), config, change=mark, report=events.append)
        last[weight] = events[-1].losses
    assert last[1.0]["sky"] < 0.8 * last[1e-9]["sky"]
    assert "sky" not in last[0.0]
