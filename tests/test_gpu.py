"""Training, views and styles on a real CUDA device (`pytest -m gpu`) against the CPU.

Tolerances are those of a device where sums have another order and more or fewer samples may be kept. The
pretended device, held to tighter ones in every run of the tests: `training/test_training_on_a_device.py` and
`cli/test_verbs_on_a_device.py`.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from pretend_cuda import CUDA
from tiny_world import World, prepared_for, taught

from fprf.config import TrainConfig
from fprf.ops import triplane
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
from fprf.style.scene_style import to_tensors
from fprf.training import driver
from fprf.training import field_learner as learner
from fprf.training.field_scene import load_run
from fprf.training.run import Run
from fprf.training.style_pass import measure_style
from fprf.training.views import render_view
from fprf.types import View

pytestmark = pytest.mark.gpu
LEVEL = 1 / 255


@pytest.fixture(autouse=True)
def _card() -> None:
    if not torch.cuda.is_available():
        pytest.skip("torch sees no CUDA device")


def held_out(world: World, root: Path, device: str) -> tuple[View, float]:
    """A held-out view of a run, and its PSNR."""
    trained = load_run(root, device)
    scene = world.prepared.scene
    view = int(scene.test[0])
    drawn = render_view(trained.model, trained.known.facts, scene.cameras, view, trained.config.render)
    error = (drawn.rgb - world.prepared.manager.image(view)).square().mean()
    return drawn, float(-10 * error.log10())


def trained(config: TrainConfig, folder: Path) -> Run:
    """A run that can be loaded."""
    prepared = prepared_for(config)
    run = Run(folder)
    reports = list[Report]()
    folder.mkdir()
    run.save_config(replace(config, output=None), "fprf-lite")
    run.save_known(prepared.scene, config.data, prepared.facts)
    taught(config, prepared, run, reports.append)
    assert reports[-1].skipped == 0 and all(
        torch.tensor(value).isfinite() for value in reports[-1].losses.values()
    )
    return run


def test_training_ends_where_the_cpu_ends_no_step_waits_and_memory_does_not_grow(
    world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """But for the first three steps, which meet constants."""
    config = replace(world.config, steps=50)
    plain = learner.FieldLearner.step
    taken = list[int]()

    def step(loop: learner.FieldLearner, number: int, share: float) -> Any:
        torch.cuda.reset_peak_memory_stats()
        torch.cuda.set_sync_debug_mode("error" if number > 2 else "default")
        try:
            return plain(loop, number, share)
        finally:
            torch.cuda.set_sync_debug_mode("default")
            taken.append(torch.cuda.max_memory_allocated())

    with monkeypatch.context() as patch:
        patch.setattr(learner.FieldLearner, "step", step)
        patch.setattr(driver, "REPORT_SECONDS", 1e9)
        trained(replace(config, device=str(CUDA)), tmp_path / "device")
    trained(config, tmp_path / "cpu")
    (_, there), (_, here) = (
        held_out(world, tmp_path / name, at) for name, at in (("device", str(CUDA)), ("cpu", "cpu"))
    )
    assert there == pytest.approx(here, abs=0.3)
    assert max(taken[40:]) <= 1.1 * max(taken[5:15]) < 512 << 20


def test_views_are_those_of_the_cpu(world: World) -> None:
    (here, _), (there, _) = (held_out(world, world.run, at) for at in ("cpu", str(CUDA)))
    for name, tolerance in (("rgb", LEVEL / 2), ("opacity", 1e-3)):
        a = getattr(here, name)
        b = getattr(there, name)
        assert (
            b.device.type == "cpu"
            and (a - b).abs().max() <= tolerance
            and (a - b).abs().mean() <= tolerance / 20
        )
    assert there.kept == pytest.approx(here.kept, rel=0.01)


STYLES = [AdainConfig(), LocalAdainConfig(), RegionOtConfig(), RegionToneConfig()]
STYLES += [LocalAdainConfig(similarity="dot", centred=False, relative=False, temperature=1.0)]


@pytest.mark.parametrize("stylizer", STYLES, ids=lambda config: type(config).__name__)
def test_styles_are_those_of_the_cpu(world: World, stylizer: StylizerConfig) -> None:
    drawn = []
    for at in ("cpu", str(CUDA)):
        run = load_run(world.run, at)
        look = apply_style(
            run, StyleFile(StyleConfig(references=world.references, stylizer=stylizer, clusters=4))
        ).restyle
        drawn.append(
            render_view(run.model, run.known.facts, run.known.cameras, 2, run.config.render, look).rgb
        )
    assert (drawn[0] - drawn[1]).abs().max() <= 4 * LEVEL and (drawn[0] - drawn[1]).abs().mean() <= LEVEL / 10


def test_the_scenes_own_style_is_that_of_the_cpu(world: World) -> None:
    scene = world.prepared.scene
    here, there = (
        to_tensors(measure_style(world.config, load_run(world.run, at).model, scene.cameras, scene.train))
        for at in ("cpu", str(CUDA))
    )
    for name, value in here.items():
        assert there[name].device.type == "cpu", name
        assert (there[name] - value).norm() <= 1e-3 * (1e-6 + value.norm()), name


def test_planes_of_the_methods_size_are_looked_up() -> None:
    """A million points against float64."""
    resolutions = (64, 128, 256, 512)
    channels = 32
    draw = torch.Generator().manual_seed(0)
    points = torch.empty(2**20, 3).uniform_(-1.1, 1.1, generator=draw).to(CUDA)
    table = torch.empty(triplane.rows(resolutions), channels).uniform_(-1, 1, generator=draw).to(CUDA)
    found = triplane.lookup(points, table.requires_grad_(True), resolutions)
    (gradient,) = torch.autograd.grad(found.sum(), table)
    wide = table.detach().double().requires_grad_(True)
    total = torch.zeros_like(wide)
    for part, mine in zip(points.split(2**17), found.detach().split(2**17), strict=True):
        value = triplane.lookup_reference(part.double(), wide, resolutions)
        # Coordinates are rounded to 512 u of a cell, in which a product of three samples changes by at most
        # 12.
        assert (mine - value).abs().max() <= 4 * 2.0**-24 * (512 * 12 + 3)
        total += torch.autograd.grad(value.sum(), wide)[0]
    assert (gradient - total).norm() <= 1e-4 * total.norm()
