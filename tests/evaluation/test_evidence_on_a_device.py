"""What `fprf bench restyle` and `bench paper` measure, on the pretended device: the CPU's, bit for bit, in plain torch."""

from pathlib import Path
from typing import Any

import pytest
import torch
from pretend_cuda import CUDA, pretend_cuda
from tiny_world import World

from benchmarks.paper_styles import Case, PaperConfig, _by_view, cell_dictionary, set_up
from fprf.cli import main as cli
from fprf.datamanagers.images import load_image
from fprf.evaluation.restyle import dictionary_of, in_scene, nothing, one_by_one
from fprf.evaluation.town_truth import Reference, code_classes
from fprf.ops import backend
from fprf.plugins.stylizers.config import LocalAdainConfig, RegionToneConfig
from fprf.training.loading import load_run


def measured(world: World, device: str, folder: Path) -> list[Any]:
    """Pictures and matches of every way to restyle, and whose class codes are."""
    trained = load_run(world.run, device)
    encoders = trained.encoders()
    bench = set_up(trained, encoders, PaperConfig(table="time", views=1), folder)
    paths, tone = world.references[:1], RegionToneConfig()
    dictionary = dictionary_of(paths, encoders, clusters=3, blend=0.1)[0]
    image = torch.from_numpy(load_image(paths[0])).float() / 255
    shown = Reference(paths[0].name, image, torch.arange(image[..., 0].numel()).view(image.shape[:2]) % 3)
    plain = nothing(bench.stage.shown).pictures
    case = Case("night", [shown], list(paths), dictionary, 0.0)
    found = [
        in_scene(trained, bench.stage.shown, LocalAdainConfig(), dictionary, encoders, paths),
        one_by_one(trained, plain, tone, dictionary, encoders),
        _by_view(bench, tone)(case),
    ]
    cells = cell_dictionary({shown.name: image}, trained, encoders)
    classes = code_classes(dictionary, {shown.name: shown}, encoders, trained.config.datamanager.guided)
    return [*plain, *(x for each in found for x in (*each.pictures, *(each.taken or []))), *cells[:6], *cells[8:10], classes]


def test_ways_to_restyle(world: World, tmp_path: Path) -> None:
    with backend.plain():
        expected = measured(world, "cpu", tmp_path)
    with pretend_cuda() as seen:
        found = measured(world, str(CUDA), tmp_path)
    assert seen.uploads and len(found) == len(expected)
    assert all(a.device.type == "cpu" and torch.equal(a, b) for a, b in zip(found, expected, strict=True))


PAPER = ["--steps", "2", "--views", "1", "--palettes", "night"]
BENCHES = {
    "restyle": ["--palettes", "night", "--views", "1", "--longest", "24", "--clusters", "4"],
    "paper": ["--table", "large-scale", *PAPER],
    "paper statistics": ["--table", "statistics", *PAPER],
    "speed": ["--repeats", "2", "--rays", "64"],
    "pareto": ["--repeats", "2", "--rays", "64"],
}


@pytest.mark.slow
@pytest.mark.parametrize("name", BENCHES)
def test_a_bench(world: World, tmp_path: Path, name: str) -> None:
    run = ["--data", str(world.town), "--run", str(world.run)] if name.startswith("paper") else [str(world.run)]
    args = [
        "bench",
        name.split()[0],
        *run,
        *BENCHES[name],
        "--device",
        str(CUDA),
        "--output",
        str(tmp_path / "a.json"),
        "--debug",
    ]
    with pretend_cuda() as seen:
        assert cli.main(args) == 0
    assert seen.uploads and (tmp_path / "a.json").is_file()
