"""How fast the viewer is, whether it keeps memory, and what `fprf train --view` costs.

    python -m benchmarks viewer_speed RUN --references a.png b.png [--parts start drop memory training] [--steps 300]
        [--output FILE]

start     `fprf view RUN` until its page and state are served, five times
drop      a photograph dropped on the page in a headless Chromium, until its first restyled picture has arrived; twenty times
memory    200 camera moves and 50 drops in a row: resident memory before and after, and faults of the page
training  time and processor time of one short training of the town: plain, with --view that nobody looks at, and with a page
          open (processor time with the viewer's process); the parameters of all three are compared bit by bit

Writes benchmarks/results/viewer.json; parts that are not run keep what is there. Seconds are medians with the worst beside.
Needs the extra `viewer`; drop, memory and the last line of training need playwright and a Chromium too. Times want free cores:
the load average is written down.
"""

import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path

import torch
from safetensors.torch import load_file

from .common import RESULTS, ROOT, arguments, report
from .town.write import cached_town

sys.path.insert(0, str(ROOT / "tests" / "viewer"))

from browser import front, served

FORMAT = 1
TARGETS = {"start_seconds": 3.0, "drop_seconds": 0.5, "memory_ratio": 1.05}


def spread(values: list[float]) -> dict[str, float]:
    return {"median": round(statistics.median(values), 3), "worst": round(max(values), 3), "count": len(values)}


def start(run: Path, references: list[Path], steps: int) -> dict[str, object]:
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


def drop(run: Path, references: list[Path], steps: int) -> dict[str, object]:
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


def memory(run: Path, references: list[Path], steps: int) -> dict[str, object]:
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


def training(run: Path, references: list[Path], steps: int) -> dict[str, object]:
    """Three trainings of the same town, one after the other."""
    found: dict[str, object] = {"steps": steps}
    parameters = {}
    with tempfile.TemporaryDirectory() as folder:
        for name in ("plain", "nobody", "looked_at"):
            root = Path(folder) / name
            view = [] if name == "plain" else ["--view", "0"]
            found[name] = trained(root, view, steps, look=name == "looked_at")
            last = max(root.glob("checkpoints/step-*"), key=lambda path: path.name)
            parameters[name] = load_file(last / "model.safetensors") | load_file(last / "optimizer.safetensors")
    plain = parameters["plain"]
    for name in ("nobody", "looked_at"):
        other = parameters[name]
        found[f"{name}_bitwise_same"] = plain.keys() == other.keys() and all(torch.equal(plain[k], other[k]) for k in plain)
    return found


def trained(root: Path, view: list[str], steps: int, *, look: bool) -> dict[str, float]:
    """Seconds of the training part alone (events.jsonl), and processor seconds of all that the command did."""
    command = [sys.executable, "-m", "fprf", "train", "fprf-lite", "--data", str(cached_town()), "--steps", str(steps)]
    with subprocess.Popen(
        [*command, "--device", "cpu", "--output", str(root), *view], stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stderr is not None
        address: list[str] = []
        done = threading.Event()

        def read() -> None:
            assert process.stderr is not None
            for line in process.stderr:
                address.extend(re.findall(r'live at (\S+?)"', line))
            done.set()

        threading.Thread(target=read, daemon=True).start()
        pictures = 0
        if look:
            while not address:
                time.sleep(0.05)
            with front(address[0], 640, 480) as page:
                while not done.wait(0.01):
                    page.page.wait_for_timeout(200)
                pictures = len(page.pictures)
        done.wait()
        _, status, usage = os.wait4(process.pid, 0)
    assert status == 0
    events = [json.loads(line) for line in (root / "events.jsonl").read_text().splitlines()]
    seconds = next(event["seconds"] for event in events if event.get("part") == "training")
    processor = usage.ru_utime + usage.ru_stime
    return {"training_seconds": round(seconds, 2), "processor_seconds": round(processor, 1), "pictures": pictures}


def resident(pid: int) -> float:
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return round(pages * os.sysconf("SC_PAGE_SIZE") / 2**20, 1)


PARTS: dict[str, Callable[[Path, list[Path], int], dict[str, object]]] = {
    "start": start,
    "drop": drop,
    "memory": memory,
    "training": training,
}


def main(argv: list[str]) -> None:
    parser = arguments("viewer_speed", __doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--references", type=Path, nargs="+", required=True)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--steps", type=int, default=300, help="of the trainings")
    parser.add_argument("--output", type=Path, default=RESULTS / "viewer.json")
    args = parser.parse_args(argv)
    found: dict[str, object] = json.loads(args.output.read_text()) if args.output.is_file() else {}
    found |= {"format": FORMAT, "targets": TARGETS}
    for name in args.parts:
        load = round(os.getloadavg()[0], 2)
        found[name] = PARTS[name](args.run, args.references, args.steps) | {
            "load_average_before": load,
            "processors": os.cpu_count(),
        }
        report(args.output, found)
        print(name, json.dumps(found[name]), flush=True)
