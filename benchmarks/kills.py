"""Training that is killed again and again after its first checkpoint, many times within a save, and what is
left of it.

    python -m benchmarks kills [--kills 100] [--steps 300] [--seed 0] [--output benchmarks/results/kills.json]

A whole `fprf train` of a tiny town (features, basis, training, statistics; a checkpoint after every step, so
that saving is half of the time) is run once undisturbed. Then the same is started and killed with SIGKILL,
started again, and so on until it ends; and all that until there were as many kills as asked for. Of every ten
kills one falls anywhere between the start of the process and its first save, four at a random moment after
it, and five as soon after such a moment as a half-written file is seen. Every end must be bitwise the
undisturbed one: parameters, moments, scene statistics; nothing unfinished may be left.
"""

import contextlib
import importlib
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from fprf.config import StatisticsConfig, TrainConfig
from fprf.datamanagers.config import RayBatchesConfig
from fprf.fields.config import PlanesConfig, SemanticPlanesConfig
from fprf.methods import fprf_lite
from fprf.plugins.samplers.config import ProposalConfig
from fprf.training import blocks, driver, prepare, style_pass
from fprf.training.checkpoint import load
from fprf.training.checkpoint import steps as saved

from .common import arguments, report
from .town.write import write_town

KILLED = -9
PARTS = (blocks, prepare, style_pass, driver)
"""Imports of a training: here already, so that children start at once."""
SPAN = 0.7
"""Seconds after a process's first save within which it is killed."""
START = 1.0
"""Seconds in which an early kill falls: a start takes about as long."""
KINDS = ("early", *("later",) * 4, *("saving",) * 5)


def tiny(data: Path, steps: int) -> TrainConfig:
    """The method fprf-lite with a few thousand numbers."""
    lite = fprf_lite()
    return replace(
        lite,
        data=data,
        steps=steps,
        device="cpu",
        checkpoint_minutes=1e-9,
        datamanager=RayBatchesConfig(rays=256, semantic_share=0.5),
        sampler=ProposalConfig(samples=(16,), final=8, resolutions=(8,), anneal_steps=10),
        content=replace(
            lite.content, field=PlanesConfig(resolutions=(8, 16), channels=8, hidden=32, layers=1)
        ),
        semantic=replace(
            lite.semantic,
            field=SemanticPlanesConfig(resolutions=(8,), channels=8, hidden=16, layers=1),
            dim=8,
        ),
        statistics=StatisticsConfig(rays=2048, regions=4),
    )


def in_child(work: Callable[[], object], due: Callable[[float], bool] = lambda seconds: False) -> int:
    """Run in a forked process, which is killed once `due` of its seconds says so; its exit code, or minus the
    signal.
    """
    start = time.monotonic()
    process = os.fork()
    if process == 0:
        code = 1
        try:
            work()
            code = 0
        except Exception:
            traceback.print_exc()
        finally:
            os._exit(code)
    while True:
        done, status = os.waitpid(process, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        if due(time.monotonic() - start):
            os.kill(process, signal.SIGKILL)
            return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
        time.sleep(0.0005)


def import_as(work: Callable[[], object], note: Path) -> None:
    """Import here all that `work` imports, so that forked processes find it: most of a start would go to
    imports.
    """

    def tell() -> None:
        work()
        note.write_text("\n".join(sys.modules))

    if in_child(tell):
        raise SystemExit("the undisturbed run failed")
    for name in note.read_text().split("\n"):
        with contextlib.suppress(Exception):
            importlib.import_module(name)
    if threading.active_count() > 1:
        raise SystemExit("an import started a thread, which forked processes would miss")


def moment(run: Path, kind: str, draw: random.Random, pace: float) -> Callable[[float], bool]:
    """When to kill a process: a function that says, of its age in seconds, whether it is time."""
    checkpoints = run / "checkpoints"
    first = max(saved(checkpoints), default=0)
    wait = draw.uniform(0, pace if kind == "early" else SPAN)
    begun: list[float] = []

    def due(seconds: float) -> bool:
        if kind == "early":
            return seconds > wait
        if not begun and max(saved(checkpoints), default=0) > first:
            begun.append(seconds)
        if not begun or seconds < begun[0] + wait:
            return False
        return kind == "later" or saving(run)

    return due


def contents(run: Path) -> dict[str, bytes]:
    """All numbers that a run ends with, by name."""
    last = saved(run / "checkpoints")[-1]
    whole = load(run / "checkpoints", last)
    named = {
        **{f"model.{k}": v for k, v in whole.model.items()},
        **{f"adam.{k}": v for k, v in whole.optimizer.items()},
    }
    found = {name: tensor.numpy().tobytes() for name, tensor in named.items()} | {"step": str(last).encode()}
    return found | {
        name: (run / name).read_bytes() for name in ("style.safetensors", "basis.safetensors", "config.json")
    }


def strays(run: Path) -> list[str]:
    """Hidden files, and folders of checkpoints without a manifest."""
    with contextlib.suppress(FileNotFoundError):  # the process that is watched writes and removes
        found = [p for p in run.rglob(".*") if p.is_file()]
        found += [p for p in run.glob("checkpoints/*") if not (p / "manifest.json").is_file()]
        return [str(p.relative_to(run)) for p in found]
    return []


def saving(run: Path) -> bool:
    """True where a checkpoint is half written."""
    return any(name.startswith("checkpoints") for name in strays(run))


def measure(
    folder: Path, *, kills: int, steps: int, seed: int, say: Callable[[str], None] = lambda line: None
) -> dict[str, object]:
    """Kill at least so often; the answer tells how it went."""
    os.environ["XDG_CACHE_HOME"] = str(folder / "cache")
    in_child(lambda: write_town(folder / "town", seed=0, palette="day", views=10, width=32, height=24))
    config = tiny(folder / "town", steps)

    def train(name: str) -> Callable[[], object]:
        return lambda: driver.train(replace(config, output=folder / name), "fprf-lite", quiet=True)

    import_as(train("warm-up"), folder / "modules")  # this one makes the features, too
    start = time.monotonic()
    if in_child(train("straight")):
        raise SystemExit("the undisturbed run failed")
    usual = time.monotonic() - start
    wanted = contents(folder / "straight")
    draw = random.Random(seed)
    runs = equal = cut_saves = 0
    killed: list[tuple[str, int]] = []
    left: list[str] = []
    failures: list[int] = []
    while len(killed) < kills and not failures:
        run = folder / f"killed-{runs}"
        while True:
            kind = KINDS[len(killed) % len(KINDS)] if killed else "later"
            code = in_child(train(run.name), moment(run, kind, draw, START))
            if code == 0:
                break
            if code != KILLED:
                failures.append(code)
                break
            killed.append((kind, max(saved(run / "checkpoints"), default=0)))
            cut_saves += saving(run)
        runs += 1
        if not failures:
            equal += contents(run) == wanted
            left += strays(run)
        say(f"{len(killed)} kills, {equal} of {runs} runs bitwise equal")
        shutil.rmtree(run)
    return {
        "kills": len(killed),
        "runs": runs,
        "bitwise_equal": equal,
        "unfinished_files_left": left,
        "other_failures": failures,
        "kills_past_the_first_checkpoint": sum(step > 0 for _, step in killed),
        "kills_that_cut_a_save": cut_saves,
        "undisturbed_seconds": round(usual, 2),
        "steps": steps,
        "checkpoint_every_steps": 1,
        "newest_checkpoint_at_kills": [step for _, step in killed],
    }


def main(argv: list[str]) -> None:
    parser = arguments("kills", __doc__)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path)
    asked = parser.parse_args(argv)
    with tempfile.TemporaryDirectory(prefix="fprf-kills-") as folder:
        found = measure(Path(folder), kills=asked.kills, steps=asked.steps, seed=asked.seed, say=print)
    command = f"python -m benchmarks kills --kills {asked.kills} --steps {asked.steps} --seed {asked.seed}"
    document = {"command": command, **found}
    print(json.dumps({k: v for k, v in document.items() if k != "newest_checkpoint_at_kills"}, indent=1))
    if asked.output is not None:
        report(asked.output, document)
