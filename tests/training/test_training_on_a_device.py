"""Training on the pretended device gives what the CPU gives, and the host neither waits nor copies in a
step.
"""

import shutil
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from parts_world import BlockWorld, tensors_of, unfinish, world_of_blocks
from pretend_cuda import CUDA, pretend_cuda
from tiny_world import Altered, Change, World, events, parameters, prepared_for, spoilt, taught

from fprf.config import TrainConfig
from fprf.interfaces import DataManager
from fprf.methods import fprf
from fprf.ops import backend
from fprf.plugins.samplers.config import UniformConfig
from fprf.plugins.stylizers.config import (
    AdainConfig,
    LocalAdainConfig,
    RegionOtConfig,
    RegionToneConfig,
    StylizerConfig,
)
from fprf.progress import Report
from fprf.style.config import StyleConfig
from fprf.style.files import StyleFile
from fprf.style.restyle import apply_style
from fprf.training import checkpoint, driver
from fprf.training import field_learner as learner
from fprf.training.field_scene import load_run
from fprf.training.model import build_model
from fprf.training.prepare import device_of
from fprf.training.run import Run
from fprf.training.style_pass import measure_style
from fprf.types import Batch

STEPS = 4
NAN = float("nan")


def marked(step: int, batch: Batch) -> Batch:
    """Depths and sky of made-up places."""
    x, y = batch.pixel.unbind(1)
    return batch._replace(distance=torch.where(x < 16, 0.5 + x / 16, NAN), sky=y < 8 - step)


class Steps:
    """What the host did in each step of training on the pretended device."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.waits: list[int] = []
        self.uploads: list[int] = []
        self.seen: Any = None
        plain = learner.FieldLearner.step

        def counted(loop: learner.FieldLearner, step: int, share: float) -> Any:
            before = self.seen.syncs.total(), self.seen.uploads.total()
            result = plain(loop, step, share)
            self.waits.append(self.seen.syncs.total() - before[0])
            self.uploads.append(self.seen.uploads.total() - before[1])
            return result

        monkeypatch.setattr(learner.FieldLearner, "step", counted)
        monkeypatch.setattr(driver, "REPORT_SECONDS", 1e9)


def trained(
    config: TrainConfig,
    folder: Path,
    change: Change | None = None,
    wrap: Callable[..., DataManager] = Altered,
) -> tuple[Run, list[Report]]:
    """Prepare and train; the reports."""
    prepared = prepared_for(config)
    reports = []
    if change is not None:
        prepared = prepared._replace(manager=wrap(prepared.manager, change))
    folder.mkdir(exist_ok=True)
    taught(config, prepared, Run(folder), reports.append)
    return Run(folder), reports


def on_device(
    config: TrainConfig, folder: Path, steps: Steps | None = None, **how: Any
) -> tuple[Run, list[Report]]:
    with pretend_cuda() as seen:
        if steps is not None:
            steps.seen = seen
        return trained(replace(config, device="cuda:0"), folder, **how)


def agrees(
    run: Run,
    config: TrainConfig,
    folder: Path,
    within: float = 1e-4,
    train: Callable[..., Any] = trained,
    **how: Any,
) -> Report:
    """Check that a run's parameters are those of another training, within a share of the way that this came;
    its last report.

    Compiled sums and torch's round differently, and Adam turns a gradient that is rounding alone into a whole
    step.
    """
    other, reports = train(config, folder / "other", **how)
    start, _ = train(replace(config, steps=0), folder / "start")
    a = parameters(run, config.steps)
    b = parameters(other, config.steps)
    begun = parameters(start, 0)
    assert a.keys() == b.keys()
    names = [name for name in a if name.startswith("model.") and a[name].is_floating_point()]
    off = sum(float((a[name] - b[name]).double().square().sum()) for name in names)
    way = sum(float((b[name] - begun[name]).double().square().sum()) for name in names)
    assert (off / way) ** 0.5 < within
    report: Report = reports[-1]
    return report


def variant(name: str, config: TrainConfig) -> TrainConfig:
    config, content = replace(config, steps=STEPS), config.content
    match name:
        case "marked, poses, tones":
            return replace(config, poses=0.02, tones=True)
        case "uniform, no semantics":
            semantic = replace(config.semantic, encoder=None)
            return replace(config, sampler=UniformConfig(samples=12), semantic=semantic)
        case "paper":
            # The method `fprf` with the sizes and encoders of the tiny one.
            method = fprf()
            return replace(
                method,
                data=config.data,
                output=config.output,
                steps=STEPS,
                device=config.device,
                datamanager=replace(method.datamanager, rays=128),
                sampler=replace(
                    method.sampler, samples=(12, 8), final=6, resolutions=(8, 8), channels=8, anneal_steps=2
                ),
                content=replace(method.content, encoder=content.encoder, field=content.field),
                semantic=replace(config.semantic, samples=48),
            )
    return config


@pytest.mark.parametrize("name", ["lite", "marked, poses, tones", "uniform, no semantics", "paper"])
def test_training_is_that_of_the_cpu_without_waits_or_copies(
    world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    config = variant(name, world.config)
    steps = Steps(monkeypatch)
    change = marked if name.startswith("marked") else None
    run, reports = on_device(config, tmp_path / "device", steps, change=change)
    assert steps.waits == [0] * STEPS
    assert steps.uploads[2:] == [0] * (STEPS - 2), "constants are copied when they are first met"
    expected = agrees(run, config, tmp_path, change=change)
    assert reports[-1].losses == pytest.approx(expected.losses, rel=1e-5, abs=1e-9)


def test_a_step_that_is_not_finite_changes_nothing(
    world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on the CPU, but told at a report."""
    monkeypatch.setattr(driver, "REPORT_SECONDS", 1e9)
    config = replace(world.config, steps=STEPS)
    run, reports = on_device(config, tmp_path / "device", change=spoilt(NAN, 1, 2))
    expected = agrees(run, config, tmp_path, change=spoilt(NAN, 1, 2))
    steps = [value for name, value in parameters(run, 4).items() if name.endswith(".step")]
    assert steps and all(float(step) == 2 for step in steps)
    assert reports[-1].skipped == expected.skipped == 2
    assert reports[-1].losses == pytest.approx(expected.losses, rel=1e-5, abs=1e-9)
    assert [event["skipped"] for event in events(run, "skipped")] == ["rgb"]


def test_apple_s_device_needs_no_float64(world: World, tmp_path: Path) -> None:
    """Poses and tones as well; images stay in host memory, which it shares."""
    config = replace(world.config, steps=2, poses=0.02, tones=True)
    with pretend_cuda(mps=True):
        run, reports = trained(replace(config, device="mps:0"), tmp_path / "mps")
        prepared = prepared_for(config)
        scene = prepared.scene
        model = build_model(config, prepared.facts)
        checkpoint.restore(checkpoint.load(run.checkpoints, 2).state, model, None)
        found = measure_style(config, model.to("mps:0"), scene.cameras, scene.train)
    _, expected = trained(config, tmp_path / "cpu")
    assert reports[-1].losses == pytest.approx(expected[-1].losses, rel=1e-5, abs=1e-9)
    assert bool(found.mean.isfinite().all())


class Foreign(Altered):
    """A data manager of another package that draws in host memory alone; it notes steps and threads."""

    to = DataManager.to

    def __init__(self, inner: DataManager, change: Change) -> None:
        super().__init__(inner, change)
        self.asked: list[tuple[int, bool]] = []

    def batch(self, step: int) -> Batch:
        self.asked.append((step, threading.current_thread() is threading.main_thread()))
        return super().batch(step)


@pytest.mark.parametrize("foreign", [True, False])
def test_batches_of_host_memory_come_one_step_ahead(
    world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, foreign: bool
) -> None:
    """Those of a data manager that draws in host memory alone, and those that the device has no room for."""
    config = replace(world.config, steps=STEPS)
    steps = Steps(monkeypatch)
    made = []

    def wrap(inner: DataManager, change: Change) -> DataManager:
        made.append(Foreign(inner, change) if foreign else Altered(inner, change))
        return made[-1]

    small = config if foreign else replace(config, device_memory=1e-9)
    run, _ = on_device(small, tmp_path / "device", steps, change=lambda step, batch: batch, wrap=wrap)
    assert steps.waits == [0] * STEPS
    assert steps.uploads[2:] == [5] * (STEPS - 2), "view, pixel, colour and two kinds of features"
    if foreign:
        assert made[0].asked == [(0, True), *((step, False) for step in range(1, STEPS + 1))]
    agrees(run, config, tmp_path)


def test_a_thread_draws_again_after_going_back() -> None:
    asked = []

    class Numbers(DataManager):
        def batch(self, step: int) -> Batch:
            asked.append(step)
            if step == 5:
                raise ValueError("no such step")
            return Batch(torch.tensor([step]), torch.zeros(1, 2), torch.zeros(1, 3))

        def image(self, view: int) -> torch.Tensor:
            raise NotImplementedError

    batches = learner.Batches(Numbers(), torch.device("meta"))
    assert [int(batches(step).view) for step in (0, 1, 2, 0, 1, 4)] == [0, 1, 2, 0, 1, 4]
    with pytest.raises(ValueError, match="no such step"):
        batches(5)
    assert asked[:8] == [0, 1, 2, 3, 0, 1, 2, 4]


def test_features_are_made_on_the_device(
    world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with pretend_cuda() as seen:
        assert device_of("auto") == CUDA
        there = prepared_for(replace(world.config, device="auto"))
    assert seen.uploads["aten._to_copy.default"] > 2 * len(there.scene.train), "each image, to each encoder"
    here = world.prepared.manager.batch(0)
    batch = there.manager.batch(0)
    for kind, scale in (
        ("content", there.facts.of_field.content_scale),
        ("semantic", there.facts.of_field.semantic_scale),
    ):
        assert (getattr(batch, kind) - getattr(here, kind)).abs().max() <= 1e-3 * scale


def test_a_block_is_trained_on_a_device(
    block_world: BlockWorld, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A block inside of surroundings that the CPU has trained."""
    root = tmp_path / "run"
    steps = Steps(monkeypatch)
    shutil.copytree(block_world.root, root)
    config, method = Run(root).load_config()
    Run(root).save_config(replace(config, device="cuda:0"), method)
    unfinish(root, 1)
    with pretend_cuda() as steps.seen:
        assert world_of_blocks(block_world.config, root).train(root, 1)
    assert set(steps.waits) == {0} and set(steps.uploads[2:]) == {0}
    found = tensors_of(root, "01")
    expected = tensors_of(block_world.root, "01")
    assert found.keys() == expected.keys()
    for key, value in expected.items():
        assert (found[key] - value).double().norm() <= 1e-5 * value.double().norm(), key


STYLIZERS = (AdainConfig(), LocalAdainConfig(), RegionOtConfig(), RegionToneConfig())


@pytest.mark.parametrize("stylizer", STYLIZERS, ids=lambda config: type(config).__name__)
def test_every_stylizer_is_drawn_on_a_device(world: World, stylizer: StylizerConfig) -> None:
    style = StyleFile(StyleConfig(references=world.references, stylizer=stylizer, clusters=4))
    drawn = []
    for device, within in (("cpu", backend.plain), (str(CUDA), pretend_cuda)):
        with within():
            run = load_run(world.run, device)
            drawn.append(run.restyled(apply_style(run, style).restyle).render(run.cameras, 2).rgb)
    torch.testing.assert_close(*drawn, rtol=0, atol=1e-4)


def test_blocks_of_a_large_scene_are_rendered_on_a_device(block_world: BlockWorld) -> None:
    found = []
    for device, within in (("cpu", backend.plain), (str(CUDA), pretend_cuda)):
        with within():
            trained = load_run(block_world.root, device, max_memory=1.0)
            found.append(trained.render(trained.cameras, 2)[:3])
    # Off the CPU points are turned into a block without a matrix product: sums of three, in another order.
    torch.testing.assert_close(*found, rtol=1e-5, atol=1e-5)
