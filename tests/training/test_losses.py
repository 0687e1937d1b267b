from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch
from tiny_world import World, parameters, rays_of, trained_for

from fprf.config import LossConfig
from fprf.errors import ConfigError, PluginError
from fprf.interfaces import LossTerm
from fprf.plugins.losses.config import LossTermConfig
from fprf.rendering.renderer import Parts, render_rays
from fprf.training.losses import check_penalties, extra_term, terms, total, wanted
from fprf.training.model import Model, build_model
from fprf.training.trainer import Report
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


def test_feature_terms_do_not_depend_on_the_unit_of_the_features(world: World) -> None:
    model, batch, facts = world.load().model, world.prepared.manager.batch(0), world.prepared.facts
    config = only(content=1.0, semantic=1.0)
    out = rendered(world, model, batch, config)
    plain = terms(config, facts, out, batch, model, step=0)
    assert out.content is not None and out.semantic is not None
    assert batch.content is not None and batch.semantic is not None
    tenfold = terms(
        config,
        replace(facts, content_scale=10 * facts.content_scale, semantic_scale=10 * facts.semantic_scale),
        out._replace(content=10 * out.content, semantic=10 * out.semantic),
        batch._replace(content=10 * batch.content, semantic=10 * batch.semantic),
        model,
        step=0,
    )
    for name, value in plain.items():
        assert float(tenfold[name]) == pytest.approx(float(value), rel=1e-5)


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


def test_training_with_a_term_of_a_package_is_reproducible(world: World, tmp_path: Path) -> None:
    def after(config: LossConfig, folder: str) -> tuple[dict[str, torch.Tensor], set[str]]:
        seen: list[Report] = []
        run = trained_for(world, tmp_path / folder, replace(world.config, steps=2, loss=config), report=seen.append)
        return parameters(run, 2), set(seen[-1].losses)

    plain, extra = world.config.loss, replace(world.config.loss, extra=WeightsConfig())
    (a, _), (b, names), (c, others) = after(extra, "a"), after(extra, "b"), after(plain, "c")
    assert all(torch.equal(a[name], b[name]) for name in a) and not all(torch.equal(a[name], c[name]) for name in a)
    assert names - others == {"extra"}


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


def test_content_moves_density_where_it_may(world: World) -> None:
    model, batch, config = build_model(world.config, world.prepared.facts), world.prepared.manager.batch(0), only(content=1.0)
    out = rendered(world, model, batch, config, content_moves_density=True)
    total(config, terms(config, world.prepared.facts, out, batch, model, step=0)).backward()  # type: ignore[no-untyped-call]
    grads = {n: p.grad for n, p in model.named_parameters() if "to_density" in n and n.startswith("field.")}
    assert grads and all(g is not None and bool((g != 0).any()) for g in grads.values())


def test_the_proposal_learns_from_the_interlevel_term_alone(world: World) -> None:
    model, batch = build_model(world.config, world.prepared.facts), world.prepared.manager.batch(0)
    with torch.no_grad():
        next(p for name, p in model.named_parameters() if name.endswith("field.to_density.weight")).mul_(-3).add_(2)
    for config, learns in ((only(rgb=1.0, distortion=1.0), False), (only(rgb=1e-30, interlevel=1.0), True)):
        model.zero_grad()
        parts = terms(config, world.prepared.facts, rendered(world, model, batch, config), batch, model, step=0)
        total(config, parts).backward()  # type: ignore[no-untyped-call]
        grads = [p.grad for p in model.sampler.parameters()]
        assert any(g is not None and bool((g != 0).any()) for g in grads) == learns
