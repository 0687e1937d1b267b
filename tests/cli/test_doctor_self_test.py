"""`fprf doctor` tests its device: right on the CPU and on a pretended one, and wrong where either is made to be."""

from collections.abc import Callable
from typing import Any
from unittest.mock import Mock

import pytest
import torch
from pretend_cuda import CUDA, pretend_cuda

from fprf.cli import main as cli
from fprf.cli.doctor import self_test
from fprf.cli.findings import Finding
from fprf.ops import dense
from fprf.style.look import Restyle
from fprf.training import device_check, views
from fprf.training.device_check import compare


def told(name: str) -> dict[str, Finding]:
    return {finding.what: finding for finding in self_test(name)}


def test_the_cpu_is_right_and_its_kernels_are_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["doctor", "--device", "cpu"]) == 0
    said = capsys.readouterr().out
    assert "numba's" in said and "training step, render, restyle as on the CPU" in said


def test_a_pretended_gpu_is_right_and_does_the_work() -> None:
    with pretend_cuda(memory=3 << 30) as seen:
        found = told("cuda:0")
    assert not any(finding.remedy for finding in found.values())
    assert seen.uploads and "3.0 GiB free" in found["device memory"].found
    assert "float32" in found["precision"].found and "torch" in found["kernels"].found


def off(function: Callable[..., Any], place: Callable[[Any], torch.Tensor]) -> Callable[..., Any]:
    """The function, wrong on the device alone."""

    def call(*args: Any, **kwargs: Any) -> Any:
        out = function(*args, **kwargs)
        return out * 1.01 if place(args).device == CUDA else out

    return call


@pytest.mark.parametrize("what", ["render", "restyle", "training step"])
def test_a_planted_fault_is_found(what: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if what == "restyle":
        monkeypatch.setattr(Restyle, "colour", off(Restyle.colour, lambda args: args[2]))
    elif what == "render":
        monkeypatch.setattr(views, "composite", off(views.composite, lambda args: args[1]))
    else:
        grad = torch.autograd.grad
        skewed = lambda *a, **k: [g * 1.01 if g.device == CUDA else g for g in grad(*a, **k)]  # noqa: E731
        monkeypatch.setattr(device_check.torch.autograd, "grad", skewed)
    with pretend_cuda():
        wrong = {each.what for each in compare(CUDA) if not each.right}
    assert what in wrong and "encoder" not in wrong


def test_a_wrong_kernel_of_the_cpu_is_found(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(dense, "array", lambda x, real=dense.array: real(1.05 * x))
    assert cli.main(["doctor", "--device", "cpu"]) == 1
    said = [line for line in capsys.readouterr().out.splitlines() if "self-test" in line]
    assert len(said) == 1 and "differs from the CPU" in said[0] and "render is off by" in said[0]


def test_a_device_that_fails_or_is_absent_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    broken = RuntimeError("CUDA error: no kernel image is available\nfor execution")
    monkeypatch.setattr(device_check, "render_view", Mock(side_effect=broken))
    assert "no kernel image" in told("cpu")["self-test"].found and told("cpu")["self-test"].remedy
    assert cli.main(["doctor", "--device", "cuda:7"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
