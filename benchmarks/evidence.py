"""All figures of docs/evidence, made again: `python -m benchmarks evidence [--only NAME ...] [--scenes DIR] [--runs DIR]`.

The town is trained first where `--runs` does not hold it yet. Every page carries commit, machine, versions and seeds; seconds
aside, the same commit on the same machine writes the same figures. Tables whose scene is absent are skipped, and said to be.
"""

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from fprf.cli import main as cli
from fprf.cli.parsing import parse
from fprf.errors import FprfError, UsageError

from .__main__ import main as benchmark
from .common import RESULTS, ROOT, SHARED
from .town.write import cached_town

PAGES = ROOT / "docs/evidence"
LIGHTS = ("--palettes", "autumn", "winter", "sunset", "night")
TOWN = ("--steps", "800", *LIGHTS)
SCENES: Mapping[str, tuple[str, str]] = {"reconstruction": ("fox", "2"), "reconstruction-flower": ("llff_flower", "2")}
STYLES = ("clusters", "multi-reference", "statistics", "large-scale", "time")
TRAININGS = ("ablation", "guided-filter")
NAMES = ("restyle", *STYLES, *TRAININGS, *SCENES)


@dataclass(frozen=True, kw_only=True)
class EvidencePages:
    """What is made again."""

    only: tuple[str, ...] = ()
    """Names of pages; none = all of them."""
    scenes: Path = SHARED / "data/scenes"
    """Folder with the photographed scenes fox and llff_flower."""
    runs: Path = ROOT / "runs"
    """Folder for the town's run; one that is there is used."""
    steps: int = 2400
    """Steps that the town is trained for."""
    device: str = "cpu"
    """cpu, cuda, mps, or auto."""

    def __post_init__(self) -> None:
        for name in self.only:
            if name not in NAMES:
                raise UsageError(f"--only {name}: no such page; allowed are {', '.join(NAMES)}")


def command(name: str, config: EvidencePages) -> list[str]:
    """Name and flags of the benchmark that makes a page."""
    device, run = ["--device", config.device], str(config.runs / "town")
    if name == "restyle":
        files = ["--output", str(RESULTS / "restyle_town.json"), "--page", str(PAGES / "restyle.md")]
        return ["restyle", run, *files, "--sheet", str(PAGES / "restyle.jpg"), *device]
    files = ["--output", str(PAGES / f"paper-{name}.json"), "--page", str(PAGES / f"paper-{name}.md")]
    table = ["paper", "--table", "reconstruction" if name in SCENES else name]
    if name in SCENES:
        scene, smaller = SCENES[name]
        return [*table, "--data", str(config.scenes / scene), "--downscale", smaller, "--steps", "2000", *files, *device]
    return [*table, *(TOWN if name in TRAININGS else ("--run", run)), *files, *device]


def main(argv: list[str]) -> int:
    try:
        config = parse(EvidencePages(), argv, prog="python -m benchmarks evidence", description=__doc__ or "")
    except FprfError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    wanted = config.only or NAMES
    run = config.runs / "town"
    if {"restyle", *STYLES} & set(wanted) and not (run / "style.safetensors").is_file():
        train = ["train", "fprf-lite", "--data", str(cached_town()), "--steps", str(config.steps), "--output", str(run)]
        if code := cli.main([*train, "--device", config.device]):
            return code
    worst = 0
    for name in wanted:
        if name in SCENES and not (config.scenes / SCENES[name][0]).is_dir():
            print(f"{name}: skipped, no {config.scenes / SCENES[name][0]}", file=sys.stderr)
            continue
        print("python -m benchmarks " + " ".join(command(name, config)), file=sys.stderr)
        worst = max(worst, benchmark(command(name, config)))
    return worst
