"""`fprf pretrain decoder` with the paper's losses, its sample pictures, its report, and the line that users are told."""

import json
import shlex
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from photo_folder import photo_folder, vgg_file

from fprf.cli.pretrain import run
from fprf.errors import WeightsError
from fprf.methods import fprf_lite
from fprf.plugins.decoders.config import MlpDecoderConfig
from fprf.plugins.encoders.config import RandomConfig
from fprf.plugins.weights import read_weights
from fprf.training.model import build_decoder

ENCODER = ["--encoder", "random", "--encoder.channels", "6", "--encoder.stride", "2"]
QUICK = ["--pixels", "60", "--batch", "64", "--size", "24", "--pairs", "1"]


@pytest.fixture(scope="module")
def vgg(tmp_path_factory: pytest.TempPathFactory) -> str:
    return str(vgg_file(tmp_path_factory.mktemp("vgg")))


def made(photos: Path, output: Path, *more: str) -> dict[str, float]:
    assert run(["decoder", "--images", str(photos), "--output", str(output), *ENCODER, *QUICK, *more]) == 0
    report: dict[str, float] = json.loads(output.with_name(output.stem + ".report.json").read_text())
    return report


def test_the_paper_losses_change_the_decoder_as_they_weigh(vgg: str, tmp_path: Path) -> None:
    photos = photo_folder(tmp_path / "photos", 30)  # two of them are held out: one in the style of the other
    steps = ["--steps", "300", "--rate", "0.005", "--style-weights", vgg, "--every", "1"]
    plain = made(photos, tmp_path / "plain.safetensors", *steps)
    styled = made(photos, tmp_path / "styled.safetensors", *steps, "--style", "0.03")
    assert styled["style_loss"] < 0.6 * plain["style_loss"]
    assert styled["psnr_db"] < plain["psnr_db"] - 3, "what the style gains, the identity pays"


def test_without_weights_for_it_no_style_is_measured(photos: Path, vgg: str, tmp_path: Path) -> None:
    steps = ["--steps", "3"]
    assert "style_loss" not in made(photos, tmp_path / "a.safetensors", *steps)
    measured = made(photos, tmp_path / "b.safetensors", *steps, "--style-weights", vgg)
    assert measured["style_loss"] > 0
    first, second = (read_weights(tmp_path / f"{name}.safetensors")[0] for name in "ab")
    assert all(torch.equal(first[name], second[name]) for name in first), "measuring is not training"


def test_the_line_that_users_are_told_makes_a_decoder_that_fits(photos: Path, tmp_path: Path) -> None:
    encoder, output, lite = RandomConfig(channels=4, seed=3), tmp_path / "made.safetensors", fprf_lite()
    config = replace(lite, content=replace(lite.content, encoder=encoder, decoder=MlpDecoderConfig()))
    with pytest.raises(WeightsError) as raised:
        build_decoder(config, encoder=encoder.build().identity, channels=4)
    line = str(raised.value).split("`")[1].replace("DIR", str(photos)).replace("decoder.safetensors", str(output))
    assert run([*shlex.split(line)[2:], "--steps", "1", "--pixels", "20"]) == 0
    fitting = replace(config, content=replace(config.content, decoder=MlpDecoderConfig(weights=output)))
    build_decoder(fitting, encoder=encoder.build().identity, channels=4)
