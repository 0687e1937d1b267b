"""What `gpu.sh` measured, as one JSON: rows with their goals, and the profile that explains them.

    python benchmarks/gpu_rows.py WORK --output FILE

WORK holds run/metrics.json, speed.json, profile.json and, where a long training was asked for, long/metrics.json.
"""

import argparse
import json
import math
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from fprf.benchmarking.report import Row, document, rows_table
from fprf.ops import triplane_numba, triplane_triton
from fprf.output.atomic import write_json

FRAME = 1008 * 756
STYLES = ("stylised, region-tone", "stylised, region-ot", "stylised, local-adain")


def rows(work: Path) -> list[Row]:
    metrics, speed = read(work / "run" / "metrics.json"), read(work / "speed.json")
    measured = {row["name"]: row for row in speed["rows"]}
    found = [
        Row(
            name="training, features included",
            figure=metrics["train_seconds"] / 60,
            unit="min",
            goal=3.0,
            note=size_of(metrics),
        ),
        Row(name="held-out PSNR", figure=metrics["psnr"], unit="dB", more_is_better=True, goal=long_psnr(work)),
        Row(name="training", figure=measured["train"]["figure"], unit="rays/s"),
    ]
    for name in STYLES:
        row = measured[name]
        found.append(
            Row(
                name=f"{name}, frames of 1008x756",
                figure=row["figure"] / FRAME,
                low=row["low"] / FRAME,
                high=row["high"] / FRAME,
                unit="1/s",
                goal=60.0,
                more_is_better=True,
                error=row["error"],
                error_kind=row["error_kind"],
                note=f"measured on views of {speed['settings']['view']}",
            )
        )
    first = measured["new reference to the first view"]
    found.append(Row(name="a new style to its first frame", figure=1e3 * first["figure"], unit="ms", goal=100.0))
    for name, row in measured.items():
        if name.endswith("of the memory's speed"):
            found.append(Row(name=name, figure=row["figure"], unit="%", goal=50.0, more_is_better=True, note=row["note"]))
    return found


def long_psnr(work: Path) -> float | None:
    """0.1 dB less than the long training reached, if there was one."""
    file = work / "long" / "metrics.json"
    return math.floor(1e3 * (read(file)["psnr"] - 0.1)) / 1e3 if file.is_file() else None


def size_of(metrics: dict[str, Any]) -> str:
    return f"{metrics['method']} on {metrics['scene']}, {metrics['train_steps']} steps, {metrics['views']} views judged"


def kernels(device: torch.device) -> str:
    """Which form of the tri-planes ran."""
    points, table = torch.zeros(1, 3, device=device), torch.zeros(12, 8, device=device)
    return "triton" if triplane_triton.usable(points, table) else "numba" if triplane_numba.usable(points, table) else "plain"


def read(path: Path) -> Any:
    return json.loads(path.read_text())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("--output", type=Path, required=True)
    options = parser.parse_args()
    speed = read(options.work / "speed.json")
    device = torch.device("cpu" if speed["machine"]["device"] == "cpu" else "cuda")
    found = rows(options.work)
    profile = read(options.work / "profile.json")["parts"]
    extra = {"speed": speed["rows"], "counters": speed["counters"], "profile": profile}
    settings = speed["settings"] | {"tri_planes": kernels(device)}
    write_json(options.output, document("gpu", found, device=device, settings=settings, extra=extra))
    console = Console(highlight=False, width=120)
    console.print(rows_table("on this device", found))
    console.print(f"written to {options.output}")


if __name__ == "__main__":
    main()
