"""A long training in which one batch in a hundred is spoilt, beside the same training without, and with other batches there.

    python benchmarks/poisoned.py [--steps 30000] [--share 0.01] [--seeds 0 1 2 3] [--output benchmarks/results/poisoned.json]

The toy is a town of ten pictures and a model of a few thousand numbers (`kills.py` trains the same). Which batches are spoilt,
and how, are functions of (seed, step): colours or features that are NaN or infinite, in one ray or in all, or whose square
overflows. Every step must leave finite parameters and moments; at the end the models are compared on all views. What a model
becomes depends on the order of its batches: the third training, with other healthy batches in the place of the spoilt ones,
tells how much.
"""

import argparse
import json
import math
import os
import random
import statistics
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from kills import tiny

from fprf.config import TrainConfig
from fprf.datamanagers.images import load_images
from fprf.evaluation.metrics import psnr
from fprf.interfaces import DataManager
from fprf.io.atomic import write_json
from fprf.town.write import write_town
from fprf.training import checkpoint
from fprf.training.model import Model
from fprf.training.prepare import Prepared, prepare
from fprf.training.run import Run
from fprf.training.trainer import Report, train
from fprf.training.views import render_view
from fprf.types import Batch

NAN, INF = float("nan"), float("inf")
NEVER = 10**6
"""Beyond the last step."""


def _one(values: torch.Tensor, value: float) -> torch.Tensor:
    """The values, one number of them replaced."""
    spoilt = values.clone()
    spoilt.view(-1)[len(spoilt.view(-1)) // 2] = value
    return spoilt


def _field(name: str, change: Callable[[torch.Tensor], torch.Tensor]) -> Callable[[Batch], Batch]:
    """Batches without that field lose their colours instead."""

    def spoil(batch: Batch) -> Batch:
        value = getattr(batch, name)
        if value is None:
            return batch._replace(rgb=torch.full_like(batch.rgb, NAN))
        return batch._replace(**{name: change(value)})

    return spoil


POISONS: dict[str, Callable[[Batch], Batch]] = {
    "one colour NaN": _field("rgb", lambda x: _one(x, NAN)),
    "all colours infinite": _field("rgb", lambda x: torch.full_like(x, INF)),
    "colours of 1e25": _field("rgb", lambda x: torch.full_like(x, 1e25)),
    "one content feature NaN": _field("content", lambda x: _one(x, NAN)),
    "one semantic feature infinite": _field("semantic", lambda x: _one(x, -INF)),
    "all content features 3e38": _field("content", lambda x: torch.full_like(x, 3e38)),
    "all semantic features NaN": _field("semantic", lambda x: torch.full_like(x, NAN)),
}


def poison(seed: int, step: int, share: float) -> str | None:
    """What spoils a step's batch, or None."""
    draw = random.Random(f"poison {seed} {step}")
    return draw.choice(list(POISONS)) if draw.random() < share else None


class Changed(DataManager):
    """Batches of another, some of them spoilt, or in their place those of steps that nobody takes."""

    def __init__(self, inner: DataManager, seed: int, share: float, *, spoil: bool) -> None:
        self.inner, self.seed, self.share, self.spoil = inner, seed, share, spoil
        self.content_store, self.semantic_store = inner.content_store, inner.semantic_store
        self.given: Counter[str] = Counter()

    def batch(self, step: int) -> Batch:
        name = poison(self.seed, step, self.share)
        if name is None:
            return self.inner.batch(step)
        self.given[name] += 1
        return POISONS[name](self.inner.batch(step)) if self.spoil else self.inner.batch(step + NEVER)

    def image(self, view: int) -> torch.Tensor:
        return self.inner.image(view)


def quality(config: TrainConfig, prepared: Prepared, model: Model) -> dict[str, float]:
    """Mean PSNR (dB) over the views that were held out, and over all."""
    cameras, images = prepared.scene.cameras, load_images(prepared.scene)
    found = [
        psnr(render_view(model, prepared.facts, cameras, view, config.render).rgb, torch.from_numpy(image).float() / 255)
        for view, image in enumerate(images)
    ]
    held = [found[view] for view in prepared.scene.test.tolist()]
    return {"held_out": sum(held) / len(held), "all": sum(found) / len(found)}


def trained(config: TrainConfig, prepared: Prepared, folder: Path) -> dict[str, Any]:
    """Train; what came of it."""
    folder.mkdir()
    last: list[Report] = []
    bad = 0

    def report(event: Report) -> None:
        nonlocal bad
        last[:] = [event]
        bad += not all(math.isfinite(value) for value in (event.psnr, *event.losses.values()))

    start = time.process_time()
    model = train(config, prepared, Run(folder), report)
    seconds = time.process_time() - start
    saved = checkpoint.load(folder / "checkpoints", checkpoint.steps(folder / "checkpoints")[-1])
    numbers = [*saved.model.values(), *saved.optimizer.values()]
    path = folder / "events.jsonl"
    events = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    return {
        "psnr": quality(config, prepared, model),
        "not_finite": sum(int((~torch.isfinite(x)).sum()) for x in numbers if x.is_floating_point()),
        "numbers_looked_at": sum(x.numel() for x in numbers),
        "reports_not_finite": bad,
        "skipped": last[0].skipped,
        "gone_back": sum("gone_back_to" in event for event in events),
        "cpu_seconds": round(seconds, 1),
        "ms_a_step": round(1e3 * seconds / config.steps, 2),
    }


def measure(folder: Path, steps: int, share: float, seeds: list[int]) -> list[dict[str, Any]]:
    os.environ["XDG_CACHE_HOME"] = str(folder / "cache")
    write_town(folder / "town", seed=0, palette="day", views=10, width=32, height=24)
    rows = []
    for seed in seeds:
        config = replace(tiny(folder / "town", steps), seed=seed, checkpoint_minutes=0.5)
        config = replace(config, datamanager=replace(config.datamanager, rays=128))
        prepared = prepare(config)
        clean = trained(config, prepared, folder / f"clean-{seed}")
        managers = {name: Changed(prepared.manager, seed, share, spoil=name == "poisoned") for name in ("poisoned", "other")}
        found = {n: trained(config, prepared._replace(manager=m), folder / f"{n}-{seed}") for n, m in managers.items()}
        lost = {n: {part: clean["psnr"][part] - row["psnr"][part] for part in clean["psnr"]} for n, row in found.items()}
        rows.append({"seed": seed, "lost_db": lost, "spoilt": dict(managers["poisoned"].given), "clean": clean, **found})
        print(json.dumps(rows[-1], indent=1), flush=True)
    return rows


def summary(rows: list[dict[str, Any]]) -> dict[str, dict[str, float | None]]:
    """Mean dB lost over the seeds, and the standard error of that mean."""

    def of(values: list[float]) -> dict[str, float | None]:
        error = statistics.stdev(values) / len(values) ** 0.5 if len(values) > 1 else None
        return {"mean": statistics.fmean(values), "error": error}

    return {
        f"{name}, {part}": of([row["lost_db"][name][part] for row in rows])
        for name in ("poisoned", "other")
        for part in ("held_out", "all")
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=30_000)
    parser.add_argument("--share", type=float, default=0.01)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3])
    parser.add_argument("--output", type=Path)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="fprf-poisoned-") as folder:
        rows = measure(Path(folder), asked.steps, asked.share, asked.seeds)
    seeds = " ".join(map(str, asked.seeds))
    command = f"python benchmarks/poisoned.py --steps {asked.steps} --share {asked.share:g} --seeds {seeds}"
    if asked.output is not None:
        write_json(asked.output, {"command": command, "lost_db": summary(rows), "runs": rows})


if __name__ == "__main__":
    main()
