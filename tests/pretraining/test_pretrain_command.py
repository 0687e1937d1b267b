"""`fprf pretrain` and `tools.distil`: two steps of each kind give files that load; a broken-off run goes on where it was."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from photo_folder import photo_folder, teacher_files, vgg_file
from torch import Tensor, nn

from fprf.cli.pretrain import run
from fprf.errors import UsageError
from fprf.plugins.decoders.config import MlpDecoderConfig
from fprf.plugins.encoders.config import BundledContentConfig, BundledSemanticConfig, RandomConfig
from fprf.plugins.weights import read_weights
from fprf.pretraining.config import PretrainConfig
from fprf.pretraining.loop import checkpoint_path, train
from tools.distil.__main__ import main

QUICK = ["--steps", "2", "--batch", "2"]


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> str:
    return str(photo_folder(tmp_path_factory.mktemp("photos") / "all", 4))


def report_of(capsys: pytest.CaptureFixture[str]) -> dict[str, float]:
    found: dict[str, float] = json.loads(capsys.readouterr().out)
    return found


def test_content(photos: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = tmp_path / "content.safetensors"
    args = [
        "--images",
        photos,
        "--teachers",
        str(vgg_file(tmp_path, 64)),
        "--output",
        str(output),
        "--size",
        "32",
        "--crops",
        "2",
    ]
    assert main(["content", *args, *QUICK]) == 0
    report = report_of(capsys)
    assert report["steps"] == 2
    assert 0 < report["relative_l2"] < 10
    encoder = BundledContentConfig(weights=output).build()
    assert encoder.channels == report["channels"]
    assert encoder(torch.rand(1, 3, 20, 21)).shape == (1, encoder.channels, 10, 11)
    beside = {"content.safetensors", "content.report.json", "content.samples", "vgg.safetensors"}
    assert {file.name for file in tmp_path.iterdir()} <= beside
    assert "2 steps" in read_weights(output)[1]["made_by"]


def test_semantic(photos: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = tmp_path / "semantic.safetensors"
    teachers = [str(path) for path in teacher_files(tmp_path)]
    args = ["--images", photos, "--teachers", *teachers, "--output", str(output), "--size", "64", "--towns", "0"]
    assert main(["semantic", *args, *QUICK]) == 0
    report = report_of(capsys)
    assert -1 <= report["teacher_cosine"] <= 1
    assert -1 <= report["night_cosine"] <= 1
    encoder = BundledSemanticConfig(weights=output).build()
    assert encoder(torch.rand(1, 3, 40, 70)).shape == (1, 26 + 25, 5, 9)


def test_decoder(photos: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = tmp_path / "decoder.safetensors"
    args = ["--images", photos, "--output", str(output), "--encoder", "random", "--encoder.channels", "5", "--pixels", "50"]
    assert run(["decoder", *args, *QUICK]) == 0
    encoder = RandomConfig(channels=5).build()
    assert report_of(capsys)["encoder"] == encoder.identity
    decoder = MlpDecoderConfig(weights=output).build(encoder=encoder.identity, channels=5)
    assert decoder(torch.rand(4, 5)).shape == (4, 3)


def test_a_decoder_learns_and_its_report_is_honest(photos: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = []
    for steps in ("1", "300"):
        args = ["--images", photos, "--output", str(tmp_path / "d.safetensors"), "--encoder", "random", "--rate", "0.02"]
        assert run(["decoder", *args, "--steps", steps, "--batch", "512"]) == 0
        found.append(report_of(capsys)["psnr_db"])
    assert found[1] > found[0] + 5


@pytest.mark.parametrize(
    ("args", "message"),
    [
        ([], "allowed is decoder"),
        (["field"], "'field' to train"),
        (["content"], "tools.distil content"),
        (["decoder"], "--images DIR"),
        (["decoder", "--images", "."], "--output FILE"),
        (["decoder", "--images", ".", "--teachers", "x"], "--teachers"),
    ],
)
def test_mistakes(args: list[str], message: str) -> None:
    with pytest.raises(UsageError, match=message):
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


def test_a_resumed_run_ends_where_an_unbroken_one_does(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fprf.pretraining.loop.EVERY_SECONDS", -1.0)
    config, output = PretrainConfig(steps=9), tmp_path / "w.safetensors"
    whole, broken, resumed = network(), network(), network()
    train(whole, quadratic(whole), config, tmp_path / "other.safetensors", lambda _: None)
    with pytest.raises(KeyboardInterrupt):
        train(broken, quadratic(broken, broken_at=6), config, output, lambda _: None)
    said: list[str] = []
    seldom = replace(config, samples=500.0)  # how often samples are made may change
    assert train(resumed, quadratic(resumed), seldom, output, said.append) == 9
    assert said[0] == "resumed at step 5"
    assert torch.equal(resumed.weight, whole.weight)
    assert not checkpoint_path(output).exists()
