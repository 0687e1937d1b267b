"""What a new style and its controls cost on a trained run: from photographs to the dictionary, the first picture, match maps.

    python benchmarks/controls.py RUN --references A.jpg B.jpg C.jpg [--output benchmarks/results/controls.json]

Views are 135 x 240. Seconds are processor time (all threads), medians of five, the first picture aside: that one pays for what
is loaded once in a process. Run it twice: the first time ever, kernels are compiled. `start` is everything before a run is
read: interpreter, imports, flags. Controls are given beside the same view without them (`peer`), in one run.
"""

import argparse
import json
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch

from fprf.plugins.stylizers.config import AdainConfig, LocalAdainConfig, RegionOtConfig
from fprf.style.config import StyleConfig
from fprf.style.files import StyleFile
from fprf.style.look import Restyle
from fprf.style.references import Encoders
from fprf.training.explain import explain
from fprf.training.loading import Trained, load_run
from fprf.training.matches import match_map
from fprf.training.restyle import Styled, apply_style
from fprf.training.views import render_view

Row = dict[str, str | float | None]
SIZE = (240, 135)


def row(name: str, value: float, unit: str, goal: float | None = None, peer: float | None = None) -> Row:
    return {"name": name, "figure": float(f"{value:.3g}"), "unit": unit, "goal": goal, "peer": peer and float(f"{peer:.3g}")}


def spent(call: Callable[[], object]) -> float:
    start = time.process_time()
    call()
    return time.process_time() - start


def median(call: Callable[[], object]) -> float:
    call()
    return statistics.median(spent(call) for _ in range(5))


def start_seconds() -> float:
    """Processor time of a fresh interpreter that has imported what a restyle needs, and parsed flags."""
    code = (
        "import time, fprf.cli.stylize as s\n"
        "s.read_flags(s.StylizeConfig(), ['RUN'], prog='x', description='', positional=('run',))\n"
        "import fprf.training.loading, fprf.training.restyle, fprf.training.matches\n"
        "print(time.process_time())"
    )
    ran = [subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout for _ in range(3)]
    return statistics.median(map(float, ran))


def resized(trained: Trained) -> Trained:
    cameras = trained.known.cameras
    return replace(trained, known=replace(trained.known, cameras=cameras.resized(torch.tensor([SIZE]).expand(len(cameras), 2))))


def looks(trained: Trained, encoders: Encoders, base: StyleConfig, plain: Styled) -> dict[str, tuple[str, Restyle | None]]:
    """Each with the name of what it is compared with."""

    def made(**wishes: object) -> Restyle:
        return apply_style(trained, StyleFile(replace(base, **wishes)), encoders).restyle  # type: ignore[arg-type]

    count, references = len(plain.scene.share), len(base.references)
    every = range(0, count, 2)
    styles = {
        "unstyled": ("", None),
        "region-ot": ("unstyled", plain.restyle),
        "adain": ("unstyled", made(stylizer=AdainConfig())),
        "local-adain": ("unstyled", made(stylizer=LocalAdainConfig())),
        "half of the regions kept": ("region-ot", made(keep=tuple(str(k) for k in every))),
        "half of the regions pinned": ("region-ot", made(pin=tuple(f"{k}={k % references}" for k in every))),
        "luminance kept": ("region-ot", made(luminance=0.5)),
        "between two styles": ("region-ot", plain.restyle.mixed(made(stylizer=RegionOtConfig(temperature=1.0)), 0.3)),
    }
    return {name: (peer, look) for name, (peer, look) in styles.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--references", type=Path, nargs="+", required=True)
    parser.add_argument("--output", type=Path)
    given = parser.parse_args()
    torch.set_num_threads(1)
    trained = resized(load_run(given.run, "cpu"))
    known, render = trained.known, trained.config.render
    base = StyleConfig(references=tuple(given.references))
    loading = spent(lambda: load_run(given.run, "cpu"))
    opening = spent(lambda: trained.encoders())
    encoders = trained.encoders()
    one = StyleFile(replace(base, references=base.references[:1]))
    first_style = spent(lambda: apply_style(trained, one, encoders))
    plain = apply_style(trained, StyleFile(base), encoders)

    def view(look: Restyle | None) -> Callable[[], object]:
        return lambda: render_view(trained.model, known.facts, known.cameras, len(known.names) // 3, render, look)

    first_view = spent(view(plain.restyle))
    start = start_seconds()
    rows = [
        row("start: interpreter, imports, flags", start, "seconds"),
        row("a run is read", loading, "seconds"),
        row("its encoders are read", opening, "seconds"),
        row("dictionary of one photograph, the first of a process", first_style, "seconds", 1.0),
        row("dictionary of one photograph", median(lambda: apply_style(trained, one, encoders)), "seconds", 1.0),
        row("first restyled view of a process", first_view, "seconds"),
        row("new photograph to first restyled view, in a process", opening + first_style + first_view, "seconds", 2.0),
        row("from nothing to first restyled view", start + loading + opening + first_style + first_view, "seconds", 2.0),
        row("match map of a view", median(lambda: match_map(trained, plain, len(known.names) // 3)), "seconds", 1.0),
        row("regions explained", median(lambda: explain(plain.orders.regions, plain)), "seconds"),
    ]
    seconds: dict[str, float] = {}
    for name, (peer, look) in looks(trained, encoders, base, plain).items():
        seconds[name] = median(view(look))
        rows.append(row(f"a view, {name}", seconds[name], "seconds", None, seconds.get(peer)))
    missed = [
        r["name"] for r in rows if isinstance(r["goal"], float) and isinstance(r["figure"], float) and r["figure"] > r["goal"]
    ]
    size = f"{len(plain.codes.reference)} style codes, {len(plain.scene.share)} regions, {SIZE[0]}x{SIZE[1]}"
    scene = f"{known.name}, {trained.method}, {trained.step} steps, {known.facts.semantic_encoder}"
    machine = f"{platform.machine()}, one thread"
    document = {"machine": machine, "scene": scene, "setting": size, "rows": rows, "falls_short": missed}
    text = json.dumps(document, indent=1) + "\n"
    print(text)
    if given.output:
        given.output.write_text(text)


if __name__ == "__main__":
    main()
