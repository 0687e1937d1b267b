"""Blocks on two workers of Ray against one after the other: how much sooner they are done, and that they are the same bits.

    python -m benchmarks executors [--blocks 8] [--views 200] [--steps 250] [--workers 2] [--output FILE]

Needs the extra `cluster`. Both sides run `fprf train` in processes of their own on one thread, for the same steps, with the
features extracted before. `speedup` is that of the whole command, the surroundings (which come first, alone) and Ray's start
included; `blocks_speedup` that of the blocks alone, from the surroundings' end to the last block's. Times are wall times: the
machine must be free.

The file: `blocks`, `steps_each`, `workers`, `processors` (integers); `serial_seconds`, `ray_seconds` and their quotient
`speedup`; `serial_blocks_seconds`, `ray_blocks_seconds` and their quotient `blocks_speedup`; `same_bits` (true or false).
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from .common import RESULTS, report
from .town.write import cached_town

SURROUNDINGS = "surroundings"


def flags(options: argparse.Namespace, output: Path) -> list[str]:
    """`fprf train` of a town street, about 17 m of it in a block."""
    town = cached_town(views=options.views, width=96, height=72, extra=max(0, 17 * options.blocks - 26))
    words = f"""train fprf-lite --data {town} --output {output} --steps {options.steps} --device cpu --checkpoint-minutes 1
        --datamanager.rays 2048
        --blocks grid --blocks.cells {options.blocks} 1 --sampler.resolutions 64 --content.field.resolutions 16 32 64 128
        --semantic.field.resolutions 16 64"""
    return words.split()


def environment(scratch: Path) -> dict[str, str]:
    """One thread a process, and a cache of its own."""
    return os.environ | {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1", "XDG_CACHE_HOME": str(scratch / "cache")}


def timed(options: argparse.Namespace, output: Path, *more: str) -> float:
    """Wall seconds of a training."""
    shutil.rmtree(output, ignore_errors=True)
    command = [sys.executable, "-m", "fprf", *flags(options, output), *more]
    start = time.perf_counter()
    subprocess.run(command, env=environment(options.scratch), check=True, stdout=subprocess.DEVNULL)
    return time.perf_counter() - start


def blocks_seconds(root: Path) -> float:
    """From the end of the surroundings to that of the last block."""
    ended = {path.parent.name: path.stat().st_mtime for path in (root / "blocks").glob("*/done.json")}
    return max(when for name, when in ended.items() if name != SURROUNDINGS) - ended[SURROUNDINGS]


def same_bits(root: Path, other: Path) -> bool:
    """Whether all blocks of two runs hold the same numbers."""
    names = sorted(path.parent.name for path in (root / "blocks").glob("*/done.json"))
    theirs = sorted(path.parent.name for path in (other / "blocks").glob("*/done.json"))
    return names == theirs and all(_tensors(root, name) == _tensors(other, name) for name in names)


def _tensors(root: Path, name: str) -> Any:
    return json.loads((root / "blocks" / name / "done.json").read_text())["tensors"]  # with a checksum for each


def arguments(about: str) -> argparse.ArgumentParser:
    """Those of this benchmark and of `hosts`."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--blocks", type=int, default=8)
    parser.add_argument("--views", type=int, default=200)
    parser.add_argument("--steps", type=int, default=250)
    parser.add_argument("--scratch", type=Path, default=Path("runs/executors"))
    return parser


def main(argv: list[str]) -> None:
    parser = arguments(__doc__ or "")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--output", type=Path, default=RESULTS / "executors.json")
    options = parser.parse_args(argv)
    options.scratch = options.scratch.resolve()
    # Features, and compiled kernels, are there before any clock runs.
    subprocess.run(
        [sys.executable, "-m", "fprf", *flags(options, options.scratch / "first"), "--steps", "1"],
        env=environment(options.scratch),
        check=True,
        stdout=subprocess.DEVNULL,
    )
    serial = timed(options, options.scratch / "serial")
    ray = timed(options, options.scratch / "ray", "--executor", "ray", "--executor.workers", str(options.workers))
    alone, together = (blocks_seconds(options.scratch / name) for name in ("serial", "ray"))
    result = {
        "blocks": options.blocks,
        "steps_each": options.steps,
        "workers": options.workers,
        "processors": os.cpu_count(),
        "serial_seconds": serial,
        "ray_seconds": ray,
        "speedup": serial / ray,
        "serial_blocks_seconds": alone,
        "ray_blocks_seconds": together,
        "blocks_speedup": alone / together,
        "same_bits": same_bits(options.scratch / "serial", options.scratch / "ray"),
    }
    print(json.dumps(result, indent=1))
    report(options.output, result)
