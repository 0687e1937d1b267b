from fprf.cli.parsing import load_method
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
