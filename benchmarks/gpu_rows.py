"""Measurements of `gpu.sh` as one JSON: its steps, and rows with their goals.

    python -m benchmarks.gpu_rows WORK --output FILE

WORK holds steps.jsonl, a log of each step and, as far as the steps came, speed.json and the metrics.json of
run, gaussians and long. Rows of what is missing are left out. The exit status is 1 where a step failed.
"""

import argparse
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from fprf.io.atomic import write_json
from fprf.ops import triplane

from .report import Row, document, rows_table, table

FRAME = 1008 * 756
STYLES = ("stylised, region-tone", "stylised, region-ot", "stylised, local-adain")
SAID = 3000
"""Characters that are kept of the end of a failed step's log."""


def steps(work: Path) -> list[dict[str, Any]]:
    """Every step with its seconds; of those that failed the end of the log."""
    found = [json.loads(line) for line in (work / "steps.jsonl").read_text().splitlines()]
    for each in found:
        each["passed"] = each["status"] == 0
        log = work / f"{each['step']}.log"
        if log.is_file() and (not each["passed"] or each["step"] == "tests"):
            each["said"] = log.read_text(errors="replace")[-SAID:]
    return found


def rows(work: Path, form: str) -> Iterator[Row]:
    """`form` names the tri-plane kernels that run here."""
    run = read(work / "run" / "metrics.json")
    measured = read(work / "speed.json")
    if run is not None:
        about = f"{run['method']} on {run['scene']}, {run['train_steps']} steps, {run['views']} views judged"
        yield Row(
            name="training, features included", figure=run["train_seconds"] / 60, unit="min", note=about
        )
        yield Row(name="held-out PSNR", figure=run["psnr"], unit="dB", more_is_better=True, goal=26.0)
    splats = read(work / "gaussians" / "metrics.json")
    log = work / "gaussians.log"
    if splats is not None:
        by = (
            "gsplat"
            if log.is_file() and "by gsplat" in log.read_text(errors="replace")
            else "the CPU's kernels"
        )
        note = f"by {by}, {splats['train_steps']} steps, {splats['train_seconds'] / 60:.1f} min"
        yield Row(
            name="held-out PSNR of 3D Gaussians",
            figure=splats["psnr"],
            unit="dB",
            note=note,
            more_is_better=True,
        )
    far = read(work / "long" / "metrics.json")
    if far is not None:
        note = f"{far['train_steps']} steps, {far['train_seconds'] / 60:.1f} min"
        yield Row(name="held-out PSNR of the long training", figure=far["psnr"], unit="dB", note=note)
    if measured is None:
        return
    of = {row["name"]: row for row in measured["rows"]}
    if "train" in of:
        yield Row(name="training", figure=of["train"]["figure"], unit="rays/s")
    for name in STYLES:
        yield Row(
            name=f"{name}, frames of 1008x756",
            figure=of[name]["figure"] / FRAME,
            low=of[name]["low"] / FRAME,
            high=of[name]["high"] / FRAME,
            unit="1/s",
            goal=60.0,
            more_is_better=True,
            error=of[name]["error"],
            error_kind=of[name]["error_kind"],
            note=f"measured on views of {measured['settings']['view']}",
        )
    first, dictionary = (
        of[f"new reference to {what}"]["figure"] for what in ("the first view", "its dictionary")
    )
    yield Row(name="a new style to its dictionary", figure=1e3 * dictionary, unit="ms")
    yield Row(name="a new style to its first frame", figure=1e3 * first, unit="ms", goal=100.0)
    for name, row in of.items():
        if name.startswith("tri-plane forward + backward"):
            kept = ("figure", "unit", "low", "high", "peer", "error", "error_kind", "peer_error", "note")
            yield Row(name=f"{form} {name}", **{key: row[key] for key in kept})


def kernels(device: torch.device) -> str:
    """Name of the form of the tri-planes that runs."""
    points = torch.zeros(1, 3, device=device)
    table = torch.zeros(12, 8, device=device)
    return (
        "numba"
        if triplane.usable(points, table)
        else "triton"
        if triplane.triton_usable(points, table)
        else "plain"
    )


def read(path: Path) -> Any:
    return json.loads(path.read_text()) if path.is_file() else None


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("work", type=Path)
    parser.add_argument("--output", type=Path, required=True)
    options = parser.parse_args()
    work = options.work
    gone = steps(options.work)
    speed = read(work / "speed.json") or {}
    device = torch.device("cuda:0" if torch.cuda.is_available() else "cpu")
    form = kernels(device)
    found = list(rows(work, form))
    training = (read(work / "training.json") or {}).get("steps")
    extra = {
        "steps": gone,
        "speed": speed.get("rows"),
        "counters": speed.get("counters"),
        "training_steps": training,
    }
    settings = speed.get("settings", {}) | {"tri_planes": form}
    write_json(options.output, document("gpu", found, device=device, settings=settings, extra=extra))
    console = Console(highlight=False, width=120)
    ended = (
        (each["step"], "passed" if each["passed"] else f"failed ({each['status']})", f"{each['seconds']} s")
        for each in gone
    )
    console.print(table("steps", ("step", "", "took"), ended))
    console.print(rows_table("on this device", found))
    console.print(f"written to {options.output}")
    return 0 if all(each["passed"] for each in gone) else 1


if __name__ == "__main__":
    sys.exit(main())
