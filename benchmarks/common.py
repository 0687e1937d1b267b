"""Common parts of benchmarks: folders, arguments, the run that is measured, costs of commands, and the JSON
that each writes.
"""

import argparse
import json
import os
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeVar

from rich.console import Console

from fprf.checks import at_least
from fprf.cli.parsing import load_method, parse
from fprf.config import TrainConfig, fields_only
from fprf.errors import FprfError
from fprf.io.atomic import write_json, write_text
from fprf.progress import Display
from fprf.training.driver import train

from .report import Outcome, provenance
from .town.write import scene_folder

ROOT = Path(__file__).resolve().parents[1]
SHARED = Path(os.environ.get("FPRF_SHARED", ROOT.parent / "shared"))
"""Folder with `data` and `weights` that the repository does not hold: $FPRF_SHARED, or `shared` beside the
checkout.
"""


def arguments(name: str, about: str | None) -> argparse.ArgumentParser:
    """A parser whose help shows the benchmark's description as it is written."""
    return argparse.ArgumentParser(
        prog=f"python -m benchmarks {name}",
        description=about,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def origin(device: str = "cpu") -> dict[str, object]:
    """Origin of figures: `commit`, `fprf`, `torch`, `machine`, `command`."""
    return provenance(device) | {"command": shlex.join(["python", "-m", "benchmarks", *sys.argv[1:]])}


def report(path: Path | None, figures: Mapping[str, Any], device: str = "cpu") -> None:
    """Write figures as JSON, behind their origin; what they say themselves takes precedence. None writes
    nothing.
    """
    if path is not None:
        write_json(path, {**origin(device), **figures})


def add_entry(path: Path | None, name: str, figures: Mapping[str, Any], device: str = "cpu") -> None:
    """Print figures and write them, with their origin, as one entry of a JSON file; other entries stay."""
    print(name, json.dumps(figures), flush=True)
    if path is not None:
        known = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
        write_json(path, known | {name: {**origin(device), **figures}})


class Cost(NamedTuple):
    """Cost of a command."""

    seconds: float
    processor_seconds: float
    """Of all its threads and processes."""
    peak_rss_mib: float
    """Of the largest of its processes."""


def cost_of(*args: str | Path) -> Cost:
    """Run `fprf ARGS` in a process of its own without showing its output. Raises FprfError with its last
    lines.
    """
    words = [str(each) for each in args]
    start = time.perf_counter()
    with tempfile.TemporaryFile() as said:
        process = subprocess.Popen(
            [sys.executable, "-m", "fprf", *words], stdout=subprocess.DEVNULL, stderr=said
        )
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            said.seek(0)
            lines = said.read().decode(errors="replace").splitlines()
            raise FprfError(
                f"fprf {shlex.join(words)}: exit code {process.returncode}; {' | '.join(lines[-3:])}"
            )
    return Cost(time.perf_counter() - start, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024)


@dataclass(frozen=True, kw_only=True)
class BenchConfig:
    """Measurements and their repetitions."""

    run: Path | None = None
    """Run folder; none = --method is trained on --data for --steps first, in a folder that is thrown away."""
    data: Path | None = None
    """Scene folder, where it has moved since training; without a run the one to train on (none = the
    town).
    """
    method: str = "fprf-lite"
    """Method to train where no run is given."""
    steps: int = 300
    """Steps to train it."""
    references: tuple[Path, ...] = ()
    """Photographs for styles; none = pictures of other towns."""
    repeats: int = 5
    """Rounds: in each one everything that is compared runs once, in turn. Medians and quartiles are over
    them.
    """
    rays: int = 8192
    """Rays of a timed view at most: larger views are measured at a smaller size."""
    clock: Literal["wall", "processor"] = "wall"
    """wall, or processor: seconds that this process kept processors busy, all threads together, which other
    programs on the machine hardly disturb. On the CPU alone.
    """
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


def bench_run(
    prog: str, default: C, args: list[str], measure: Callable[[C, Path, Path, Progress], Outcome]
) -> int:
    """Measure the run that the arguments name, or a scene that is trained first; print the tables and write
    the JSON.

    `measure` gets the config, the run folder, a temporary folder and a function that shows progress.
    """
    about = (type(default).__doc__ or "").strip()
    config = parse(default, args, prog=prog, description=about, positional=("run",))
    with tempfile.TemporaryDirectory(prefix="fprf-bench-") as made:
        folder = Path(made)
        root = config.run or train_run(
            folder / "run", config.method, config.data, steps=config.steps, device=config.device
        )
        with Display() as display:
            outcome = measure(config, root, folder, display.count)
        for table in outcome.tables:
            console().print(table)
        if config.output is not None:
            write_json(config.output, outcome.document)
    return 0


def train_run(output: Path, method: str, data: Path | None, *, steps: int, device: str = "cpu") -> Path:
    """Train fields for the steps; without data on the method's own, or else on the town. Returns the run
    folder.
    """
    chosen, name = field_method(method)
    scene = scene_folder(data or chosen.data or Path("town"))
    return train(replace(chosen, data=scene, output=output, steps=steps, minutes=None, device=device), name)


def field_method(method: str) -> tuple[TrainConfig, str]:
    """Config and name of a method of fields. Raises UsageError for one of another kind."""
    config, name = load_method(method)
    return fields_only(config, Path(method)), name


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
