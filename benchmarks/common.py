"""What all benchmarks share: folders, arguments, the subject that is measured, and the report that each writes."""

import argparse
import json
import os
import shlex
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeVar

from rich.console import Console

from fprf.checks import at_least
from fprf.cli.parsing import as_flag, load_field_method, parse
from fprf.io.atomic import write_json, write_text
from fprf.progress import Display
from fprf.training.driver import train

from .report import Outcome, provenance
from .town.write import scene_folder

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"
SHARED = Path(os.environ.get("FPRF_SHARED", ROOT.parent / "shared"))
"""Folder with `data` and `weights` that the repository does not hold: $FPRF_SHARED, or `shared` beside the checkout."""


def arguments(name: str, about: str | None) -> argparse.ArgumentParser:
    """A parser whose help shows the benchmark's description as it is written."""
    return argparse.ArgumentParser(
        prog=f"python -m benchmarks {name}", description=about, formatter_class=argparse.RawDescriptionHelpFormatter
    )


def split_flags(argv: list[str]) -> tuple[list[str], list[str]]:
    """The arguments before `--`, and those behind it."""
    at = argv.index("--") if "--" in argv else len(argv)
    return argv[:at], argv[at + 1 :]


def origin(device: str = "cpu") -> dict[str, object]:
    """Where figures come from: `commit`, `fprf`, `torch`, `machine`, `command`."""
    return provenance(device) | {"command": shlex.join(["python", "-m", "benchmarks", *sys.argv[1:]])}


def report(path: Path, figures: Mapping[str, Any], device: str = "cpu") -> None:
    """Write figures as JSON, behind their origin; what they say themselves takes precedence."""
    write_json(path, {**origin(device), **figures})


def add_entry(path: Path, name: str, figures: Mapping[str, Any], device: str = "cpu") -> None:
    """Write figures with their origin as one entry of a JSON file; other entries stay."""
    write_json(path, read_report(path) | {name: {**origin(device), **figures}})


def read_report(path: Path) -> dict[str, Any]:
    """The JSON of a file; empty where there is none."""
    found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    return found


@dataclass(frozen=True, kw_only=True)
class BenchConfig:
    """Measurements and their repetitions."""

    run: Path | None = None
    """Run folder; none = --method is trained on --data for --steps first, in a folder that is thrown away."""
    data: Path | None = None
    """Scene folder, where it has moved since training; without a run the one to train on (none = the town)."""
    method: str = "fprf-lite"
    """Method to train where no run is given."""
    steps: int = 300
    """Steps to train it."""
    references: tuple[Path, ...] = ()
    """Photographs for styles; none = pictures of other towns."""
    repeats: int = 5
    """Rounds: in each one everything that is compared runs once, in turn. Medians and quartiles are over them."""
    rays: int = 8192
    """Rays of a timed view at most: larger views are measured at a smaller size."""
    clock: Literal["wall", "processor"] = "wall"
    """wall, or processor: seconds that this process kept processors busy, all threads together, which other programs on the
    machine hardly disturb. On the CPU alone."""
    seed: int = 0
    """Draws of points and batches."""
    output: Path | None = None
    """JSON file for the figures; none = only the table."""
    device: str = "auto"
    """cpu, cuda, mps, or auto."""

    def __post_init__(self) -> None:
        at_least("steps", self.steps, 1)
        at_least("repeats", self.repeats, 1)
        at_least("rays", self.rays, 64)
        at_least("seed", self.seed, 0)


@dataclass(frozen=True, kw_only=True)
class ReportConfig:
    """Fields that every report shares."""

    output: Path | None = None
    """JSON file for the figures; none = only the table."""
    page: Path | None = None
    """Markdown file for them; none = none."""


C = TypeVar("C", bound=BenchConfig)
Progress = Callable[[int, int, str], None]
_WIDTH = 150
"""Columns of a table that goes to a file."""


def bench_run(prog: str, default: C, args: list[str], measure: Callable[[C, Path, Path, Progress], Outcome]) -> int:
    """Measure the run that the arguments name, or a scene that is trained first; print the tables and write the JSON.

    `measure` gets the config, the run folder, a temporary folder and a function that shows progress.
    """
    about = (type(default).__doc__ or "").strip()
    config = parse(default, as_flag(args, "--run"), prog=f"{prog} [RUN]", description=about)
    with tempfile.TemporaryDirectory(prefix="fprf-bench-") as made:
        folder = Path(made)
        root = config.run
        if root is None:
            method, name = load_field_method(config.method)
            data = scene_folder(config.data or method.data or Path("town"))
            training = replace(method, data=data, output=folder / "run", steps=config.steps, minutes=None, device=config.device)
            root = train(training, name)
        with Display() as display:
            outcome = measure(config, root, folder, display.count)
        for table in outcome.tables:
            console().print(table)
        if config.output is not None:
            write_json(config.output, outcome.document)
    return 0


def console() -> Console:
    """A console whose tables are as wide in a file as on a wide terminal."""
    made = Console(highlight=False)
    if not made.is_terminal:
        made.width = _WIDTH
    return made


def write_report(config: ReportConfig, document: dict[str, Any], page: Callable[[], str]) -> None:
    """Write the JSON and the page where the config asks for them."""
    if config.output is not None:
        write_json(config.output, document)
    if config.page is not None:
        write_text(config.page, page())
