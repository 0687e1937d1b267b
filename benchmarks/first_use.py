"""How good a small capture comes out at equal steps: `fprf-lite` with the flags given, judged on held-out views.

    python -m benchmarks first_use SCENE[:VIEWS] ... --steps 600 --label after --output FILE [-- any field of fprf-lite]

`SCENE:9` trains on nine of its training views, evenly through the capture; held-out views stay what they are. Such a thinned
capture keeps the sparse points that at least two of the nine saw. Where the capture does not say who saw a point, it stays with
the probability that two of its observers are among those left. Images are reduced by whole numbers until the longer side has at
most `--side` pixels.

Semantics are left out: they never move geometry or colour, and cost time. Seconds are the processor's, of training alone with
its features; one run after the other, each in this process.
"""

import json
import math
import shutil
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from fprf.cli.parsing import load_method, parse
from fprf.datamanagers.parsers.config import parse_scene
from fprf.datamanagers.parsers.files import read_json
from fprf.datamanagers.scene import Scene
from fprf.evaluation.evaluate import judge
from fprf.io.atomic import write_json
from fprf.io.video import write_frames
from fprf.training.driver import train
from fprf.training.loading import load_run

from .common import arguments, origin, read_report, split_flags


def main(argv: list[str]) -> None:
    parser = arguments("first_use", __doc__)
    parser.add_argument("scenes", nargs="+", help="folders; FOLDER:N is thinned to N training views")
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--side", type=int, default=240, help="longest side of the images at most, in pixels")
    parser.add_argument("--label", required=True, help="key of these figures in the file, for example before")
    parser.add_argument("--renders", type=Path, help="folder that the held-out views are written to")
    parser.add_argument("--output", type=Path, required=True, help="JSON file that the figures are added to")
    own, flags_behind = split_flags(argv)
    flags = flags_behind
    options = parser.parse_args(own)
    for text in options.scenes:
        folder, _, count = text.partition(":")
        with tempfile.TemporaryDirectory() as scratch:
            name = Path(folder).name + (f", {count} views" if count else "")
            data = thinned(Path(folder), Path(scratch) / Path(folder).name, int(count)) if count else Path(folder)
            renders = options.renders and options.renders / options.label / name.replace(", ", "-").replace(" ", "-")
            found = measured(data, Path(scratch) / "run", options.steps, options.side, flags, renders)
        entry = {**origin(), "flags": flags, **found}
        known = read_report(options.output)
        known.setdefault(name, {})[options.label] = entry
        write_json(options.output, known)
        print(name, options.label, json.dumps(entry), flush=True)


def measured(data: Path, run: Path, steps: int, side: int, flags: list[str], renders: Path | None = None) -> dict[str, Any]:
    """Train one scene and judge its held-out views."""
    method, _ = load_method("fprf-lite")
    longest = int(parse_scene(data, 1, None).cameras.size.max())
    fixed = ["--data", str(data), "--output", str(run), "--downscale", str(math.ceil(longest / side)), "--steps", str(steps)]
    fixed += ["--semantic.encoder", "none", "--statistics.rays", "1024", "--device", "cpu"]
    config = parse(method, [*fixed, *flags], prog="first_use", description="")
    start = time.process_time()
    train(config, "fprf-lite", quiet=True)
    seconds = time.process_time() - start
    trained = load_run(run, "cpu")
    scene = parse_scene(data, config.downscale, None)
    views = trained.known.split("test")
    metrics, pictures = judge(trained, trained.known, scene, views, lambda done, total, what: None)
    if renders is not None:
        renders.mkdir(parents=True, exist_ok=True)
        write_frames(renders, [trained.known.names[view] for view in views], pictures)
    return {
        "training_views": len(scene.train),
        "held_out_views": len(views),
        "size": scene.cameras.size[0].tolist(),
        "points": 0 if scene.points is None else len(scene.points),
        "space": trained.known.facts.space.kind,
        "tones": trained.model.tones is not None,
        "steps": trained.step,
        "processor_seconds": round(seconds, 1),
        "psnr_db": round(metrics["psnr"], 3),
        "ssim": round(metrics["ssim"], 4),
    }


def thinned(source: Path, target: Path, count: int) -> Path:
    """A copy of a `transforms.json` capture with so many of its training views."""
    scene = parse_scene(source, 1, None)
    kept = scene.train[np.linspace(0, len(scene.train) - 1, count).round().astype(np.int64)]
    target.mkdir(parents=True)
    document = read_json(source / "transforms.json")
    names = {view: scene.paths[view].relative_to(source).as_posix() for view in (*kept.tolist(), *scene.test.tolist())}
    document["frames"] = [frame for frame in document["frames"] if Path(frame["file_path"]).as_posix() in names.values()]
    document["train_filenames"] = [names[view] for view in kept.tolist()]
    document["test_filenames"] = [names[view] for view in scene.test.tolist()]
    for name in names.values():
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source / name, target / name)
    (target / "transforms.json").write_text(json.dumps(document))
    if scene.points is not None:
        np.savez(target / "points.npz", **_points(source, scene, kept.tolist(), sorted(names)))
    return target


def _points(source: Path, scene: Scene, kept: list[int], remaining: list[int]) -> dict[str, Any]:
    """Points that two views of those kept saw; `seen` counts the views that remain."""
    assert scene.points is not None
    points = scene.points.numpy()
    if scene.seen is None:
        # A track of L of V views: none or one of the K kept ones saw it with hypergeometric probability.
        length, views, k = np.load(source / "points.npz")["track_length"], len(scene.paths), len(kept)
        few = [
            sum(math.comb(n, i) * math.comb(views - n, k - i) for i in (0, 1)) / math.comb(views, k) for n in range(views + 1)
        ]
        chance = 1 - np.array(few)[np.minimum(length, views).astype(np.int64)]
        return {"xyz": points[np.random.default_rng(0).random(len(points)) < chance]}
    seen = scene.seen.numpy()
    seen = seen[np.isin(seen[:, 0], kept)]
    often = np.bincount(seen[:, 1], minlength=len(points)) >= 2
    seen = seen[often[seen[:, 1]]]
    return {
        "xyz": points[often],
        "seen": np.stack([np.searchsorted(remaining, seen[:, 0]), (np.cumsum(often) - 1)[seen[:, 1]]], 1),
    }
