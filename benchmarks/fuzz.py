"""Mutated files by the million: every reader must answer each with a value or with one line, and neither die,
hang nor grow.

    python -m benchmarks fuzz [--rounds 1000000] [--seed 0] [--only NAME ...] [--output benchmarks/results/fuzz.json]

Each reader runs in a process of its own, a few thousand mutations at a time, with 2 GiB of address space more
than it has at its start. A process that dies is an entry in the report and the next one goes on behind it; so
is one that is silent for five minutes. What an output file already holds of the same seed is gone on from: a
night's run may be stopped.
"""

import json
import os
import resource
import select
import signal
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from .common import arguments, report
from .readers import Target, fuzz, targets

CHUNK = 4000
"""Mutations between two reports of a process."""
SILENCE = 300.0
"""Seconds without a report after which a process hangs."""
ROOM = 2 << 30
"""Bytes of address space beyond what a process has at its start."""


def fresh() -> dict[str, Any]:
    return {
        "rounds": 0,
        "read": 0,
        "refused": 0,
        "faults": [],
        "slowest_seconds": 0.0,
        "grown_mib": 0.0,
        "cpu_seconds": 0.0,
    }


def work(target: Target, first: int, rounds: int, seed: int, to: int) -> None:
    """In a child: chunk after chunk, a line for each."""
    quiet = os.open(os.devnull, os.O_WRONLY)  # image libraries speak of every broken file
    os.dup2(quiet, 1)
    os.dup2(quiet, 2)
    target.read()
    size = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGESIZE")
    resource.setrlimit(resource.RLIMIT_AS, (size + ROOM, size + ROOM))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    while first < rounds:
        start = time.process_time()
        count = min(CHUNK, rounds - first)
        found = fuzz(target, count, seed, first=first, quick=True)
        report = {
            "rounds": count,
            "read": found.values,
            "refused": found.refusals,
            "faults": found.faults,
            "slowest_seconds": found.slowest,
            "grown_mib": (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024,
            "cpu_seconds": time.process_time() - start,
        }
        os.write(to, (json.dumps(report) + "\n").encode())
        first += count


def add(total: dict[str, Any], part: dict[str, Any]) -> None:
    """One chunk more."""
    for name in ("rounds", "read", "refused", "cpu_seconds"):
        total[name] += part[name]
    total["faults"] = (total["faults"] + list(part["faults"]))[:20]
    for name in ("slowest_seconds", "grown_mib"):
        total[name] = max(total[name], part[name])


def watch(
    target: Target,
    total: dict[str, Any],
    rounds: int,
    seed: int,
    silence: float = SILENCE,
    keep: Callable[[], None] = lambda: None,
) -> None:
    """One child from where `total` stands, until it is done, dies or falls silent; `keep` is called now and
    then.
    """
    whole = target.file.read_bytes()
    from_child, to = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            os.close(from_child)
            work(target, total["rounds"], rounds, seed, to)
            os._exit(0)
        finally:
            os._exit(1)
    os.close(to)
    with os.fdopen(from_child, "rb") as lines:
        while True:
            ready, _, _ = select.select([lines], [], [], silence)
            line = lines.readline() if ready else b""
            if not line:
                break
            add(total, json.loads(line))
            if total["rounds"] % (10 * CHUNK) == 0:
                keep()
    if not ready:
        os.kill(child, signal.SIGKILL)
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    target.file.write_bytes(whole)
    if status:
        what = f"ended with {status}" if ready else f"was silent for {silence:.0f} s"
        first = total["rounds"]
        add(
            total,
            fresh()
            | {"rounds": min(CHUNK, rounds - first), "faults": [f"{first} and on: the process {what}"]},
        )


def measure(folder: Path, rounds: int, seed: int, only: list[str], output: Path | None) -> dict[str, Any]:
    """All readers, one after the other."""
    command = f"python -m benchmarks fuzz --rounds {rounds} --seed {seed}"
    document: dict[str, Any] = {"command": command, "rounds": rounds, "seed": seed, "readers": {}}
    if output is not None and output.exists() and (old := json.loads(output.read_text()))["seed"] == seed:
        document["readers"] = old["readers"]

    def keep() -> None:
        if output is not None:
            report(output, document)

    chosen = [target for target in targets(folder) if not only or target.name in only]
    for target in chosen:
        total = document["readers"].setdefault(target.name, fresh())
        while total["rounds"] < rounds:
            watch(target, total, rounds, seed, keep=keep)
            print(target.name, json.dumps(total), flush=True)
            keep()
    return document


def main(argv: list[str]) -> None:
    parser = arguments("fuzz", __doc__)
    parser.add_argument("--rounds", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="*", default=[], metavar="NAME")
    parser.add_argument("--output", type=Path)
    asked = parser.parse_args(argv)
    with tempfile.TemporaryDirectory(
        prefix="fprf-fuzz-", dir="/dev/shm" if Path("/dev/shm").is_dir() else None
    ) as folder:
        measure(Path(folder) / "files", asked.rounds, asked.seed, asked.only, asked.output)
