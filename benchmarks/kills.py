"""Training that is killed at random moments, again and again, and what is left of it.

    python benchmarks/kills.py [--kills 100] [--steps 60] [--seed 0] [--output benchmarks/results/kills.json]

A whole `fprf train` of a tiny town (features, basis, training, statistics; a checkpoint after every step, so that many kills
hit one) is run once undisturbed. Then the same is started and killed with SIGKILL after a random time, started again, and so
on until it ends; and all that until there were as many kills as asked for. Every end must be bitwise the undisturbed one:
parameters, moments, scene statistics; nothing unfinished may be left in the folder.
"""

import argparse
import json
import os
import random
import shutil
import signal
import tempfile
import time
import traceback
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from fprf.commands.train import train_scene
from fprf.config import StatisticsConfig, TrainConfig
from fprf.datamanagers.config import RayBatchesConfig
from fprf.engine import lay_out, prepare, style_pass, trainer
from fprf.engine.checkpoint import load
from fprf.engine.checkpoint import steps as saved
from fprf.fields.config import PlanesConfig, SemanticPlanesConfig
from fprf.methods import fprf_lite
from fprf.output.atomic import write_json
from fprf.plugins.samplers.config import ProposalConfig
from fprf.town.write import write_town

KILLED = -9
PARTS = (lay_out, prepare, style_pass, trainer)
"""What a training imports when it begins: here already, so that children start at once."""


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
        content=replace(lite.content, field=PlanesConfig(resolutions=(8, 16), channels=8, hidden=32, layers=1)),
        semantic=replace(lite.semantic, field=SemanticPlanesConfig(resolutions=(8,), channels=8, hidden=16, layers=1), dim=8),
        statistics=StatisticsConfig(rays=2048, regions=4),
    )


def in_child(work: Callable[[], object], kill_after: float | None = None) -> int:
    """Run in a forked process, which is killed after so many seconds; its exit code, or minus the signal."""
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
    end = None if kill_after is None else time.monotonic() + kill_after
    while True:
        done, status = os.waitpid(process, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        if end is not None and time.monotonic() > end:
            os.kill(process, signal.SIGKILL)
            end = None
        time.sleep(0.002)


def contents(run: Path) -> dict[str, bytes]:
    """All numbers that a run ends with, by name."""
    last = saved(run / "checkpoints")[-1]
    whole = load(run / "checkpoints", last)
    named = {**{f"model.{k}": v for k, v in whole.model.items()}, **{f"adam.{k}": v for k, v in whole.optimizer.items()}}
    found = {name: tensor.numpy().tobytes() for name, tensor in named.items()} | {"step": str(last).encode()}
    return found | {name: (run / name).read_bytes() for name in ("style.safetensors", "basis.safetensors", "config.json")}


def strays(run: Path) -> list[str]:
    """Hidden files, and folders of checkpoints without a manifest."""
    found = [p for p in run.rglob(".*") if p.is_file()]
    found += [p for p in run.glob("checkpoints/*") if not (p / "manifest.json").is_file()]
    return [str(p.relative_to(run)) for p in found]


def measure(
    folder: Path, *, kills: int, steps: int, seed: int, say: Callable[[str], None] = lambda line: None
) -> dict[str, object]:
    """Kill at least so often; the answer tells how it went."""
    os.environ["XDG_CACHE_HOME"] = str(folder / "cache")
    in_child(lambda: write_town(folder / "town", seed=0, palette="day", views=10, width=32, height=24))
    config = tiny(folder / "town", steps)

    def train(name: str) -> Callable[[], object]:
        return lambda: train_scene(replace(config, output=folder / name), "fprf-lite", quiet=True)

    if in_child(train("warm-up")) or in_child(train("straight")):  # the first one makes the features
        raise SystemExit("the undisturbed run failed")
    start = time.monotonic()
    in_child(lambda: train_scene(replace(config, output=folder / "timed"), "fprf-lite", quiet=True))
    usual = time.monotonic() - start
    wanted, draw = contents(folder / "straight"), random.Random(seed)
    pace = usual
    done = runs = equal = 0
    progress: list[int] = []
    left: list[str] = []
    failures: list[int] = []
    while done < kills:
        run = folder / f"killed-{runs}"
        while True:
            start = time.monotonic()
            code = in_child(train(run.name), kill_after=draw.uniform(0.05, 1.3 * pace))
            if code == 0:
                pace = min(pace, time.monotonic() - start)  # the machine may have been busier before
                break
            if code != KILLED:
                failures.append(code)
                break
            done += 1
            progress.append(max(saved(run / "checkpoints"), default=0))
        runs += 1
        if failures:
            break
        equal += contents(run) == wanted
        left += strays(run)
        say(f"{done} kills, {equal} of {runs} runs bitwise equal")
        shutil.rmtree(run)
    return {
        "kills": done,
        "runs": runs,
        "bitwise_equal": equal,
        "unfinished_files_left": left,
        "other_failures": failures,
        "undisturbed_seconds": round(usual, 2),
        "steps": steps,
        "checkpoint_every_steps": 1,
        "kills_before_the_first_checkpoint": sum(step == 0 for step in progress),
        "steps_reached_at_kills": progress,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="fprf-kills-") as folder:
        found = measure(Path(folder), kills=asked.kills, steps=asked.steps, seed=asked.seed, say=print)
    command = f"python benchmarks/kills.py --kills {asked.kills} --steps {asked.steps} --seed {asked.seed}"
    document = {"command": command, **found}
    print(json.dumps({k: v for k, v in document.items() if k != "steps_reached_at_kills"}, indent=1))
    if asked.output is not None:
        write_json(asked.output, document)


if __name__ == "__main__":
    main()
