"""One part of the work in a process of its own: `python -m fprf.benchmarking.memory_part`, a JSON object on standard input.

A process only ever grows in its books: the most that a part holds is what a fresh process that does nothing else held.
"""

import json
import sys
from pathlib import Path
from typing import Any

from .config import MemoryConfig

__all__ = ["PARTS", "main", "peak_mib"]

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
    from ..evaluation.judge import peak_memory

    return peak_memory()


def main() -> int:
    """Do the part that standard input names, and print what it took."""
    asked = json.load(sys.stdin)
    device = _do(asked["part"], asked)
    print(json.dumps({"peak_rss_mib": peak_mib(), "peak_device_mib": device}))
    return 0


def _do(part: str, asked: dict[str, Any]) -> float | None:
    """Most device memory in MiB, where the device has its own."""
    import torch

    from .subject import find, fresh_model, test_view
    from .training import loop_of

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
        from ..plugins.stylizers.config import RegionOtConfig
        from ..training.restyle import restyle
        from ..training.views import render_view

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


if __name__ == "__main__":
    sys.exit(main())
