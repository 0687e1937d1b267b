"""`fprf bench memory`: the most memory that each part of the work holds, and what the model itself takes."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from torch import nn

from ..errors import FprfError
from .config import MemoryConfig
from .memory_part import PARTS
from .report import Outcome, Row, document, rows_table
from .subject import attempt, find, fresh_model, settings

__all__ = ["memory", "mib"]

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
    command = [sys.executable, "-m", "fprf.benchmarking.memory_part"]
    ended = subprocess.run(command, input=json.dumps(asked), capture_output=True, text=True, check=False)
    if ended.returncode != 0:
        lines = ended.stderr.strip().splitlines()
        raise FprfError(f"fprf bench memory: {asked['part']} ended with {ended.returncode}: {lines[-1] if lines else ''}")
    result: dict[str, float | None] = json.loads(ended.stdout.splitlines()[-1])
    return result
