"""Terms of the training loss: their values, whom they move, those of packages, depths and sky."""

import math
from dataclasses import dataclass, replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tiny_world import World, rays_of
from torch import Tensor

from fprf.config import LossConfig
from fprf.errors import ConfigError, PluginError
from fprf.interfaces import LossTerm, Parts
from fprf.plugins.losses.config import LossTermConfig
from fprf.rendering.renderer import TrainingStep, render_rays
from fprf.training.losses import check_penalties, emptiness, ending, extra_term, terms, total, wanted
from fprf.training.model import Model, build_model
from fprf.types import Batch, Rendered, Want

TERMS = ("rgb", "content", "semantic", "variation", "proposal_variation", "interlevel", "distortion")


def only(**weights: float) -> LossConfig:
    return LossConfig(**(dict.fromkeys(TERMS, 0.0) | weights))  # type: ignore[arg-type]


def rendered(world: World, model: Model, batch: Batch, config: LossConfig) -> Rendered:
    return render_rays(
        rays_of(world, world.load(), batch),
        model.parts,
        want=wanted(config, batch),
        budget=0.0,
        training=TrainingStep(
            step=0,
            semantic_rays=len(batch.semantic) if batch.semantic is not None else None,
            semantic_samples=2,
            content_moves_density=False,
        ),
    )


def test_each_term_is_what_it_says(world: World) -> None:
    model = world.load().model
    batch = world.prepared.manager.batch(0)
    facts = world.prepared.facts
    config = LossConfig()
    out = rendered(world, model, batch, config)
    found = terms(config, facts, out, batch, model, step=0)
    assert set(found) == set(TERMS)
    rgb, content, semantic = (
        getattr(out, name).double() - getattr(batch, name) for name in ("rgb", "content", "semantic")
    )
    assert float(found["rgb"]) == pytest.approx(float(rgb.square().mean()), rel=1e-5)
    assert float(found["content"]) == pytest.approx(
        float(content.square().mean()) / facts.of_field.content_scale**2, rel=1e-5
    )
    assert float(found["semantic"]) == pytest.approx(
        float(semantic.abs().mean()) / facts.of_field.semantic_scale, rel=1e-5
    )


def test_penalties_come_when_they_are_due_and_weigh_as_many_times_more(world: World) -> None:
    model = world.load().model
    batch = world.prepared.manager.batch(0)
    config = replace(LossConfig(), penalty_every=4)
    out = rendered(world, model, batch, config)
    due = [
        step
        for step in range(9)
        if "variation" in terms(config, world.prepared.facts, out, batch, model, step=step)
    ]
    assert due == [0, 4, 8]
    parts = {"variation": torch.tensor(2.0), "proposal_variation": torch.tensor(3.0)}
    assert float(total(config, parts)) == pytest.approx(
        4 * (2 * config.variation + 3 * config.proposal_variation)
    )


def test_a_penalty_of_any_name_counts(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """At the weight that the plug-in states, unless a weight is named."""
    model = world.load().model
    batch = world.prepared.manager.batch(0)
    monkeypatch.setattr(model.field, "penalties", lambda: {"entropy": torch.tensor(3.0)})
    for penalties, weight in (((), 1.0), ((("entropy", 0.5),), 0.5), ((("entropy", 0.0),), 0.0)):
        config = replace(only(rgb=1.0), penalties=penalties, penalty_every=4)
        check_penalties(config, model)
        out = rendered(world, model, batch, config)
        found = terms(config, world.prepared.facts, out, batch, model, step=4)
        assert set(found) == {"rgb", *(["entropy"] if weight else [])}
        assert float(total(config, found)) == pytest.approx(float(found["rgb"]) + 4 * weight * 3, rel=1e-6)
        assert set(terms(config, world.prepared.facts, out, batch, model, step=3)) == {"rgb"}
    with pytest.raises(
        ConfigError, match=r"'entrpy'; did you mean 'entropy'\? \(penalties that can be named: entropy\)"
    ):
        check_penalties(LossConfig(penalties=(("entrpy", 1.0),)), model)
    monkeypatch.setattr(model.field, "penalties", lambda: {"content": torch.tensor(3.0)})
    del model.penalty_names
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
        assert (
            rendered.semantic is not None
            and rendered.weights is not None
            and parts.space is not None
            and step >= 0
        )
        value = rendered.weights.square().mean() * (
            1 if generator is None else torch.rand((), generator=generator)
        )
        wrong = {"type": 3.0, "shape": value[None], "dtype": value.double(), "device": value.to("meta")}
        return wrong.get(self.wrong, value)  # type: ignore[return-value]


@dataclass(frozen=True, kw_only=True)
class WeightsConfig(LossTermConfig):
    wrong: str = ""

    def build(self) -> LossTerm:
        return Weights(self.wrong)


def test_a_term_of_a_package_counts(world: World) -> None:
    model = build_model(world.config, world.prepared.facts)
    batch = world.prepared.manager.batch(0)
    config = replace(only(rgb=1.0), extra=WeightsConfig(weight=0.5))
    extra = extra_term(config)
    assert extra is not None and wanted(config, batch, extra) == Want.DENSITY | Want.COLOUR | Want.SEMANTIC
    out = render_rays(
        rays_of(world, world.load(), batch),
        model.parts,
        want=wanted(config, batch, extra),
        budget=0.0,
        training=TrainingStep(step=0),
    )
    found = terms(config, world.prepared.facts, out, batch, model, step=7, extra=extra)
    assert out.weights is not None and set(found) == {"rgb", "extra"}
    assert float(found["extra"].detach()) == pytest.approx(float(out.weights.detach().square().mean()))
    summed = float(found["rgb"].detach()) + 0.5 * float(found["extra"].detach())
    assert float(total(config, found).detach()) == pytest.approx(summed)
    total(config, found).backward()  # type: ignore[no-untyped-call]
    assert extra_term(replace(config, extra=WeightsConfig(weight=0.0))) is None
    for wrong in ("type", "shape", "dtype", "device"):
        bad = replace(config, extra=WeightsConfig(wrong=wrong))
        with pytest.raises(
            PluginError, match=r"WeightsConfig: the term: expected float32 \[\] on cpu, found"
        ):
            terms(bad, world.prepared.facts, out, batch, model, step=0, extra=extra_term(bad))


EDGES = torch.linspace(0.0, 10.0, 101)


def straight_rays(count: int) -> Tensor:
    return EDGES.expand(count, -1)


def spike(*at: float) -> Tensor:
    """All weight of each ray in the interval around a distance."""
    weights = torch.zeros(len(at), 100)
    for row, t in enumerate(at):
        weights[row, int(t * 10)] = 1.0
    return weights


def test_a_ray_that_ends_at_its_point_costs_nothing_before_it_two_behind_it_one() -> None:
    for t, cost in ((5.0, 0.0), (3.0, 2.0), (8.0, 1.0)):
        assert float(ending(straight_rays(1), spike(t), torch.tensor([5.0]))) == cost


@given(st.lists(st.floats(0.5, 9.5) | st.just(float("nan")), min_size=1, max_size=6), st.integers(0, 1000))
def test_only_known_rays_count_and_the_mean_is_theirs(distances: list[float], seed: int) -> None:
    count = len(distances)
    weights = torch.rand(count, 100, generator=torch.Generator().manual_seed(seed))
    weights = weights / weights.sum(1, keepdim=True)
    distance = torch.tensor(distances)
    found = ending(straight_rays(count), weights, distance)
    known = [k for k in range(count) if not math.isnan(distances[k])]
    each = [float(ending(straight_rays(1), weights[k : k + 1], distance[k : k + 1])) for k in known]
    assert 0 <= float(found) <= 2
    torch.testing.assert_close(float(found), sum(each) / max(1, len(each)), atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("found", [3.0, 5.0, 8.0])
def test_in_device_coordinates_it_is_about_depths_too(found: float) -> None:
    """Straight ahead of a near plane at 1, depth z has the ray parameter 1 - 1/z."""
    depths = straight_rays(1)[:, 10:]
    end = torch.tensor([5.0])
    weights = spike(found)[:, 10:]
    torch.testing.assert_close(
        ending(1 - 1 / depths, weights, 1 - 1 / end, ndc=True), ending(depths, weights, end)
    )


@pytest.mark.parametrize(
    ("shell", "wanted"), [(4.0, (0.3**2 + 1.0**2) / 2), (math.inf, (0.9**2 + 1.0**2) / 2), (0.5, 0.0)]
)
def test_what_sky_rays_meet_before_the_shell(shell: float, wanted: float) -> None:
    t = torch.tensor([[1.0, 3.0, 6.0]]).repeat(3, 1)
    weights = torch.tensor([[0.3, 0.6], [0.5, 0.5], [1.0, 0.0]], requires_grad=True)
    found = emptiness(t, weights, torch.tensor([True, False, True]), within=shell)
    assert found.item() == pytest.approx(wanted)
    found.backward()
    assert weights.grad is not None and not weights.grad[1].any()
