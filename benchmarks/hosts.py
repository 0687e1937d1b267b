"""A cluster of two hosts loses one while blocks are trained: they are finished all the same, to the same bits.

    sudo python -m benchmarks hosts [--blocks 4] [--steps 200] [--output FILE]

Linux, root, `ip` and the extra `cluster`. The hosts are two network namespaces of this machine with a cable between them; they
share the file system, as docs/large-scenes.md asks for. Ray's head runs on the first, a worker on each. As soon as both
train a block the second host is cut off and all its processes are killed.
"""

import json
import os
import secrets
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from .common import RESULTS, report
from .executors import arguments, environment, flags, same_bits, timed

FIRST, SECOND = "fprf-a", "fprf-b"
ADDRESS = {FIRST: "10.77.0.1", SECOND: "10.77.0.2"}
PORT = 6391


def inside(host: str, *command: str) -> list[str]:
    """A command on a host."""
    return ["ip", "netns", "exec", host, *command]


@contextmanager
def hosts() -> Iterator[None]:
    """Two namespaces and a cable; afterwards there is none, and nothing runs there any more."""
    _ip("link", "add", "fprf0", "type", "veth", "peer", "name", "fprf1")
    try:
        for host, cable in ((FIRST, "fprf0"), (SECOND, "fprf1")):
            _ip("netns", "add", host)
            _ip("link", "set", cable, "netns", host)
            _ip("-n", host, "addr", "add", f"{ADDRESS[host]}/24", "dev", cable)
            for name in (cable, "lo"):
                _ip("-n", host, "link", "set", name, "up")
        yield
    finally:
        for host in (FIRST, SECOND):
            kill(host)
            subprocess.run(["ip", "netns", "del", host], check=False, stderr=subprocess.DEVNULL)


def _ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True)


def pids(host: str) -> list[int]:
    """Processes of a host."""
    found = subprocess.run(["ip", "netns", "pids", host], capture_output=True, text=True, check=False).stdout
    return [int(pid) for pid in found.split()]


def kill(host: str) -> int:
    """End all of a host's processes at once; how many there were."""
    count = 0
    for pid in pids(host):
        try:
            os.kill(pid, signal.SIGKILL)
            count += 1
        except ProcessLookupError:
            pass
    return count


def begun(root: Path) -> dict[str, str]:
    """Blocks that are being trained now, and on which host's process."""
    notes = {path.parent.name: path.read_text() for path in (root / "blocks").glob("*/.lock")}
    place = {pid: host for host in (FIRST, SECOND) for pid in pids(host)}
    return {name: place.get(int(note.split()[1]), "") for name, note in notes.items() if note.startswith("process ")}


def main(argv: list[str]) -> None:
    parser = arguments(__doc__ or "")
    parser.set_defaults(blocks=4, views=48, steps=200, scratch=Path("runs/hosts"))
    parser.add_argument("--output", type=Path, default=RESULTS / "hosts.json")
    options = parser.parse_args(argv)
    options.scratch = options.scratch.resolve()
    timed(options, options.scratch / "serial")
    root = options.scratch / "cluster"
    shutil.rmtree(root, ignore_errors=True)
    ray = str(Path(sys.executable).with_name("ray"))
    own = environment(options.scratch) | {
        "RAY_USAGE_STATS_ENABLED": "0",
        "RAY_AUTH_MODE": "token",
        "RAY_AUTH_TOKEN": secrets.token_hex(32),
        "RAY_health_check_period_ms": "1000",
        "RAY_health_check_failure_threshold": "3",
    }
    common = ["--num-cpus", "1", "--object-store-memory", str(2**27), "--disable-usage-stats"]
    with hosts():
        head = ["--head", "--node-ip-address", ADDRESS[FIRST], "--port", str(PORT), "--include-dashboard", "false", *common]
        join = ["--address", f"{ADDRESS[FIRST]}:{PORT}", "--node-ip-address", ADDRESS[SECOND], *common]
        for host, words in ((FIRST, head), (SECOND, join)):
            subprocess.run(inside(host, ray, "start", *words), env=own, check=True, stdout=subprocess.DEVNULL)
        address = f"{ADDRESS[FIRST]}:{PORT}"
        command = [sys.executable, "-m", "fprf", *flags(options, root), "--executor", "ray", "--executor.address", address]
        command += ["--checkpoint-minutes", "0.05"]
        train = subprocess.Popen(inside(FIRST, *command), env=own, stdout=subprocess.DEVNULL)
        lost = _lose(root, train)
        code = train.wait()
    result: dict[str, Any] = {
        "hosts": 2,
        "blocks": options.blocks,
        "steps_each": options.steps,
        "exit": code,
        **lost,
        "same_bits_as_undisturbed": code == 0 and same_bits(options.scratch / "serial", root),
    }
    print(json.dumps(result, indent=1))
    report(options.output, result)


def _lose(root: Path, train: "subprocess.Popen[bytes]") -> dict[str, Any]:
    """Wait until the second host has a checkpoint of a block, then take it away; what it was doing."""
    while train.poll() is None:
        for name, host in begun(root).items():
            saved = sorted((root / "blocks" / name / "checkpoints").glob("step-*/manifest.json"))
            if host == SECOND and name != "surroundings" and saved:
                _ip("-n", SECOND, "link", "set", "fprf1", "down")
                return {"lost_block": name, "its_last_checkpoint": saved[-1].parent.name, "processes_killed": kill(SECOND)}
        time.sleep(0.05)
    return {"lost_block": None}
