"""What the training guards cost: steps with and without them in turn, in one process, in processor time.

    python benchmarks/guards.py [--method fprf-lite] [--pairs 40] [--output benchmarks/results/guards.json]

The step is the method's own on the embedded town. Beside it the guards' parts alone, and Adam over denormal moments, which
clearing prevents.
"""

import argparse
import json
import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from unittest import mock

import torch

from fprf.benchmarking.report import machine
from fprf.cli.parsing import load_method
from fprf.io.atomic import write_json
from fprf.training import guards, trainer
from fprf.training.model import build_model
from fprf.training.prepare import prepare

SHARE = 0.5


def seconds(function: Callable[[], object], times: int) -> float:
    """Median processor time of a call."""
    found = []
    for _ in range(times):
        start = time.process_time()
        function()
        found.append(time.process_time() - start)
    return statistics.median(found)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--method", default="fprf-lite")
    parser.add_argument("--pairs", type=int, default=40)
    parser.add_argument("--output", type=Path)
    asked = parser.parse_args()
    config = replace(load_method(asked.method)[0], data=Path("town"), device="cpu")
    prepared = prepare(config)
    model = build_model(config, prepared.facts)
    loop = trainer.Loop(config, prepared, model, trainer.optimizer_of(config, model), torch.device("cpu"))
    for step in range(3):
        loop.step(step, SHARE)
    found: dict[bool, list[float]] = {True: [], False: []}
    for pair in range(asked.pairs):
        for guarded in (True, False) if pair % 2 else (False, True):
            keep = mock.patch.object(trainer, "unfit_gradients", guards.unfit_gradients if guarded else lambda named: None)
            with keep:
                start = time.process_time()
                loop.step(8 * pair, SHARE)  # each with the penalties that come every few steps
                found[guarded].append(time.process_time() - start)
    step = statistics.median(found[False])
    ratios = sorted(a / b for a, b in zip(found[True], found[False], strict=True))
    look = seconds(lambda: guards.unfit_gradients(model.named_parameters()), 30)
    clear = seconds(lambda: guards.clear_denormals(loop.optimizer), 10)
    adam = seconds(loop.optimizer.step, 5)
    with torch.no_grad():
        for state in loop.optimizer.state.values():
            state["exp_avg"].fill_(1e-41)
        for parameter in model.learned():
            if parameter.grad is not None:
                parameter.grad.zero_()
    slow = seconds(loop.optimizer.step, 3)
    document = {
        "command": f"python benchmarks/guards.py --method {asked.method} --pairs {asked.pairs}",
        "machine": machine(torch.device("cpu")),
        "method": asked.method,
        "learned": sum(p.numel() for p in model.learned()),
        "step_ms": 1e3 * step,
        "guarded_step_ms": 1e3 * statistics.median(found[True]),
        "paired_ratio": dict(zip(("low", "median", "high"), statistics.quantiles(ratios, n=4), strict=True)),
        "look_at_gradients_ms": 1e3 * look,
        "clearing_ms_a_step": 1e3 * clear / guards.CLEAR_EVERY,
        "guards_percent_of_step": 100 * (look + clear / guards.CLEAR_EVERY) / step,
        "adam_ms": 1e3 * adam,
        "adam_over_denormals_ms": 1e3 * slow,
    }
    print(json.dumps(document, indent=1))
    if asked.output is not None:
        write_json(asked.output, document)


if __name__ == "__main__":
    main()
