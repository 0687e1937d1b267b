"""Restyling of scenes by true answers: captures of photographs that were taken in several lights.

    python -m benchmarks wild --runs RUN [RUN ...] [--split test] [--seeds 0 1 2] [--output JSON] [--sheet PNG]

The left half of a photograph is the reference; the scene, restyled and drawn at the photograph's pose, is
judged by its right half (`halves.py`). Photographs of the split `test` took no part in training; those of
others did, so that their pose is better known, and the scene's own light is a mean that they are part of.
"""

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from fprf.checks import at_least
from fprf.cli.parsing import parse
from fprf.datamanagers.images import load_image
from fprf.datamanagers.scene import at_origin
from fprf.errors import DataError
from fprf.rendering.cameras import pixel_grid
from fprf.style.config import StyleConfig
from fprf.style.files import StyleFile
from fprf.style.regions import memberships
from fprf.style.restyle import apply_dictionary
from fprf.training.loading import open_run
from fprf.training.prepare import read_scene
from fprf.training.run import view_names

from .halves import METHODS, Judged, half_reference, judge_pair, report_halves


@dataclass(frozen=True, kw_only=True)
class WildConfig:
    """Captures in the wild: the left half of a photograph restyles the scene, the right half judges it."""

    runs: tuple[Path, ...] = ()
    """Trained runs."""
    split: str = "test"
    """Photographs: test (held out), train, all."""
    longest: int = 320
    """Longer side of the views in pixels."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Of the codes' clusters."""
    output: Path | None = None
    """JSON file for the figures; none = only the tables."""
    sheet: Path | None = None
    """Picture of all pairs by every method; none = none."""
    device: str = "auto"
    """cpu, cuda, mps, or auto."""

    def __post_init__(self) -> None:
        at_least("longest", self.longest, 64)
        at_least("seeds", len(self.seeds), 1)


@torch.inference_mode()
def judge_run(root: Path, config: WildConfig, folder: Path) -> list[Judged]:
    """All photographs of the split. `folder` takes the references' files.

    Raises DataError where the photographs at hand are not those of the run.
    """
    opened = open_run(root, config.device)
    scene = opened.scene
    known = opened.known
    trained = opened.run.load_config()[0]
    captured = at_origin(read_scene(replace(trained, downscale=1)), known.facts.origin)
    if tuple(view_names(captured.paths)) != known.names:
        raise DataError(f"{root}: the photographs of {trained.data} are not those of the run")
    longest = captured.cameras.size.amax(1, keepdim=True).double()
    cameras = captured.cameras.scaled((longest / config.longest).clamp_min(1))
    encoders = scene.encoders()
    judged = []
    for view in known.views(config.split):
        width, height = (int(side) for side in cameras.size[view])
        light = torch.from_numpy(load_image(captured.paths[view], (width, height))).float() / 255
        seen = scene.cached(cameras, view)
        plain = seen.restyled().rgb
        pixels = pixel_grid(cameras, view)
        belongs = memberships(scene, encoders.scene_style, cameras, view, pixels)[0]
        for seed in config.seeds:
            dictionary = half_reference(light, encoders, folder, seed=seed)
            styled = {}
            for name, (stylizer, bold) in METHODS.items():
                style = StyleConfig(references=(folder / "half.png",), stylizer=stylizer, bold=bold)
                look = apply_dictionary(scene, StyleFile(style), encoders, dictionary).restyle
                styled[name] = seen.restyled(look).rgb
            rows, pictures = judge_pair(plain, light, styled, belongs.view(height, width, -1))
            judged.append(Judged(root.name, root.name, known.names[view], seed, rows, pictures))
    return judged


def main(argv: list[str]) -> int:
    """`python -m benchmarks wild --runs RUN [RUN ...]`."""
    config = parse(WildConfig(), argv, prog="python -m benchmarks wild", description=__doc__ or "")
    if not config.runs:
        print("wild: skipped, no run is named; train one on photographs in several lights")
        return 0
    judged: list[Judged] = []
    with tempfile.TemporaryDirectory(prefix="fprf-wild-") as made:
        for root in config.runs:
            judged += judge_run(root, config, Path(made))
    settings = {
        "runs": [root.name for root in config.runs],
        "split": config.split,
        "longest": config.longest,
        "seeds": list(config.seeds),
    }
    report_halves("wild", judged, settings, config.output, config.sheet)
    return 0
