"""Pretraining and distillation on `cuda:0` learn what the CPU learns, bit for bit, where both take plain torch."""

import json
from pathlib import Path

import pytest
import torch
from photo_folder import photo_folder, teacher_files, vgg_file
from pretend_cuda import pretend_cuda

from fprf.cli.pretrain import run
from fprf.ops import backend
from fprf.plugins.weights import read_weights
from tools.distil.__main__ import main

SMALL = ["--steps", "2", "--batch", "2"]


@pytest.mark.parametrize("kind", ["decoder", "content", pytest.param("semantic", marks=pytest.mark.slow)])
def test_the_same_weights_and_report(kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    images = str(photo_folder(tmp_path / "photos", 4))
    own = {
        "decoder": ["--encoder", "random", "--encoder.channels", "5", "--pixels", "50", "--style", "0.1", "--content", "0.1",
                    "--every", "1", "--size", "16", "--style-weights", str(vgg_file(tmp_path))],
        "content": ["--teachers", str(vgg_file(tmp_path)), "--size", "32", "--crops", "1"],
        "semantic": ["--teachers", *map(str, teacher_files(tmp_path)), "--size", "32", "--towns", "0"],
    }[kind]  # fmt: skip
    found = {}
    for device in ("cpu", "cuda:0"):
        output = tmp_path / device.replace(":", "") / "weights.safetensors"
        train = run if kind == "decoder" else main
        args = [kind, "--images", images, "--output", str(output), "--device", device, *own, *SMALL]
        if device == "cpu":
            with backend.plain():
                assert train(args) == 0
        else:
            with pretend_cuda() as seen:
                assert train(args) == 0
            assert seen.uploads, "nothing was on the device"
        report = json.loads(capsys.readouterr().out)
        found[device] = read_weights(output), {k: v for k, v in report.items() if k not in ("seconds", "weights")}
    (there, about), report = found["cuda:0"]
    (here, before), expected = found["cpu"]
    assert (about, report) == (before, expected)
    assert there.keys() == here.keys() and all(torch.equal(there[name], here[name]) for name in here)
