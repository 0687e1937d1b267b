"""D_VGG: the formula, never another encoder's features, and the line that makes the decoder that fits."""

import shlex
from dataclasses import replace
from pathlib import Path
from typing import get_args

import pytest
import torch
from safetensors.torch import save_file
from tiny_world import World

from fprf.cli.parsing import parse
from fprf.config import TrainConfig
from fprf.errors import WeightsError
from fprf.methods import fprf_lite
from fprf.plugins.decoders.config import DecoderConfig, MlpDecoderConfig, Objective, pretrain_line
from fprf.plugins.decoders.decoders import DECODER_KIND, MlpDecoder, load_decoder
from fprf.plugins.encoders.config import (
    BundledContentConfig,
    Dinov2Config,
    EncoderConfig,
    RandomConfig,
    Vgg19Config,
)
from fprf.plugins.weights import write_weights
from fprf.pretraining.config import PretrainDecoderConfig
from fprf.training.field_setup import prepare


def file_of(path: Path, encoder: str, channels: int = 6, hidden: int = 4) -> Path:
    write_weights(path, MlpDecoder(channels, hidden).state_dict(), {"kind": DECODER_KIND, "encoder": encoder})
    return path


def test_another_encoder_is_refused(tmp_path: Path) -> None:
    path = file_of(tmp_path / "d.safetensors", "vgg19:relu2_1:normalised:aaaa")
    with pytest.raises(WeightsError) as raised:
        load_decoder(path, encoder="vgg19:relu3_1:plain:bbbb", channels=6)
    text = str(raised.value)
    assert "vgg19:relu2_1:normalised:aaaa" in text
    assert "vgg19:relu3_1:plain:bbbb" in text
    with pytest.raises(WeightsError, match="6 channels"):
        load_decoder(path, encoder="vgg19:relu2_1:normalised:aaaa", channels=7)


@pytest.mark.parametrize("config", [BundledContentConfig(), Vgg19Config()])
def test_encoders_that_ship_have_a_decoder_of_each_objective(config: EncoderConfig) -> None:
    encoder = config.build()
    name = encoder.identity
    channels = encoder.channels
    made = [
        MlpDecoderConfig(objective=objective).build(encoder=name, channels=channels)
        for objective in get_args(Objective)
    ]
    content = torch.randn(2, channels)
    identity, paper = (decoder(content) for decoder in made)
    assert identity.shape == paper.shape == (2, 3) and not torch.equal(identity, paper)


def test_files_of_another_kind_are_refused(tmp_path: Path) -> None:
    save_file({"a": torch.zeros(1)}, tmp_path / "other.safetensors")
    write_weights(tmp_path / "nameless.safetensors", MlpDecoder(2, 2).state_dict(), {"kind": DECODER_KIND})
    for name in ("other", "nameless"):
        with pytest.raises(WeightsError, match="no decoder of"):
            MlpDecoderConfig(weights=tmp_path / f"{name}.safetensors").build(encoder="e", channels=2)
    with pytest.raises(WeightsError, match="no such weights file"):
        MlpDecoderConfig(weights=tmp_path / "absent.safetensors").build(encoder="e", channels=2)


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
    assert found == replace(
        PretrainDecoderConfig(), encoder=encoder, images=(Path("DIR"),), output=Path("my own.safetensors")
    )


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
