"""Gain by each compiled kernel of `fprf.ops`, end to end: steps and views with one at a time switched to
plain torch.

    OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 python -m benchmarks kernels [RUN] [--data DIR] [--repeats 7]
    [--output FILE.json]

Every form does the same work on the same model in one process, in turn, by the processor's clock. The fastest
of all rounds counts, which other programs on the machine disturb least.
"""

import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from unittest import mock

import torch
from torch import Tensor

from fprf.config import RenderConfig
from fprf.datamanagers.features import FeatureStore
from fprf.fields.planes import PlanesField
from fprf.interfaces import ContentField
from fprf.ops import adam, backend, dense, mixture, proposal, triplane
from fprf.rendering.cameras import Cameras
from fprf.style.config import StyleConfig
from fprf.style.files import StyleFile
from fprf.style.look import Restyle
from fprf.style.restyle import apply_style
from fprf.training.views import render_view

from .common import arguments, report, train_run
from .report import Watch
from .speed import STYLES, SpeedConfig
from .subject import Subject, find, fresh_model, loop_of, stepper, test_view

Patches = Sequence[tuple[object, str, object]]


def never(*tensors: object, learns: bool | None = None, eps: float = 0.0) -> bool:
    """No kernel applies."""
    return False


def plain_variation(table: Tensor, resolutions: Sequence[int], gradient: object = None) -> Tensor:
    """Total variation, and its gradient, in plain torch."""
    return triplane.variation_reference(table, resolutions)


KERNEL_LOOKUPS = FeatureStore.at


def plain_lookups(store: FeatureStore, view: Tensor, pixel: Tensor, rgb: Tensor) -> Tensor:
    """Guided features by `guided.apply_packed`."""
    there = packed.setdefault(id(store), store.to(torch.device("cpu")))
    return KERNEL_LOOKUPS(there, view, pixel, rgb)


packed: dict[int, FeatureStore] = {}
SWITCHES: dict[str, Patches] = {
    "tri-planes": [(triplane, "usable", never)],
    "tri-planes: total variation": [(triplane, "variation", plain_variation)],
    "networks": [(dense, "usable", never), (dense, "usable_in_training", never)],
    "Adam": [(adam, "usable", never)],
    "proposals and middles": [(proposal, "usable", never)],
    "styles of points": [(mixture, "usable", never)],
    "content and decoder joined": [(PlanesField, "colour", ContentField.colour)],
    "guided features": [(FeatureStore, "at", plain_lookups)],
}
"""Functions that are replaced where a kernel is off."""


@contextmanager
def without(name: str) -> Iterator[None]:
    """One kernel off; "all" asks for the plain forms everywhere, "" for none."""
    with ExitStack() as stack:
        if name == "all":
            stack.enter_context(backend.plain())
        for patch in SWITCHES.get(name, ()):
            stack.enter_context(mock.patch.object(*patch))
        yield


def switched(name: str, call: Callable[[], object]) -> Callable[[], object]:
    """The call with a kernel off."""

    def run() -> object:
        with without(name):
            return call()

    return run


def tasks(subject: Subject, config: SpeedConfig) -> dict[str, Callable[[], object]]:
    """A training step, a plain view and a view in each style."""
    trained = subject.trained
    loop = loop_of(trained.config, subject.prepare(trained.config), fresh_model(trained))
    camera = test_view(config, trained)
    render = trained.config.render
    take = stepper(loop, trained.step)
    every = trained.config.loss.penalty_every

    def steps() -> None:  # one of them has penalties
        for _ in range(every):
            take()

    calls: dict[str, Callable[[], object]] = {f"{every} training steps": steps}
    looks = {"view": None} | {
        f"view, {name}": apply_style(
            trained,
            StyleFile(
                StyleConfig(references=subject.references, stylizer=stylizer, clusters=config.clusters)
            ),
        ).restyle
        for name, stylizer in STYLES.items()
    }
    for name, look in looks.items():
        calls[name] = partial(drawn, subject, camera, render, look)
    return calls


def drawn(subject: Subject, camera: Cameras, render: RenderConfig, look: Restyle | None) -> Tensor:
    """Colours of the view."""
    trained = subject.trained
    return render_view(trained.model, trained.known.facts, camera, 0, render, look).rgb


def main(argv: list[str]) -> None:
    """Measure and write."""
    parser = arguments("kernels", __doc__)
    parser.add_argument(
        "run", type=Path, nargs="?", help="run of fields; by default fprf-lite is trained on the town first"
    )
    parser.add_argument("--data", type=Path)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--steps", type=int, default=300, help="of the run that is trained")
    parser.add_argument("--output", type=Path)
    args = parser.parse_args(argv)
    names = ["", *SWITCHES, "all"]
    rows: dict[str, dict[str, object]] = {name: {} for name in names}
    with tempfile.TemporaryDirectory() as folder:
        run = args.run or train_run(Path(folder) / "run", "fprf-lite", args.data, steps=args.steps)
        config = SpeedConfig(run=run, data=args.data, repeats=args.repeats, clock="processor", device="cpu")
        subject = find(run, config, Path(folder))
        watch = Watch(args.repeats, torch.device("cpu"), "processor")
        for task, call in tasks(subject, config).items():
            seconds = watch.in_turn({name: switched(name, call) for name in names})
            for name in names:
                rows[name][task] = {
                    "milliseconds": 1e3 * min(seconds[name]),
                    "times_slower": min(seconds[name]) / min(seconds[""]),
                }
                print(f"{task:24}{name or 'every kernel':48}{rows[name][task]}", flush=True)
    about = {
        "scene": subject.trained.known.name,
        "step": subject.trained.step,
        "rounds": args.repeats,
        "clock": "processor",
    }
    forms = {name or "every kernel": row for name, row in rows.items()}
    report(args.output, {"run": about, "without": forms})
