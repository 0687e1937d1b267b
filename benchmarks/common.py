"""What all benchmarks share: folders, arguments, and the report that each writes."""

import argparse
import json
import os
import shlex
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fprf.evaluation.report import provenance
from fprf.io.atomic import write_json

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
