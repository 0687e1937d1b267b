"""Stress: every stage on adversarial inputs, each against a reference and a bound."""

import random
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import torch
from torch import Tensor

from fprf.checks import at_least
from fprf.config import RenderConfig
from fprf.datamanagers.bounds import find_space
from fprf.datamanagers.scene import ParsedScene
from fprf.errors import FprfError
from fprf.io import tensorfiles
from fprf.plugins.stylizers.config import RegionOtConfig
from fprf.rendering.cameras import Cameras
from fprf.rendering.renderer import render_rays
from fprf.style.config import StyleConfig
from fprf.style.files import StyleFile
from fprf.style.look import Restyle
from fprf.style.restyle import apply_style
from fprf.testing import cases
from fprf.training.facts import Facts
from fprf.training.field_scene import Trained
from fprf.training.model import Model, background_of
from fprf.types import Rays, Want

from .common import BenchConfig, bench_run
from .readers import fuzz, targets
from .report import Outcome, machine, table
from .stress_operators import Check, clusters, guided, matching, sampling, statistics, stylizers, weights
from .subject import attempt, exact, find, settings, test_view, view_rays


@dataclass(frozen=True, kw_only=True)
class StressConfig(BenchConfig):
    """Every stage on adversarial inputs, each against a reference and a bound."""

    steps: int = 60
    """Steps to train it."""
    mutations: int = 200
    """Mutated files for each reader."""
    flips: int = 200
    """Flipped bits in a file of tensors."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("mutations", "flips"):
            at_least(name, getattr(self, name), 1)


Progress = Callable[[int, int, str], None]


def stress(config: StressConfig, root: Path, folder: Path, progress: Progress) -> Outcome:
    """All rows; `falls_short` of the document names those whose bound is broken."""
    subject = find(root, config, folder)
    trained = subject.trained
    prepared, missing = attempt(subject)
    scene = prepared.scene if prepared is not None else None
    stages: dict[str, Callable[[], list[Check]]] = {
        "rendering": weights,
        "sampling": sampling,
        "statistics": statistics,
        "clusters": clusters,
        "matching": matching,
        "stylizers": stylizers,
        "guided filter": guided,
        "readers": lambda: readers(folder / "files", config.mutations, config.seed),
        "damage": lambda: damage(folder / "damage", config.flips, config.seed),
        "pipeline": lambda: invariants(trained, scene, test_view(config, trained), subject.references),
    }
    checks: list[Check] = []
    for number, (name, run) in enumerate(stages.items()):
        progress(number, len(stages), name)
        checks += run()
    progress(len(stages), len(stages), "stress")
    broken = [check for check in checks if not check.passed]
    document = {
        "benchmark": "stress",
        "settings": settings(config, trained, missing),
        "machine": machine(trained.model.device),
        "rows": [check.json() for check in checks],
        "falls_short": [f"{check.stage}: {check.input}" for check in broken],
    }
    title = f"{len(checks)} checks, {len(broken)} broken"
    shown = table(
        title, ("", "input", "reference", "bound", "measured", ""), (_cells(check) for check in checks)
    )
    return Outcome(document, [shown])


def _cells(check: Check) -> list[str]:
    bound = f"{'≥' if check.at_least else '≤'} {check.bound:.3g} {check.unit}"
    return [
        check.stage,
        check.input,
        check.reference,
        bound,
        f"{check.measured:.3g}",
        "" if check.passed else "BROKEN",
    ]


def readers(folder: Path, rounds: int, seed: int) -> list[Check]:
    """So many mutations for each reader."""
    rows = []
    for target in targets(folder):
        found = fuzz(target, rounds, seed)
        told = f"{rounds} mutations: {found.values} read, {found.refusals} refused in one line"
        rows.append(
            _file_row(f"{target.name}, {told}", "a value or one line", len(found.faults), 0, "others")
        )
    return rows


def damage(folder: Path, flips: int, seed: int) -> list[Check]:
    """Flipped bits in a file of tensors with its checksums."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "sealed.safetensors"  # nosec B311  # no secrets
    draw = random.Random(seed)  # nosec B311  # no secrets
    made = {
        "planes": cases.normal(16, 64, seed=28),
        "mean": cases.normal(64, seed=29),
        "step": torch.tensor([7]),
    }
    tensorfiles.save(path, made, sealed=True)
    whole = path.read_bytes()
    found = wrong = 0
    for _ in range(flips):
        raw = bytearray(whole)
        raw[draw.randrange(len(raw))] ^= 1 << draw.randrange(8)
        path.write_bytes(raw)
        try:
            read = tensorfiles.load_sealed(path)
        except FprfError:
            found += 1
        else:
            wrong += any(name not in read or not torch.equal(read[name], t) for name, t in made.items())
    return [
        _file_row(
            f"{flips} flipped bits in sealed tensors, {found} refused",
            "never wrong numbers",
            wrong,
            0,
            "wrong",
        )
    ]


def _file_row(name: str, reference: str, measured: float, bound: float, unit: str) -> Check:
    return Check(stage="files", input=name, reference=reference, measured=measured, bound=bound, unit=unit)


OFFSET = (1e6, -3e6, 5e5)
"""Metres: of the size of UTM coordinates."""


def invariants(
    trained: Trained, scene: ParsedScene | None, cameras: Cameras, references: tuple[Path, ...]
) -> list[Check]:
    """Of one view; what needs the scene's images or points is left out without them."""
    model = trained.model
    facts = trained.known.facts
    rays = view_rays(model, cameras, 0)
    plain = colours(model, facts, rays, trained.config.render)
    whole = colours(model, facts, rays, replace(trained.config.render, budget=0.0))
    rows = [
        _row(
            "float32, nothing skipped",
            "float64",
            decibels(whole, exact(model, facts, rays)),
            100.0,
            "dB",
            at_least=True,
        ),
        _row(
            "as configured, samples skipped", "float64", _largest(plain, exact(model, facts, rays)), 1 / 256
        ),
        *_orders(trained, rays, plain),
        *_threads(trained, rays, plain),
    ]
    if scene is not None:
        rows += _worlds(trained, scene, cameras, plain)
    return rows + _styles(trained, rays, plain, references)


@torch.inference_mode()
def colours(
    model: Model, facts: Facts, rays: Rays, config: RenderConfig, look: Restyle | None = None
) -> Annotated[Tensor, "R 3"]:
    """Colours in [0, 1], chunk by chunk, as views are rendered."""
    background = background_of(facts, rays.near.device)
    found = []
    for start in range(0, len(rays.near), config.chunk):
        part = Rays(*(x[start : start + config.chunk] for x in rays))
        out = render_rays(
            part, model.parts, want=Want.COLOUR, budget=config.budget, background=background, restyle=look
        )
        assert out.rgb is not None
        found.append(out.rgb)
    return torch.cat(found).clamp(0, 1)


def decibels(found: Tensor, truth: Tensor) -> float:
    """PSNR; 200 where nothing differs."""
    error = float((found.double() - truth.double()).square().mean())
    return min(200.0, -10 * float(torch.tensor(max(error, 1e-20), dtype=torch.float64).log10()))


def _orders(trained: Trained, rays: Rays, plain: Tensor) -> list[Check]:
    """The same rays in another order, and in other chunks."""
    order = torch.randperm(len(plain), generator=torch.Generator().manual_seed(0)).to(plain.device)
    shuffled = colours(
        trained.model, trained.known.facts, Rays(*(x[order] for x in rays)), trained.config.render
    )
    small = replace(trained.config.render, chunk=max(1, len(plain) // 7))
    parts = colours(trained.model, trained.known.facts, rays, small)
    return [
        _row("rays in another order", "the same image", _largest(shuffled, plain[order]), 1e-6),
        _row("rays in other chunks", "the same image", _largest(parts, plain), 1e-6),
    ]


def _threads(trained: Trained, rays: Rays, plain: Tensor) -> list[Check]:
    before = torch.get_num_threads()
    try:
        found = []
        for threads in (1, 2):
            torch.set_num_threads(threads)
            found.append(colours(trained.model, trained.known.facts, rays, trained.config.render))
    finally:
        torch.set_num_threads(before)
    return [_row("1 and 2 threads", "the same bits", _largest(*found), 0.0)]


def _worlds(trained: Trained, scene: ParsedScene, cameras: Cameras, plain: Tensor) -> list[Check]:
    """The capture moved and scaled as a whole: its space is found anew, the model lives in that."""
    worlds = []
    if len(scene.paths) > 2:
        # The first and the last view say which way a capture runs, and so which of two equal spaces it has.
        inner = torch.randperm(len(scene.paths) - 2, generator=torch.Generator().manual_seed(1)) + 1
        order = torch.cat([torch.tensor([0]), inner, torch.tensor([len(scene.paths) - 1])])
        worlds.append(
            ("views between the first and the last in another order", _reordered(scene, order), cameras)
        )
    for name, scale, offset in (
        ("world 1e6 m away", 1.0, torch.tensor(OFFSET, dtype=torch.float64)),
        ("world 1e6 times larger", 1e6, torch.zeros(3, dtype=torch.float64)),
        ("world 1e6 times smaller", 1e-6, torch.zeros(3, dtype=torch.float64)),
    ):
        worlds.append((name, _moved(scene, scale, offset), _placed(cameras, scale, offset)))
    rows = []
    model = trained.model
    for name, other, view in worlds:
        own = model.space
        model.space = find_space(other)
        try:
            found = colours(model, trained.known.facts, view_rays(model, view, 0), trained.config.render)
        finally:
            model.space = own
        rows.append(_row(name, "the same image", _largest(found, plain), 1e-3))
    return rows


def _styles(trained: Trained, rays: Rays, plain: Tensor, references: tuple[Path, ...]) -> list[Check]:
    model = trained.model
    facts = trained.known.facts
    config = trained.config.render
    there = apply_style(
        trained, StyleFile(StyleConfig(references=references, stylizer=RegionOtConfig()))
    ).restyle
    back = apply_style(
        trained, StyleFile(StyleConfig(references=references[::-1], stylizer=RegionOtConfig()))
    ).restyle
    none = apply_style(
        trained, StyleFile(StyleConfig(references=references, stylizer=RegionOtConfig(), strength=0.0))
    ).restyle
    styled, turned, still = (colours(model, facts, rays, config, look) for look in (there, back, none))
    return [
        _row("references in another order", "the same image", _largest(turned, styled), 1e-6),
        _row("strength 0", "the plain image, bit for bit", _largest(still, plain), 0.0),
        _row(
            "restyled, float32, nothing skipped",
            "float64",
            _styled_error(trained, rays, there),
            60.0,
            "dB",
            at_least=True,
        ),
    ]


def _styled_error(trained: Trained, rays: Rays, look: Restyle) -> float:
    whole = replace(trained.config.render, budget=0.0)
    found = colours(trained.model, trained.known.facts, rays, whole, look)
    return decibels(found, exact(trained.model, trained.known.facts, rays, look))


def _reordered(scene: ParsedScene, order: Annotated[Tensor, "V"]) -> ParsedScene:
    inverse = torch.argsort(order)
    return replace(
        scene,
        paths=tuple(scene.paths[i] for i in order.tolist()),
        cameras=scene.cameras.select(order),
        train=inverse[scene.train],
        test=inverse[scene.test],
        depths=None if scene.depths is None else scene.depths[order],
        seen=None if scene.seen is None else torch.stack([inverse[scene.seen[:, 0]], scene.seen[:, 1]], 1),
        exposure=None if scene.exposure is None else scene.exposure[order],
    )


def _moved(scene: ParsedScene, scale: float, offset: Annotated[Tensor, "3"]) -> ParsedScene:
    return replace(
        scene,
        cameras=_placed(scene.cameras, scale, offset),
        points=None if scene.points is None else scale * scene.points.double() + offset,
        depths=None if scene.depths is None else scale * scene.depths,
    )


def _placed(cameras: Cameras, scale: float, offset: Annotated[Tensor, "3"]) -> Cameras:
    pose = cameras.pose.clone()
    pose[:, :, 3] = scale * pose[:, :, 3] + offset
    return replace(cameras, pose=pose)


def _largest(found: Tensor, truth: Tensor) -> float:
    return float((found.double() - truth.double()).abs().max())


def _row(
    name: str,
    reference: str,
    measured: float,
    bound: float,
    unit: str = "of [0, 1]",
    *,
    at_least: bool = False,
) -> Check:
    return Check(
        stage="pipeline",
        input=name,
        reference=reference,
        measured=measured,
        bound=bound,
        unit=unit,
        at_least=at_least,
    )


def main(argv: list[str]) -> int:
    """`python -m benchmarks stress [RUN] [flags]`."""
    return bench_run("python -m benchmarks stress", StressConfig(), argv, stress)
