"""A capture in blocks against the same capture in one field, both trained for the same seconds in all.

    python -m benchmarks blocks_scenes SCENE [--minutes 3] [--sides blocks single] [--name NAME] [--output FILE] -- [any field]

The flags behind `--` are those of `fprf train fprf-lite`; the single field takes them too, but for the blocks, and has as many
parameters as all blocks and their surroundings together (`--same-planes` leaves its planes as they are). Features are extracted
before the clock runs, which counts what the processor does (see `large_scene.py`).
"""

import json
import statistics
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from fprf.blocks.config import SingleConfig
from fprf.cli.parsing import load_method, parse
from fprf.training.block_training import cut
from fprf.training.blocks import load_blocks
from fprf.training.driver import train
from fprf.training.loading import load_run
from fprf.training.prepare import read_scene

from .common import add_entry, arguments, split_flags
from .large_scene import parameters, psnr, trained_seconds, use_processor_time, widened


def main(argv: list[str]) -> None:
    parser = arguments("blocks_scenes", __doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--minutes", type=float, default=3.0)
    parser.add_argument("--sides", nargs="+", choices=("blocks", "single"), default=("blocks", "single"))
    parser.add_argument("--same-planes", action="store_true", help="give the single field the planes of one block")
    parser.add_argument("--name", help="of the entry in the JSON file; the scene's by default")
    parser.add_argument("--scratch", type=Path, default=Path("runs/blocks_scenes"))
    parser.add_argument("--output", type=Path, help="JSON file that the figures are added to, under the scene's name")
    own, flags_behind = split_flags(argv)
    options = parser.parse_args(own)
    rest = flags_behind
    method, _ = load_method("fprf-lite")
    flags = ["--data", str(options.scene), "--minutes", str(options.minutes), *rest]
    blocks = parse(method, flags, prog="blocks_scenes", description="")
    name = options.name or options.scene.name
    scratch = options.scratch.resolve() / name
    scene = read_scene(blocks)
    laid = cut(blocks, scene)
    assert laid is not None  # the layout has several cells
    wide = 1.0 if options.same_planes else (len(laid.plan.cells) + 1) ** 0.5
    sides = {
        "blocks": replace(blocks, output=scratch / "blocks", steps=10**6),
        "single": replace(widened(blocks, wide), output=scratch / "single", steps=10**6, blocks=SingleConfig()),
    }
    use_processor_time()
    result: dict[str, Any] = {
        "images": len(scene.paths),
        "size": scene.cameras.size[0].tolist(),
        "minutes_each_side": options.minutes,
        "threads": torch.get_num_threads(),
        "flags": rest,
    }
    for side in options.sides:
        root = sides[side].output
        assert root is not None
        train(sides[side], "fprf-lite", quiet=True)
        values = psnr(load_run(root, "cpu"), scratch / f"{side}-views")
        result[side] = {
            "psnr": statistics.mean(values),
            "psnr_of_views": values,
            "parameters": parameters(sides[side], root),
            **trained_seconds(root),
        }
        if side == "blocks":
            result[side]["blocks"] = len(load_blocks(root))
        print(name, side, json.dumps(result[side]), flush=True)
    if {"blocks", "single"} <= result.keys():
        result["blocks_minus_single_db"] = result["blocks"]["psnr"] - result["single"]["psnr"]
    if options.output is not None:
        add_entry(options.output, name, result)
