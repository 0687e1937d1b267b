"""Fault 13: less memory than is asked for, in processes of their own with a limit on their addresses."""

import json
import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from tiny_world import World, flags

from fprf.cli import main as cli
from fprf.training import checkpoint

pytestmark = pytest.mark.skipif(
    not Path("/proc/self/statm").exists(), reason="sizes of processes are read from /proc"
)
BEGIN = """
import json, re, resource, sys
from dataclasses import replace
from pathlib import Path
import numpy as np
import torch
from fprf import memory
from fprf.cli import main as cli
from fprf.training import style_pass, views
from fprf.training.field_scene import load_run

def limit(room):
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + room, size + room))

def counted(function):
    def call(count, size, work):
        def watched(part):
            try:
                return work(part)
            except Exception:
                tried.append(part.stop - part.start)
                raise
        return function(count, size, watched)
    return call

tried = []
for module in (views, style_pass):
    module.in_parts = counted(memory.in_parts)
"""

RENDER = """
trained = load_run(Path(sys.argv[1]), "cpu")
cameras = trained.known.cameras.select(torch.tensor([0, 1])).scaled(1 / 16)  # 512 x 384
config = replace(trained.config.render, chunk=1 << 20)
model, facts = trained.model, trained.known.facts
small = replace(config, chunk=3000)

def rendered(config):
    view = views.render_view(model, facts, cameras, 0, config)
    return [view.rgb, view.depth, view.opacity]

def cached(config):
    kept = views.cache_view(model, facts, cameras, 0, config)
    view = kept.restyled()
    return [view.rgb, view.depth]

wanted = cached(small) + rendered(small)
assert not tried
limit(500 << 20)  # what a cached view keeps takes 370 MiB
apart = cached(config)
tries = [list(tried)]
tried.clear()
limit(160 << 20)
apart += rendered(config)
tries.append(list(tried))
print(json.dumps({"tried": tries, "apart": [float((a - b).abs().max() / b.abs().max()) for a, b in zip(apart, wanted)]}))
"""

TRAIN = """
from fprf.training import field_learner as learner
before, keep = learner.FieldLearner.step, []

def step(self, step, share):
    if step == 4:
        limit(0)
        try:
            while True:
                keep.append(torch.empty(1 << 20, dtype=torch.uint8))
        except RuntimeError:
            del keep[-3:]
    return before(self, step, share)

learner.FieldLearner.step = step
raise SystemExit(cli.main(["train", "fprf-lite", *sys.argv[1:]]))
"""


def python(text: str, *args: object) -> subprocess.CompletedProcess[str]:
    words = [sys.executable, "-c", BEGIN + text, *map(str, args)]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "MALLOC_ARENA_MAX": "1"}
    environment["MALLOC_MMAP_THRESHOLD_"] = (
        "65536"  # freed memory goes back: no room lost in pieces of the heap
    )
    return subprocess.run(words, capture_output=True, text=True, timeout=250, env=environment)


def test_renders_with_too_little_memory_for_their_chunk_are_the_same(world: World) -> None:
    done = python(RENDER, world.run)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert all(sizes and sizes[0] == 1 << 20 for sizes in found["tried"])
    assert max(found["apart"]) <= 1e-6


@pytest.mark.fault
def test_training_with_too_little_memory_ends_in_one_line_and_keeps_its_checkpoint(
    world: World, tmp_path: Path
) -> None:
    args = [
        *flags(world, tmp_path / "run"),
        *["--datamanager.rays", "20000", "--steps", "6", "--checkpoint-minutes", "1e-9"],
    ]
    done = python(TRAIN, *args)
    assert done.returncode == 2, done.stderr
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    assert line.startswith("error: training step 4: not enough memory; the process held up to ")
    assert "GiB more" in line and "of addresses are allowed" in line and "lower --datamanager.rays" in line
    assert "(the checkpoint of step 4 is kept)" in line and "Traceback" not in done.stderr
    root = tmp_path / "run" / "checkpoints"
    assert checkpoint.load(root, 4).step == checkpoint.steps(root)[-1] == 4
    assert cli.main(["train", "fprf-lite", *args]) == 0
    assert checkpoint.steps(root)[-1] == 6


def test_a_picture_that_does_not_fit_is_not_called_damaged(tmp_path: Path) -> None:
    image = tmp_path / "large.png"
    image.write_bytes(cv2.imencode(".png", np.zeros((6000, 6000, 3), np.uint8))[1].tobytes())
    text = """
from fprf.datamanagers.images import load_image
limit(64 << 20)
try:
    load_image(Path(sys.argv[1]))
except Exception as error:
    print(type(error).__name__, memory.out_of_memory(error))
"""
    done = python(text, image)
    assert done.stdout.split()[-1] == "True", done.stdout + done.stderr
