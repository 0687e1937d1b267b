import pytest

from fprf.cli.parsing import load_method
from fprf.config import LossConfig, OptimizerConfig, RenderConfig, SemanticConfig, StatisticsConfig, TrainConfig
from fprf.errors import ConfigError
from fprf.fields.config import PlanesConfig
from fprf.methods import fprf, fprf_lite
from fprf.plugins.encoders.config import DinoConfig, Vgg19Config
from fprf.plugins.samplers.config import ProposalConfig


def test_the_papers_method_has_the_papers_sizes() -> None:
    config = fprf()
    field, sampler = config.content.field, config.sampler
    assert isinstance(field, PlanesConfig) and field.resolutions == (64, 128, 256, 512)
    assert isinstance(sampler, ProposalConfig) and (*sampler.samples, sampler.final) == (256, 128, 48)
    assert config.content.encoder == Vgg19Config(layer="relu2_1") and isinstance(config.semantic.encoder, DinoConfig)
    assert config.render.train_budget == 0 and config.content.moves_density


def test_methods_are_functions_of_nothing_and_differ() -> None:
    made = [fprf(), fprf_lite()]
    assert made == [fprf(), fprf_lite()]
    assert all(a != b for i, a in enumerate(made) for b in made[:i])
    assert [load_method(name)[0] for name in ("fprf", "fprf-lite")] == made


@pytest.mark.parametrize(
    "make",
    [
        lambda: TrainConfig(downscale=0),
        lambda: TrainConfig(steps=-1),
        lambda: TrainConfig(seed=2**31),
        lambda: TrainConfig(minutes=0.0),
        lambda: TrainConfig(checkpoint_minutes=0.0),
        lambda: SemanticConfig(dim=0),
        lambda: SemanticConfig(samples=0),
        lambda: LossConfig(rgb=-1.0),
        lambda: LossConfig(interlevel=float("nan")),
        lambda: LossConfig(penalty_every=0),
        lambda: LossConfig(rgb=0.0, content=0.0, semantic=0.0),
        lambda: OptimizerConfig(rate=0.0),
        lambda: OptimizerConfig(final=1.5),
        lambda: OptimizerConfig(beta2=-0.1),
        lambda: OptimizerConfig(eps=0.0),
        lambda: RenderConfig(budget=0.6),
        lambda: RenderConfig(train_budget=-0.1),
        lambda: RenderConfig(chunk=0),
        lambda: StatisticsConfig(rays=3),
        lambda: StatisticsConfig(regions=0),
    ],
)
def test_ranges_are_checked_where_the_field_lives(make: object) -> None:
    with pytest.raises(ConfigError):
        make()  # type: ignore[operator]
