"""`fprf pretrain` and `tools.distil`: two steps of each kind give files that load; a broken-off run goes on where it was."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from photo_folder import teacher_files, vgg_file
from torch import Tensor, nn

from fprf.cli.pretrain import run
from fprf.errors import UsageError
from fprf.plugins.decoders.config import MlpDecoderConfig
from fprf.plugins.encoders.config import BundledContentConfig, BundledSemanticConfig, RandomConfig
from fprf.plugins.weights import read_weights
from fprf.pretraining.config import PretrainConfig
from fprf.pretraining.loop import train, training_folder
from tools.distil.__main__ import main

QUICK = ["--steps", "2", "--batch", "2"]


def report_of(capsys: pytest.CaptureFixture[str]) -> dict[str, float]:
    found: dict[str, float] = json.loads(capsys.readouterr().out)
    return found


def test_content(photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output, teacher = tmp_path / "content.safetensors", str(vgg_file(tmp_path, 64))
    small = ["--output", str(output), "--size", "32", "--crops", "2", *QUICK]
    assert main(["content", "--images", str(photos), "--teachers", teacher, *small]) == 0
    report = report_of(capsys)
    assert report["steps"] == 2
    assert 0 < report["relative_l2"] < 10
    encoder = BundledContentConfig(weights=output).build()
    assert encoder.channels == report["channels"]
    assert encoder(torch.rand(1, 3, 20, 21)).shape == (1, encoder.channels, 10, 11)
    beside = {"content.safetensors", "content.report.json", "vgg.safetensors"}
    assert {file.name for file in tmp_path.iterdir()} <= beside
    assert "2 steps" in read_weights(output)[1]["made_by"]


def test_semantic(photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """From photographs and streets."""
    output, teachers = tmp_path / "semantic.safetensors", map(str, teacher_files(tmp_path))
    small = ["--output", str(output), "--size", "64", "--towns", "1", *QUICK]
    assert main(["semantic", "--images", str(photos), "--teachers", *teachers, *small]) == 0
    said = capsys.readouterr()
    report = json.loads(said.out)
    assert "29 crops prepared" in said.err, "four photographs and five views in five palettes"
    assert -1 <= report["teacher_cosine"] <= 1
    assert -1 <= report["night_cosine"] <= 1
    encoder = BundledSemanticConfig(weights=output).build()
    assert encoder(torch.rand(1, 3, 40, 70)).shape == (1, 26 + 25, 5, 9)


def test_a_decoder_learns_and_its_report_is_honest(photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output, encoder, found = tmp_path / "d.safetensors", RandomConfig(channels=12).build(), []
    chosen = ["--encoder", "random", "--encoder.channels", "12", "--rate", "0.02", "--batch", "512"]
    for steps in ("1", "300"):
        assert run(["decoder", "--images", str(photos), "--output", str(output), *chosen, "--steps", steps]) == 0
        report = report_of(capsys)
        assert report["encoder"] == encoder.identity
        found.append(report["psnr_db"])
    assert found[1] > found[0] + 5
    decoder = MlpDecoderConfig(weights=output).build(encoder=encoder.identity, channels=12)
    assert decoder(torch.rand(4, 12)).shape == (4, 3)


@pytest.mark.parametrize(
    "args",
    [[], ["field"], ["content"], ["decoder"], ["decoder", "--images", "."], ["decoder", "--images", ".", "--teachers", "x"]],
)
def test_mistakes(args: list[str]) -> None:
    with pytest.raises(UsageError):
        run(args)


def quadratic(network: nn.Linear, broken_at: int | None = None) -> Callable[[torch.Generator], Tensor]:
    calls = [0]

    def loss(generator: torch.Generator) -> Tensor:
        calls[0] += 1
        if calls[0] == broken_at:
            raise KeyboardInterrupt
        result: Tensor = network(torch.randn(4, 3, generator=generator)).square().mean()
        return result

    return loss


def network() -> nn.Linear:
    torch.manual_seed(0)
    return nn.Linear(3, 2)


def test_a_resumed_run_ends_where_an_unbroken_one_does(tmp_path: Path) -> None:
    config, output = PretrainConfig(steps=9), tmp_path / "w.safetensors"
    whole, broken, resumed = network(), network(), network()
    train(whole, quadratic(whole), config, tmp_path / "other.safetensors", lambda _: None)
    with pytest.raises(KeyboardInterrupt):
        train(broken, quadratic(broken, broken_at=6), config, output, lambda _: None)
    said: list[str] = []
    assert train(resumed, quadratic(resumed), config, output, said.append) == 9
    assert said[0] == "resumed at step 5"
    assert torch.equal(resumed.weight, whole.weight)
    assert not training_folder(output).exists()
