"""Peak memory of each part of the work, each in a process of its own, and the size of the model.

A part runs as `python -m benchmarks.peak_memory` with a JSON object on standard input. Resident memory only grows, so a fresh
process that does nothing else tells what a part holds.
"""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import nn

from fprf.errors import FprfError

from .common import ROOT, BenchConfig, bench_run
from .report import Outcome, Row, document, rows_table
from .subject import attempt, find, fresh_model, settings


@dataclass(frozen=True, kw_only=True)
class MemoryConfig(BenchConfig):
    """Most memory that each part of the work holds, each in a process of its own."""


PARTS = ("import", "load", "render", "restyle", "prepare", "train")
"""Each does what it needs of those before it."""
STEPS = 3
"""Training steps: from the second on the optimiser holds its moments."""


def peak_mib(status: Path = Path("/proc/self/status")) -> float:
    """Most resident memory of this process. On Linux from its own books: `getrusage` counts the parent's before `exec`."""
    if status.is_file():
        for line in status.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 2**10
    from fprf.evaluation.evaluate import peak_memory

    return peak_memory()


def measure_part() -> int:
    """Do the part that standard input names, and print what it took."""
    asked = json.load(sys.stdin)
    device = _do(asked["part"], asked)
    print(json.dumps({"peak_rss_mib": peak_mib(), "peak_device_mib": device}))
    return 0


def _do(part: str, asked: dict[str, Any]) -> float | None:
    """Most device memory in MiB, where the device has its own."""
    import torch

    from .subject import find, fresh_model, loop_of, test_view

    if part == "import":
        return None
    config = MemoryConfig(
        run=Path(asked["run"]),
        data=Path(asked["data"]) if asked["data"] is not None else None,
        device=asked["device"],
        rays=asked["rays"],
        references=tuple(map(Path, asked["references"])),
    )
    subject = find(Path(asked["run"]), config, Path(asked["folder"]))
    trained = subject.trained
    known = trained.known
    if part in ("render", "restyle"):
        from fprf.plugins.stylizers.config import RegionOtConfig
        from fprf.style.restyle import restyle
        from fprf.training.views import render_view

        look = restyle(trained, subject.references, RegionOtConfig()).restyle if part == "restyle" else None
        render_view(trained.model, known.facts, test_view(config, trained), 0, trained.config.render, look)
    elif part in ("prepare", "train"):
        prepared = subject.prepare(trained.config)
        if part == "train":
            loop = loop_of(trained.config, prepared, fresh_model(trained))
            for step in range(STEPS):
                loop.step(trained.step + step, 0.5)
    device = trained.model.device
    return torch.cuda.max_memory_allocated(device) / 2**20 if device.type == "cuda" else None


NAMES = {
    "import": "interpreter and packages",
    "load": "and a loaded run",
    "render": "and a rendered view",
    "restyle": "and its encoders, for a restyled view",
    "prepare": "a run with images and features",
    "train": "and training steps",
}


def memory(config: MemoryConfig, root: Path, folder: Path, progress: Callable[[int, int, str], None]) -> Outcome:
    """One process after the other."""
    subject = find(root, config, folder)
    trained = subject.trained
    prepared, missing = attempt(subject)
    asked = {
        "run": str(root.resolve()),
        "data": str(config.data) if config.data is not None else None,
        "device": config.device,
        "rays": config.rays,
        "references": [str(path.resolve()) for path in subject.references],
        "folder": str(folder.resolve()),
    }
    rows = []
    parts = [part for part in PARTS if prepared is not None or part not in ("prepare", "train")]
    for i, part in enumerate(parts):
        progress(i, len(parts), part)
        taken = _measured({**asked, "part": part})
        rows.append(Row(name=NAMES[part], figure=taken["peak_rss_mib"] or 0.0, unit="MiB, peak"))
        if taken["peak_device_mib"] is not None:
            rows.append(Row(name=f"{NAMES[part]}, on the device", figure=taken["peak_device_mib"], unit="MiB, peak"))
    progress(len(parts), len(parts), "done")
    model = fresh_model(trained)
    rows += [Row(name=f"parameters of the {name}", figure=mib(module), unit="MiB") for name, module in model.named_children()]
    learned = sum(p.numel() * p.element_size() for p in model.learned())
    rows.append(Row(name="gradients and moments while training", figure=3 * learned / 2**20, unit="MiB"))
    about = settings(config, trained, missing) | {"views": len(trained.known.names), "rays": config.rays}
    made = document("memory", rows, device=trained.model.device, settings=about)
    return Outcome(made, [rows_table("memory", rows)])


def mib(module: nn.Module) -> float:
    """Of parameters and buffers."""
    held = [*module.parameters(), *module.buffers()]
    return sum(tensor.numel() * tensor.element_size() for tensor in held) / 2**20


def _measured(asked: dict[str, object]) -> dict[str, float | None]:
    command = [sys.executable, "-m", "benchmarks.peak_memory"]
    paths = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    ended = subprocess.run(
        command, input=json.dumps(asked), capture_output=True, text=True, check=False, env={**os.environ, "PYTHONPATH": paths}
    )
    if ended.returncode != 0:
        lines = ended.stderr.strip().splitlines()
        raise FprfError(f"benchmark peak_memory: {asked['part']} ended with {ended.returncode}: {lines[-1] if lines else ''}")
    result: dict[str, float | None] = json.loads(ended.stdout.splitlines()[-1])
    return result


def main(argv: list[str]) -> int:
    """`python -m benchmarks peak_memory [RUN] [flags]`."""
    return bench_run("python -m benchmarks peak_memory", MemoryConfig(), argv, memory)


if __name__ == "__main__":
    sys.exit(measure_part())
