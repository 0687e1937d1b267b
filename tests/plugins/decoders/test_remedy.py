"""A pair that does not fit is refused with the line that makes the right decoder: one that the command line takes."""

import shlex
from dataclasses import replace
from pathlib import Path

import pytest
from tiny_world import World

from fprf.cli.parsing import parse
from fprf.config import TrainConfig
from fprf.errors import WeightsError
from fprf.methods import fprf_lite
from fprf.plugins.decoders.config import DecoderConfig, MlpDecoderConfig, pretrain_line
from fprf.plugins.encoders.config import BundledContentConfig, Dinov2Config, EncoderConfig, RandomConfig, Vgg19Config
from fprf.pretraining.config import PretrainDecoderConfig
from fprf.training.prepare import prepare

ENCODERS = [
    BundledContentConfig(),
    BundledContentConfig(weights=Path("own content.safetensors")),
    Vgg19Config(layer="relu3_1", weights=Path("/a folder/vgg's.safetensors"), normalise=False),
    RandomConfig(channels=7, stride=3, seed=2),
    Dinov2Config(model="somebody/vits14-$x", layer=3, stride=4),
]


def with_encoder(encoder: EncoderConfig, decoder: DecoderConfig) -> TrainConfig:
    lite = fprf_lite()
    return replace(lite, content=replace(lite.content, encoder=encoder, decoder=decoder))


@pytest.mark.parametrize("encoder", ENCODERS, ids=lambda each: type(each).__name__)
def test_the_line_is_one_that_the_command_line_takes(encoder: EncoderConfig) -> None:
    words = shlex.split(pretrain_line(encoder, Path("my own.safetensors")))
    assert words[:3] == ["fprf", "pretrain", "decoder"]
    found = parse(PretrainDecoderConfig(), words[3:], prog="fprf pretrain decoder", description="")
    assert found == replace(PretrainDecoderConfig(), encoder=encoder, images=(Path("DIR"),), output=Path("my own.safetensors"))


def test_an_encoder_without_a_decoder_is_refused_before_its_features_are_made(world: World) -> None:
    config = replace(with_encoder(RandomConfig(channels=5), MlpDecoderConfig()), data=world.town)

    def never(done: int, total: int, what: str) -> None:
        raise AssertionError(f"{what} must not be computed")

    with pytest.raises(WeightsError) as raised:
        prepare(config, never)
    text = str(raised.value)
    assert "no decoder ships for the encoder random:5:" in text
    assert f"`{pretrain_line(RandomConfig(channels=5))}` makes its decoder" in text
    assert "\n" not in text
