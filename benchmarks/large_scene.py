"""A town as a large scene: blocks against one field of as many parameters, seams, memory, time with ever more blocks.

    python -m benchmarks large_scene [--views 400] [--blocks 16] [--minutes 9] [--output benchmarks/results/large_scene.json]

Both sides get the same seconds in all, features not counted: they are extracted before. Seconds are those of the processor,
so that a busy machine favours neither (`--clock wall` takes the others; with one thread both agree where nobody disturbs).
The row of blocks for memory and time is made of the trained ones (see `blocks_cost`): beyond as many as were trained it
repeats itself.
"""

import argparse
import json
import os
import statistics
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch

from fprf.blocks.config import GridConfig, SingleConfig
from fprf.config import TrainConfig
from fprf.datamanagers.config import RayBatchesConfig
from fprf.datamanagers.images import load_image
from fprf.datamanagers.parsers.config import parse_scene
from fprf.fields.config import PlanesConfig, SemanticPlanesConfig
from fprf.io.images import to_uint8, write_image
from fprf.methods import fprf_lite
from fprf.plugins.samplers.config import ProposalConfig
from fprf.style.config import StyleConfig
from fprf.style.files import StyleFile
from fprf.style.restyle import apply_style
from fprf.training import driver, tasks
from fprf.training.block_training import cut
from fprf.training.blocks import load_blocks
from fprf.training.driver import train
from fprf.training.loading import Trained, load_run
from fprf.training.prepare import read_scene
from fprf.training.views import render_view

from .blocks import costs, jumps, ratios
from .common import RESULTS, arguments, report
from .town.write import cached_town, write_town

METRES = 17.0
"""Of street in a block."""
PALETTES = ("sunset", "autumn", "winter")


def configs(options: argparse.Namespace) -> tuple[TrainConfig, TrainConfig]:
    """Blocks, and the single field with as many parameters as all of them and their surroundings."""
    lite, n = fprf_lite(), options.blocks
    width, height = options.size
    town = cached_town(views=options.views, width=width, height=height, extra=max(0.0, round(METRES * n - 26.0)))
    nodes = tuple(options.nodes)
    blocks = replace(
        lite,
        data=town,
        output=options.scratch / "blocks",
        steps=10**6,
        minutes=options.minutes,
        device="cpu",
        checkpoint_minutes=60.0,
        datamanager=RayBatchesConfig(rays=options.rays, semantic_share=0.25),
        sampler=replace(lite.sampler, resolutions=(nodes[-1] // 2,)),
        content=replace(lite.content, field=PlanesConfig(resolutions=nodes, channels=16, hidden=64, layers=1)),
        semantic=replace(lite.semantic, field=replace(lite.semantic.field, resolutions=(nodes[0], nodes[-2]))),
        blocks=GridConfig(cells=(n, 1)),
    )
    # Parameters go with the square of the nodes; the surroundings are one block more.
    single = replace(widened(blocks, (n + 1) ** 0.5), output=options.scratch / "single", blocks=SingleConfig())
    return blocks, single


def widened(config: TrainConfig, factor: float) -> TrainConfig:
    """The config with so many times the nodes along every side of its planes."""
    sampler, field, semantic = config.sampler, config.content.field, config.semantic.field
    assert isinstance(sampler, ProposalConfig) and isinstance(field, PlanesConfig)
    assert isinstance(semantic, SemanticPlanesConfig)
    return replace(
        config,
        sampler=replace(sampler, resolutions=_times(sampler.resolutions, factor)),
        content=replace(config.content, field=replace(field, resolutions=_times(field.resolutions, factor))),
        semantic=replace(config.semantic, field=replace(semantic, resolutions=_times(semantic.resolutions, factor))),
    )


def _times(nodes: tuple[int, ...], factor: float) -> tuple[int, ...]:
    return tuple(round(factor * r) for r in nodes)


def psnr(trained: Trained, folder: Path | None = None) -> list[float]:
    """Of each held-out view."""
    scene = parse_scene(trained.config.data, trained.config.downscale, trained.config.datamanager.parser)
    found = []
    for view in scene.test.tolist():
        truth = torch.from_numpy(load_image(scene.paths[view])).float() / 255
        size = scene.cameras.size[view].tolist()
        if [truth.shape[1], truth.shape[0]] != size:
            truth = torch.from_numpy(load_image(scene.paths[view], (size[0], size[1]))).float() / 255
        tones = trained.model.tones
        factor = None if tones is None else tones(torch.tensor([view]))[0].detach()
        image = render_view(trained.model, trained.known.facts, scene.cameras, view, trained.config.render, factor=factor).rgb
        found.append(float(-10 * (image - truth).square().mean().log10()))
        if folder is not None and len(found) % 10 == 1:
            write_image(folder / f"{view:04d}.png", to_uint8(torch.cat([truth, image], 1)))
    return found


def parameters(config: TrainConfig, root: Path) -> int:
    """That are learnt, blocks and surroundings added up."""
    files = sorted((root / "blocks").glob("*/done.json"))
    if not files:
        return sum(p.numel() for n, p in load_run(root, "cpu").model.named_parameters() if not n.startswith("decoder"))
    from safetensors import safe_open

    total = 0
    for file in files:
        with safe_open(file.with_name("block.safetensors"), "pt") as tensors:
            for name in tensors.keys():  # noqa: SIM118  (not a mapping)
                if name.startswith("member."):
                    shape = tensors.get_slice(name).get_shape()
                    total += int(torch.tensor(shape).prod()) if shape else 1
    return total


def use_processor_time() -> None:
    """Time limits of training count what this process has used, whatever else the machine does."""
    for module in (driver, tasks):
        vars(module)["time"] = SimpleNamespace(perf_counter=time.process_time, time=time.time)


def trained_seconds(root: Path) -> dict[str, Any]:
    """What training took, and how evenly blocks were served."""
    done = {p.parent.name: json.loads(p.read_text()) for p in (root / "blocks").glob("*/done.json")}
    if not done:
        run = load_run(root, "cpu")
        return {"seconds": run.seconds, "steps": run.step, "seconds_per_step": run.seconds / max(1, run.step)}
    each = [d["seconds"] / max(1, d["step"]) for name, d in done.items() if name != "surroundings"]
    return {
        "seconds": sum(d["seconds"] for d in done.values()),
        "steps": sum(d["step"] for d in done.values()),
        "seconds_per_step": statistics.mean(each),
        "cheapest_and_dearest_block_to_mean": [min(each) / statistics.mean(each), max(each) / statistics.mean(each)],
    }


def references(folder: Path) -> tuple[Path, ...]:
    """Three towns in other lights."""
    found = []
    for k, palette in enumerate(PALETTES):
        town = folder / f"reference-{palette}"
        write_town(town, seed=11 + k, palette=palette, views=2, width=160, height=120)
        found.append(town / "images/0001.png")
    return tuple(found)


def main(argv: list[str]) -> None:
    parser = arguments("large_scene", __doc__)
    parser.add_argument("--views", type=int, default=400)
    parser.add_argument("--size", type=int, nargs=2, default=(96, 72))
    parser.add_argument("--blocks", type=int, default=16)
    parser.add_argument("--minutes", type=float, default=9.0, help="of training in all, for each side")
    parser.add_argument("--clock", choices=("processor", "wall"), default="processor")
    parser.add_argument("--rays", type=int, default=2048)
    parser.add_argument("--nodes", type=int, nargs="+", default=(16, 32, 64, 128), help="of a block's planes")
    parser.add_argument("--pairs", type=int, default=256, help="rays at each border")
    parser.add_argument("--rows", type=int, nargs="+", default=(4, 16, 64), help="lengths of rows that are timed")
    parser.add_argument("--frames", type=int, default=6, help="views rendered for times and memory")
    parser.add_argument("--scratch", type=Path, default=Path("runs/large_scene"))
    parser.add_argument("--output", type=Path, default=RESULTS / "large_scene.json")
    options = parser.parse_args(argv)
    options.scratch = options.scratch.resolve()
    os.environ.setdefault("XDG_CACHE_HOME", str(options.scratch / "cache"))
    torch.manual_seed(0)
    started = time.perf_counter()

    def say(text: str) -> None:
        print(f"[{time.perf_counter() - started:6.0f} s] {text}", flush=True)

    if options.clock == "processor":
        use_processor_time()
    blocks, single = configs(options)
    scene = read_scene(blocks)
    laid = cut(blocks, scene)
    assert laid is not None  # the layout has several cells
    say(f"{len(scene.paths)} images, features extracted, {len(laid.plan.cells)} blocks")
    result: dict[str, Any] = {
        "images": len(scene.paths),
        "size": list(options.size),
        "blocks": len(laid.plan.cells),
        "minutes_each_side": options.minutes,
        "clock": options.clock,
        "threads": torch.get_num_threads(),
    }
    for name, config in (("blocks", blocks), ("single", single)):
        assert config.output is not None
        train(config, "fprf-lite", quiet=True)
        run = load_run(config.output, "cpu")
        values = psnr(run, options.scratch / f"{name}-views")
        result[name] = {
            "psnr": statistics.mean(values),
            "psnr_of_worst_view": min(values),
            "parameters": parameters(config, config.output),
            **trained_seconds(config.output),
        }
        say(f"{name}: {result[name]}")
    result["blocks_minus_single_db"] = result["blocks"]["psnr"] - result["single"]["psnr"]
    root = options.scratch / "blocks"
    run = load_run(root, "cpu")
    style = StyleFile(StyleConfig(references=references(options.scratch)))
    rows = jumps(run, load_blocks(root), apply_style(run, style).restyle, count=options.pairs, say=lambda text: None)
    result["seams"] = {"borders": len(rows), **ratios(rows), "rows": rows}
    say(f"seams: { {k: v for k, v in result['seams'].items() if k != 'rows'} }")
    result["costs"] = costs(root, options.scratch, tuple(options.rows), options.frames, cache_blocks=4)
    memory = result["costs"]["memory"]
    result["peak_rss_many_over_two"] = memory[1]["peak_rss_mib"] / memory[0]["peak_rss_mib"]
    say(f"costs: {result['costs']}")
    report(options.output, result)
    say(f"written to {options.output}")
