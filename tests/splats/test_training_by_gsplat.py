"""Gaussians trained by gsplat: on the CPU and on the pretended device, through a stand-in
(tests/gsplat_stand_in.py).
"""

import json
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from gsplat_stand_in import rasterization, stand_in
from learning import quality, stepped
from pretend_cuda import CUDA, pretend_cuda
from splat_ball import equal

from fprf.cli.main import main
from fprf.datamanagers.scene import ParsedScene
from fprf.ops.rasterise.gsplat import GsplatGaussians
from fprf.splats import plan
from fprf.splats.config import GaussiansConfig
from fprf.splats.learner import GaussianLearner
from fprf.splats.setup import build
from fprf.training.checkpoint import load_latest
from fprf.training.loading import open_run


def by_gsplat(learner: GaussianLearner) -> GaussianLearner:
    """The same learner, with its Gaussians where gsplat draws them, on the CPU."""
    model = GsplatGaussians(700, learner.bands, torch.device("cpu"))
    model.start(learner.model.read())
    learner.model = model
    return learner


def test_it_learns_what_the_kernels_of_the_cpu_learn(config: GaussiansConfig, scene: ParsedScene) -> None:
    """Rounding grows over steps of Adam and splits by chance: over three seeds they came out 0.12 dB apart at
    most.
    """
    asked = replace(config, tones=True, poses=1e-4)
    start = build(asked, scene)
    before = quality(start.gaussians(), scene)
    ours = quality(stepped(start).gaussians(), scene)
    with stand_in():
        learner = stepped(by_gsplat(build(asked, scene)))
    assert 590 <= len(learner.gaussians()) <= 600 and ours > before + 2
    assert quality(learner.gaussians(), scene) == pytest.approx(ours, abs=0.3)


def test_the_device_gives_what_the_cpu_gives_with_one_wait_a_step(
    config: GaussiansConfig, scene: ParsedScene
) -> None:
    """Bit for bit: both are torch here. Widths are limited every tenth step, and Gaussians moved every
    twentieth.
    """
    asked = replace(config, tones=True, poses=1e-4)
    waits = {}
    uploads = {}
    part = (205, 225)
    end = 230
    with stand_in():
        wanted = stepped(by_gsplat(build(asked, scene)), *part)
        with pretend_cuda() as seen:
            learner = build(asked, scene, device=CUDA)
            assert learner.device == CUDA and isinstance(learner.model, GsplatGaussians)
            assert all(level[view].there is not None for level in learner.levels for view in level), (
                "they stay there"
            )
            for step in range(*part):
                before = seen.syncs.total(), seen.uploads.total()
                stepped(learner, step, step + 1)
                waits[step] = seen.syncs.total() - before[0]
                uploads[step] = seen.uploads.total() - before[1]
            half = learner.state()
            again = build(asked, scene, device=CUDA)
            again.load(half)
            assert equal(again.gaussians(), learner.gaussians())
            found, other = (stepped(each, part[1], end).gaussians() for each in (learner, again))
            assert equal(found, other)
        assert equal(stepped(wanted, part[1], end).gaussians(), found)
    plain = [step for step in range(*part) if step % 10 and (step + 1) % 20]
    assert {waits[step] for step in plain} == {1}
    assert {uploads[step] for step in plain} == {1}, "all numbers of a step at once"


def test_compiling_kernels_takes_no_minute(
    config: GaussiansConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """gsplat compiles when it first draws; an hour of that leaves all of the minute's steps."""
    real = time.perf_counter
    passed = [0.0]

    def slow(*args: Any, **flags: Any) -> Any:
        passed[0] = passed[0] or 3600.0
        return rasterization(*args, **flags)

    monkeypatch.setattr(time, "perf_counter", lambda: real() + passed[0])
    monkeypatch.setattr(plan, "_MIN_PLANNED_GAUSSIANS", 50)
    monkeypatch.setattr(plan, "_TIMED_SIZES", ((16, 12), (24, 20)))
    run = tmp_path / "run"
    flags = ["--initial", "100", "--cap", "120", "--steps", "5", "--minutes", "1", "--output", str(run)]
    with pretend_cuda(), stand_in(slow):
        assert main(["train", "fprf-splats", "--data", str(config.data), *flags]) == 0
    saved, _ = load_latest(run / "checkpoints")
    assert passed[0] and saved is not None and saved.step == 5 and saved.seconds < 60


@pytest.mark.parametrize("slow", [True, False])
def test_one_line_says_that_the_kernels_of_the_cpu_are_compiled(
    monkeypatch: pytest.MonkeyPatch, slow: bool
) -> None:
    said: list[str] = []
    heard = threading.Event()

    def say(line: str) -> None:
        said.append(line)
        heard.set()

    compiler = SimpleNamespace(wait=lambda: heard.wait(60) if slow else None)
    monkeypatch.setattr(plan, "_NOTICE_SECONDS", 0.0 if slow else 60.0)
    monkeypatch.setattr(plan, "compile_beside", lambda bands: [compiler])
    GaussiansConfig().compile_kernels(torch.device("cpu"), say)
    assert len(said) == slow


@pytest.mark.parametrize("installed", [True, False])
def test_auto_trains_where_gsplat_draws(
    config: GaussiansConfig,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    installed: bool,
) -> None:
    flags = ["--initial", "300", "--cap", "600", "--steps", "12"]
    words = ["train", "fprf-splats", "--data", str(config.data), *flags, "--output", str(tmp_path / "run")]
    with pretend_cuda(), stand_in(), monkeypatch.context() as patched:
        # Steps by which the plan measures the device; the stand-in draws all Gaussians in all pixels.
        patched.setattr(plan, "_MIN_PLANNED_GAUSSIANS", 50)
        patched.setattr(plan, "_TIMED_SIZES", ((16, 12), (24, 20)))
        if not installed:
            patched.setitem(sys.modules, "gsplat", None)
        assert main(words) == 0
    said = capsys.readouterr()
    events = [json.loads(line)["event"] for line in (said.out + said.err).splitlines() if '"event"' in line]
    assert sum("on cuda:0 by gsplat" in each for each in events) == installed
    assert sum("Gaussians are trained on the CPU" in each and "fprf[cuda]" in each for each in events) == (
        not installed
    )
    scene = open_run(tmp_path / "run", "cpu").scene
    assert len(scene.gaussians) > 100
    with pretend_cuda(), stand_in(), monkeypatch.context() as patched:
        if not installed:
            patched.setitem(sys.modules, "gsplat", None)
        other = open_run(tmp_path / "run", "auto").scene
        drawn, wanted = (each.render(scene.cameras.scaled(2), 1) for each in (other, scene))
        assert other.drawn_on == (CUDA if installed else torch.device("cpu"))
    for name in ("rgb", "depth", "opacity"):
        assert getattr(drawn, name).device.type == "cpu"
        torch.testing.assert_close(getattr(drawn, name), getattr(wanted, name), rtol=1e-3, atol=2e-3)
