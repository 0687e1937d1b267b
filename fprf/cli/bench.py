"""`fprf bench NAME [RUN]`: measure a run, or a scene that is trained on the spot."""

import importlib
import tempfile
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from ..benchmarking.config import (
    BenchConfig,
    MemoryConfig,
    ParetoConfig,
    ProfileConfig,
    ScalingConfig,
    SpeedConfig,
    StressConfig,
)
from ..errors import UsageError
from . import evidence
from .parsing import load_field_method, parse
from .progress import Display
from .train import train_scene

__all__ = ["NAMES", "run"]

NAMES: dict[str, BenchConfig] = {
    "speed": SpeedConfig(),
    "profile": ProfileConfig(),
    "pareto": ParetoConfig(),
    "memory": MemoryConfig(),
    "scaling": ScalingConfig(),
    "stress": StressConfig(),
}
"""Defaults of each benchmark; `fprf.benchmarking.NAME` has a function of its name."""


WIDTH = 120
"""Columns of a table that goes to a file."""


def run(args: list[str]) -> int:
    """`fprf bench NAME [RUN] ...`: 0 when the figures are printed and, with --output, written."""
    name, rest = (args[0], args[1:]) if args else ("", [])
    if name in ("", "-h", "--help"):
        print(_usage())
        return 0 if name else 2
    if name in evidence.NAMES:
        return evidence.run(name, rest)
    if name not in NAMES:
        raise UsageError(f"fprf bench {name}: no such benchmark; allowed are {', '.join([*NAMES, *evidence.NAMES])}")
    if rest and not rest[0].startswith("-"):  # tyro has no positional argument that may be absent
        rest = ["--run", *rest]
    default = NAMES[name]
    config = parse(default, rest, prog=f"fprf bench {name} [RUN]", description=_about(default))
    with tempfile.TemporaryDirectory(prefix="fprf-bench-") as made:
        folder = Path(made)
        root = config.run or _train(config, folder / "run")
        from ..io.atomic import write_json

        measure = getattr(importlib.import_module(f"fprf.benchmarking.{name}"), name)
        with Display() as display:
            outcome = measure(config, root, folder, display.count)
        console = Console(highlight=False)
        if not console.is_terminal:
            console.width = WIDTH
        for table in outcome.tables:
            console.print(table)
        if config.output is not None:
            write_json(config.output, outcome.document)
    return 0


def _train(config: BenchConfig, output: Path) -> Path:
    method, name = load_field_method(config.method)
    data = config.data or method.data or Path("town")
    return train_scene(replace(method, data=data, output=output, steps=config.steps, minutes=None, device=config.device), name)


def _about(config: BenchConfig) -> str:
    return (type(config).__doc__ or "").strip()


def _usage() -> str:
    every = {name: _about(config) for name, config in NAMES.items()}
    every |= {name: evidence.about(config) for name, config in evidence.NAMES.items()}
    width = max(map(len, every))
    lines = [f"usage: fprf bench {'|'.join(every)} [RUN] [--output JSON] [any field]", ""]
    lines += [f"  {name:<{width}}  {text}" for name, text in every.items()]
    lines += ["", "`fprf bench NAME --help` lists every field; without RUN a scene is trained first, --data DIR by --method."]
    return "\n".join(lines)
