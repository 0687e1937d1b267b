"""How fast the viewer is, and whether it keeps memory.

    python -m benchmarks viewer_speed [RUN] [--references a.png b.png] [--parts start drop memory] [--output FILE]

start     `fprf view RUN` until its page and state are served, five times
drop      a photograph dropped on the page in a headless Chromium, until its first restyled picture has arrived; twenty times
memory    200 camera moves and 50 drops in a row: resident memory before and after, and faults of the page

Parts that are not run keep what the output file holds. Seconds are medians with the worst beside.
Needs the extra `viewer`; drop and memory need playwright and a Chromium too. Times want free cores:
the load average is written down.
"""

import json
import os
import statistics
import sys
import tempfile
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path

from .common import ROOT, arguments, report, train_run
from .subject import town_references

sys.path.insert(0, str(ROOT / "tests" / "viewer"))

from browser import front, served

TARGETS = {"start_seconds": 3.0, "drop_seconds": 0.5, "memory_ratio": 1.05}


def spread(values: list[float]) -> dict[str, float]:
    return {"median": round(statistics.median(values), 3), "worst": round(max(values), 3), "count": len(values)}


def start(run: Path, references: list[Path]) -> dict[str, object]:
    """Seconds until the page is there: the first run of all is left out, it fills the system's cache of files."""
    page, ready = [], []
    for _ in range(6):
        begun = time.perf_counter()
        with served(run) as (address, _):
            page.append(time.perf_counter() - begun)
            while True:
                with urllib.request.urlopen(address) as answer:
                    if b"/fprf/page.js" in answer.read():
                        break
                time.sleep(0.02)
            ready.append(time.perf_counter() - begun)
    return {"address_seconds": spread(page[1:]), "start_seconds": spread(ready[1:])}


def drop(run: Path, references: list[Path]) -> dict[str, object]:
    """Seconds from the drop to the next picture, with the camera at rest: it is the coarse one in the new style."""
    with served(run) as (address, _), front(address, 1280, 720) as found:
        found.rest(2.0)
        found.drop(references[0])
        found.rest(2.0)
        seconds = []
        for i in range(20):
            seconds.append(found.drop(references[i % len(references)]))
            found.rest(1.5)
        return {"drop_seconds": spread(seconds), "faults": found.errors}


def memory(run: Path, references: list[Path]) -> dict[str, object]:
    """As the test of the same does, with a scene of real size. The shelf is full before it begins."""
    with served(run, "--pixels", "256") as (address, pid), front(address) as found:
        found.rest(2.0)
        for i in range(14):
            found.drop(references[i % len(references)])
        found.turn(20)
        found.rest(2.0)
        before = resident(pid)
        found.turn(200)
        found.rest(2.0)
        moved = resident(pid)
        for i in range(50):
            found.drop(references[i % len(references)])
        found.rest(2.0)
        after = resident(pid)
        return {
            "before_mib": before,
            "after_moves_mib": moved,
            "after_drops_mib": after,
            "memory_ratio": round(max(moved, after) / before, 3),
            "moves": 200,
            "drops": 50,
            "faults": found.errors,
        }


def resident(pid: int) -> float:
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return round(pages * os.sysconf("SC_PAGE_SIZE") / 2**20, 1)


PARTS: dict[str, Callable[[Path, list[Path]], dict[str, object]]] = {
    "start": start,
    "drop": drop,
    "memory": memory,
}


def main(argv: list[str]) -> None:
    parser = arguments("viewer_speed", __doc__)
    parser.add_argument("run", type=Path, nargs="?", help="by default fprf-lite is trained on the town first")
    parser.add_argument("--references", type=Path, nargs="+", help="photographs; by default pictures of towns")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--steps", type=int, default=300, help="of the run that is trained")
    parser.add_argument("--output", type=Path)
    args = parser.parse_args(argv)
    found: dict[str, object] = {"targets": TARGETS}
    if args.output is not None and args.output.is_file():
        found |= json.loads(args.output.read_text())
    with tempfile.TemporaryDirectory() as folder:
        run = args.run or train_run(Path(folder) / "run", "fprf-lite", None, steps=args.steps)
        references = args.references or list(town_references(Path(folder)))
        for name in args.parts:
            load = {"load_average_before": round(os.getloadavg()[0], 2), "processors": os.cpu_count()}
            found[name] = PARTS[name](run, references) | load
            report(args.output, found)
            print(name, json.dumps(found[name]), flush=True)
