"""`fprf pretrain` and `tools.distil`: files that load, losses that count, resuming, and the same on a
device.
"""

import json
import shlex
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from unittest.mock import DEFAULT, Mock

import pytest
import torch
from photo_folder import photo_folder, teacher_files, vgg_file
from pretend_cuda import pretend_cuda
from torch import Tensor, nn

from fprf.cli.pretrain import run
from fprf.errors import DataError, UsageError, WeightsError
from fprf.methods import fprf_lite
from fprf.ops import backend
from fprf.plugins.decoders.config import MlpDecoderConfig
from fprf.plugins.encoders.config import BundledContentConfig, BundledSemanticConfig, RandomConfig
from fprf.plugins.weights import read_weights
from fprf.pretraining import decoder as pretraining
from fprf.pretraining.config import PretrainConfig
from fprf.pretraining.loop import train, training_folder
from fprf.training.model import build_decoder
from tools.distil.__main__ import main

QUICK = ["--steps", "2", "--batch", "2"]


def report_of(capsys: pytest.CaptureFixture[str]) -> dict[str, float]:
    found: dict[str, float] = json.loads(capsys.readouterr().out)
    return found


def test_content(photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = tmp_path / "content.safetensors"
    teacher = str(vgg_file(tmp_path, 64))
    small = ["--output", str(output), "--size", "32", "--crops", "2", *QUICK]
    assert main(["content", "--images", str(photos), "--teachers", teacher, *small]) == 0
    report = report_of(capsys)
    assert report["steps"] == 2
    assert 0 < report["relative_l2"] < 10
    encoder = BundledContentConfig(weights=output).build()
    assert encoder.channels == report["channels"]
    assert encoder(torch.rand(1, 3, 20, 21)).shape == (1, encoder.channels, 10, 11)
    beside = {".fprf.json", "content.safetensors", "content.report.json", "vgg.safetensors"}
    assert {file.name for file in tmp_path.iterdir()} <= beside
    assert "2 steps" in read_weights(output)[1]["made_by"]


def test_semantic(photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """From photographs and streets."""
    output = tmp_path / "semantic.safetensors"
    teachers = map(str, teacher_files(tmp_path))
    small = ["--output", str(output), "--size", "64", "--towns", "1", *QUICK]
    assert main(["semantic", "--images", str(photos), "--teachers", *teachers, *small]) == 0
    said = capsys.readouterr()
    report = json.loads(said.out)
    assert "29 crops prepared" in said.err, "four photographs and five views in five palettes"
    assert -1 <= report["teacher_cosine"] <= 1
    assert -1 <= report["night_cosine"] <= 1
    encoder = BundledSemanticConfig(weights=output).build()
    assert encoder(torch.rand(1, 3, 40, 70)).shape == (1, 26 + 25, 5, 9)


def test_a_decoder_learns_and_its_report_is_honest(
    photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "d.safetensors"
    encoder = RandomConfig(channels=12).build()
    found = []
    chosen = ["--encoder", "random", "--encoder.channels", "12", "--rate", "0.02", "--batch", "512"]
    for steps in ("1", "300"):
        assert (
            run(["decoder", "--images", str(photos), "--output", str(output), *chosen, "--steps", steps]) == 0
        )
        report = report_of(capsys)
        assert report["encoder"] == encoder.identity
        found.append(report["psnr_db"])
    assert found[1] > found[0] + 5
    decoder = MlpDecoderConfig(weights=output).build(encoder=encoder.identity, channels=12)
    assert decoder(torch.rand(4, 12)).shape == (4, 3)


@pytest.mark.parametrize(
    "args",
    [
        [],
        ["field"],
        ["content"],
        ["decoder"],
        ["decoder", "--images", "."],
        ["decoder", "--images", ".", "--teachers", "x"],
        ["decoder", "--images", ".", "--output", "."],
    ],
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


def test_a_resumed_run_ends_where_an_unbroken_one_does(photos: Path, tmp_path: Path) -> None:
    config = PretrainConfig(images=(photos,), steps=9)
    output = tmp_path / "w.safetensors"
    whole = network()
    broken = network()
    resumed = network()
    train(whole, quadratic(whole), config, tmp_path / "other.safetensors", lambda _: None)
    with pytest.raises(KeyboardInterrupt):
        train(broken, quadratic(broken, broken_at=6), config, output, lambda _: None)
    said: list[str] = []
    assert train(resumed, quadratic(resumed), config, output, said.append) == 9
    assert said[0] == "resumed at step 5"
    assert torch.equal(resumed.weight, whole.weight)


def test_checkpoints_stay_until_the_weights_are_written_and_serve_the_same_photographs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    photos = photo_folder(tmp_path / "photos", 3)
    output = tmp_path / "w.safetensors"
    full = Mock(wraps=pretraining.write_weights, side_effect=[DataError("full"), DataError("full"), DEFAULT])
    monkeypatch.setattr(pretraining, "write_weights", full)
    for _ in range(2):
        with pytest.raises(DataError, match="full"):
            made(photos, output, "--steps", "2")
    assert "resumed at step 2" in capsys.readouterr().err
    shutil.copy(next(photos.iterdir()), photos / "more.png")
    made(photos, output, "--steps", "2")
    assert "resumed" not in capsys.readouterr().err and not training_folder(output).exists()


def test_the_same_weights_and_report_on_a_device(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    own = [
        "--encoder",
        "random",
        "--encoder.channels",
        "5",
        "--pixels",
        "50",
        "--style",
        "0.1",
        "--content",
        "0.1",
        "--every",
        "1",
        "--size",
        "16",
        "--style-weights",
        str(vgg_file(tmp_path)),
        "--steps",
        "2",
        "--batch",
        "2",
    ]
    args = ["decoder", "--images", str(photo_folder(tmp_path / "photos", 4)), *own]
    found = {}
    for device, within in (("cpu", backend.plain), ("cuda:0", pretend_cuda)):
        output = tmp_path / device.replace(":", "") / "weights.safetensors"
        with within() as seen:
            assert run([*args, "--output", str(output), "--device", device]) == 0
        assert seen is None or seen.uploads, "nothing was on the device"
        report = json.loads(capsys.readouterr().out)
        found[device] = (
            read_weights(output),
            {k: v for k, v in report.items() if k not in ("seconds", "weights")},
        )
    ((there, about), report) = found["cuda:0"]
    ((here, before), expected) = found["cpu"]
    assert (about, report) == (before, expected)
    assert there.keys() == here.keys() and all(torch.equal(there[name], here[name]) for name in here)


ENCODER = ["--encoder", "random", "--encoder.channels", "6", "--encoder.stride", "2"]
FEW = ["--pixels", "60", "--batch", "64", "--size", "24", "--pairs", "1"]


@pytest.fixture(scope="module")
def vgg(tmp_path_factory: pytest.TempPathFactory) -> str:
    return str(vgg_file(tmp_path_factory.mktemp("vgg")))


def made(photos: Path, output: Path, *more: str) -> dict[str, float]:
    assert run(["decoder", "--images", str(photos), "--output", str(output), *ENCODER, *FEW, *more]) == 0
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
    encoder = RandomConfig(channels=4, seed=3)
    output = tmp_path / "made.safetensors"
    lite = fprf_lite()
    config = replace(lite, content=replace(lite.content, encoder=encoder, decoder=MlpDecoderConfig()))
    with pytest.raises(WeightsError) as raised:
        build_decoder(config, encoder=encoder.build().identity, channels=4)
    line = (
        str(raised.value)
        .split("`")[1]
        .replace("DIR", str(photos))
        .replace("decoder.safetensors", str(output))
    )
    assert run([*shlex.split(line)[2:], "--steps", "1", "--pixels", "20"]) == 0
    fitting = replace(config, content=replace(config.content, decoder=MlpDecoderConfig(weights=output)))
    build_decoder(fitting, encoder=encoder.build().identity, channels=4)
