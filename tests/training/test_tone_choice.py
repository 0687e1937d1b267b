"""`--tone`: the light of a training view, or what lies between several, at render time."""

from collections.abc import Sequence
from dataclasses import replace

import pytest
import torch
from tiny_world import World

from fprf.errors import UsageError
from fprf.training.camera_optimizers import Tones
from fprf.training.loading import Trained
from fprf.training.model import Model
from fprf.training.quality import QualityConfig, at_quality
from fprf.training.views import cache_view, render_view


def lit(world: World) -> Trained:
    """The run, with tones as if they had been learnt."""
    trained = world.load()
    known = trained.known
    tones = Tones(torch.linspace(-0.5, 0.5, len(known.names)), known.test)
    with torch.no_grad():
        tones.gain.copy_(0.2 * torch.randn(len(known.names), 3, generator=torch.Generator().manual_seed(0)))
    return replace(trained, model=Model(trained.model.parts, tones))


def shown(trained: Trained, *tone: str) -> tuple[torch.Tensor, torch.Tensor]:
    chosen = at_quality(trained, QualityConfig(tone=tone))
    known, render = chosen.known, chosen.config.render
    view = (chosen.model, known.facts, known.cameras, known.test[0], render)
    return render_view(*view).rgb, cache_view(*view).restyled().rgb


def factors(trained: Trained, views: Sequence[int]) -> torch.Tensor:
    assert trained.model.tones is not None
    return trained.model.tones(torch.tensor(list(views))).detach()


def test_a_view_s_light_multiplies_colours(world: World) -> None:
    trained = lit(world)
    view = trained.known.train[2]
    plain, _ = shown(trained)
    for text in (trained.known.names[view], str(view), f"{view}=7"):
        for image in shown(trained, text):
            torch.testing.assert_close(image, (plain * factors(trained, [view])[0]).clamp(0, 1), atol=1e-6, rtol=1e-5)


def test_between_two_views_means_of_logarithms_are_taken(world: World) -> None:
    trained = lit(world)
    a, b = trained.known.train[:2]
    plain, _ = shown(trained)
    log = factors(trained, (a, b)).log()
    for texts, share in (((str(a), str(b)), 0.5), ((f"{a}=1", f"{b}=3"), 0.25), ((f"{a}=0.5", f"{b}=0"), 1.0)):
        wanted = plain * (share * log[0] + (1 - share) * log[1]).exp()
        torch.testing.assert_close(shown(trained, *texts)[0], wanted.clamp(0, 1), atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("nowhere", "no view or VIEW=WEIGHT"),
        ("0=x", "no view"),
        ("=", "no view"),
        ("99", "not learnt from"),
        ("1=-2", "weight"),
    ],
)
def test_what_is_no_view_is_told(world: World, text: str, match: str) -> None:
    with pytest.raises(UsageError, match=match):
        shown(lit(world), text)


def test_views_without_tones_are_told(world: World) -> None:
    trained = lit(world)
    held, first = trained.known.test[0], trained.known.train[0]
    with pytest.raises(UsageError, match="not learnt from"):
        shown(trained, str(held))
    with pytest.raises(UsageError, match="all weights are 0"):
        shown(trained, f"{first}=0")
    with pytest.raises(UsageError, match="--tones true"):
        shown(world.load(), str(first))
    bare = replace(trained.config.render, tone=(1.0, 1.0, 1.0))
    assert bare.tone == (1.0, 1.0, 1.0)
