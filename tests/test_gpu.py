"""Training, views and styles on a CUDA device: a pretended one in every run of the tests, a real one with `pytest -m gpu`.

Tolerances are those of a real device, where sums have another order and more or fewer samples may be kept. Other tests hold
the pretended device to tighter ones.
"""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from pretend_cuda import CUDA, pretend_cuda
from tiny_world import World, prepared_for, taught

from fprf.config import TrainConfig
from fprf.ops import triplane
from fprf.plugins.stylizers.config import AdainConfig, LocalAdainConfig, RegionOtConfig, RegionToneConfig, StylizerConfig
from fprf.style.config import StyleConfig
from fprf.style.files import StyleFile
from fprf.style.restyle import apply_style
from fprf.style.scene_style import to_tensors
from fprf.training import driver, learner
from fprf.training.driver import Report
from fprf.training.loading import load_run
from fprf.training.run import Run
from fprf.training.style_pass import measure_style
from fprf.training.views import render_view
from fprf.types import View

LEVEL = 1 / 255


class Device:
    """A CUDA device, and whether it is a real one."""

    def __init__(self, seen: Any | None) -> None:
        self.at, self.seen, self.real = CUDA, seen, seen is None

    def watched(self) -> AbstractContextManager[None]:
        """Nothing within it makes the host wait."""
        return self._refused() if self.real else self._counted()

    @contextmanager
    def _refused(self) -> Iterator[None]:
        torch.cuda.set_sync_debug_mode("error")
        try:
            yield
        finally:
            torch.cuda.set_sync_debug_mode("default")

    @contextmanager
    def _counted(self) -> Iterator[None]:
        assert self.seen is not None
        before = self.seen.syncs.copy()
        yield
        assert not self.seen.syncs - before


@pytest.fixture
def card() -> torch.device:
    """A real CUDA device."""
    if not torch.cuda.is_available():
        pytest.skip("torch sees no CUDA device")
    return CUDA


@pytest.fixture(params=["pretended", pytest.param("cuda", marks=pytest.mark.gpu)])
def device(request: pytest.FixtureRequest) -> Iterator[Device]:
    if request.param == "pretended":
        with pretend_cuda() as seen:
            yield Device(seen)
    else:
        request.getfixturevalue("card")
        yield Device(None)


def held_out(world: World, root: Path, device: str) -> tuple[View, float]:
    """A held-out view of a run, and its PSNR."""
    trained, scene = load_run(root, device), world.prepared.scene
    view = int(scene.test[0])
    drawn = render_view(trained.model, trained.known.facts, scene.cameras, view, trained.config.render)
    error = (drawn.rgb - world.prepared.manager.image(view)).square().mean()
    return drawn, float(-10 * error.log10())


def trained(
    config: TrainConfig, folder: Path, watch: Device | None = None, monkeypatch: pytest.MonkeyPatch | None = None
) -> Run:
    """A run that can be loaded; with `watch` no step but the first three, which meet constants, may wait."""
    prepared, run = prepared_for(config), Run(folder)
    folder.mkdir()
    run.save_config(replace(config, output=None), "fprf-lite")
    run.save_known(prepared.scene, config.data, prepared.facts)
    if watch is not None and monkeypatch is not None:
        plain = learner.FieldLearner.step

        def step(loop: learner.FieldLearner, number: int, share: float) -> Any:
            with watch.watched() if number > 2 else nullcontext():
                return plain(loop, number, share)

        monkeypatch.setattr(learner.FieldLearner, "step", step)
        monkeypatch.setattr(driver, "REPORT_SECONDS", 1e9)
    reports: list[Report] = []
    taught(config, prepared, run, reports.append)
    assert reports[-1].skipped == 0 and all(torch.tensor(value).isfinite() for value in reports[-1].losses.values())
    return run


def test_training_ends_where_the_cpu_ends_and_no_step_waits(
    world: World, tmp_path: Path, device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = replace(world.config, steps=50 if device.real else 6)
    trained(replace(config, device=str(device.at)), tmp_path / "device", device, monkeypatch)
    monkeypatch.undo()
    monkeypatch.setenv("XDG_CACHE_HOME", str(world.folder / "cache"))
    trained(config, tmp_path / "cpu")
    _, there = held_out(world, tmp_path / "device", str(device.at))
    _, here = held_out(world, tmp_path / "cpu", "cpu")
    assert there == pytest.approx(here, abs=0.3 if device.real else 0.01)


def test_views_are_those_of_the_cpu(world: World, device: Device) -> None:
    here, _ = held_out(world, world.run, "cpu")
    there, _ = held_out(world, world.run, str(device.at))
    for name, tolerance in (("rgb", LEVEL / 2), ("opacity", 1e-3)):
        a, b = getattr(here, name), getattr(there, name)
        assert b.device.type == "cpu" and (a - b).abs().max() <= tolerance and (a - b).abs().mean() <= tolerance / 20
    assert there.kept == pytest.approx(here.kept, rel=0.01)


STYLES = [AdainConfig(), LocalAdainConfig(), RegionOtConfig(), RegionToneConfig()]
STYLES += [LocalAdainConfig(similarity="dot", centred=False, relative=False, temperature=1.0)]


@pytest.mark.parametrize("stylizer", STYLES, ids=lambda config: type(config).__name__)
def test_styles_are_those_of_the_cpu(world: World, device: Device, stylizer: StylizerConfig) -> None:
    drawn = []
    for at in ("cpu", str(device.at)):
        run = load_run(world.run, at)
        look = apply_style(run, StyleFile(StyleConfig(references=world.references, stylizer=stylizer, clusters=4))).restyle
        drawn.append(render_view(run.model, run.known.facts, run.known.cameras, 2, run.config.render, look).rgb)
    assert (drawn[0] - drawn[1]).abs().max() <= 4 * LEVEL and (drawn[0] - drawn[1]).abs().mean() <= LEVEL / 10


def test_the_scenes_own_style_is_that_of_the_cpu(world: World, device: Device) -> None:
    scene = world.prepared.scene
    here, there = (
        to_tensors(measure_style(world.config, load_run(world.run, at).model, scene.cameras, scene.train))
        for at in ("cpu", str(device.at))
    )
    for name, value in here.items():
        assert there[name].device.type == "cpu", name
        if device.real:
            assert (there[name] - value).norm() <= 1e-3 * (1e-6 + value.norm()), name
        else:
            assert (there[name] - value).abs().max() <= 1e-5 * (1 + value.abs().max()), name


@pytest.mark.gpu
def test_planes_of_the_methods_size_are_looked_up(card: torch.device) -> None:
    """A million points against float64."""
    resolutions, channels, draw = (64, 128, 256, 512), 32, torch.Generator().manual_seed(0)
    points = torch.empty(2**20, 3).uniform_(-1.1, 1.1, generator=draw).to(card)
    table = torch.empty(triplane.rows(resolutions), channels).uniform_(-1, 1, generator=draw).to(card)
    found = triplane.lookup(points, table.requires_grad_(True), resolutions)
    (gradient,) = torch.autograd.grad(found.sum(), table)
    wide = table.detach().double().requires_grad_(True)
    total = torch.zeros_like(wide)
    for part, mine in zip(points.split(2**17), found.detach().split(2**17), strict=True):
        value = triplane.lookup_reference(part.double(), wide, resolutions)
        # Coordinates are rounded to 512 u of a cell, in which a product of three samples changes by at most 12.
        assert (mine - value).abs().max() <= 4 * 2.0**-24 * (512 * 12 + 3)
        total += torch.autograd.grad(value.sum(), wide)[0]
    assert (gradient - total).norm() <= 1e-4 * total.norm()


@pytest.mark.gpu
def test_memory_does_not_grow_with_the_steps(
    card: torch.device, world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken: list[int] = []
    plain = learner.FieldLearner.step

    def step(loop: learner.FieldLearner, number: int, share: float) -> Any:
        torch.cuda.reset_peak_memory_stats()
        result = plain(loop, number, share)
        taken.append(torch.cuda.max_memory_allocated())
        return result

    monkeypatch.setattr(learner.FieldLearner, "step", step)
    trained(replace(world.config, steps=50, device=str(card)), tmp_path / "run")
    assert max(taken[40:]) <= 1.1 * max(taken[5:15]) < 512 << 20
