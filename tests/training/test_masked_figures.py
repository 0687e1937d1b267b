"""PSNR of masked captures counts the pixels that are used: in training, of fields and Gaussians, and in `fprf eval`."""

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from gsplat_stand_in import stand_in
from tiny_world import World, events, prepared_for, taught

from fprf.cli import main as cli
from fprf.config import TrainConfig
from fprf.datamanagers.images import load_image
from fprf.datamanagers.parsers.config import parse_scene
from fprf.datamanagers.scene import ParsedScene
from fprf.ops.rasterise.gsplat import GsplatGaussians
from fprf.splats.config import GaussiansConfig
from fprf.splats.gaussians import Gaussians
from fprf.splats.learner import GaussianLearner
from fprf.splats.setup import build
from fprf.training.run import Run

SHARE = 0.5
STEPS = 12


def spoilt(town: Path, folder: Path, *, value: int) -> ParsedScene:
    """The town with a mask of the left half of each view, whose right half has one value."""
    shutil.copytree(town, folder)
    for path in (folder / "images").iterdir():
        pixels = cv2.imread(str(path))
        half = int(SHARE * pixels.shape[1])
        pixels[:, half:] = value
        mask = np.zeros(pixels.shape[:2], np.uint8)
        mask[:, :half] = 255
        (folder / "masks").mkdir(exist_ok=True)
        assert cv2.imwrite(str(path), pixels) and cv2.imwrite(
            str(folder / "masks" / f"{path.name}.png"), mask
        )
    return parse_scene(folder, 1, None)


def learner_of(scene: ParsedScene, start: Gaussians | None = None, *, gsplat: bool) -> GaussianLearner:
    """Gaussians that learn by L1 alone, at the full size: nothing but the used pixels moves them."""
    config = GaussiansConfig(
        initial=200, cap=200, surroundings=0, ssim=0.0, coarse=0.0, tones=False, degree=1
    )
    learner = build(config, scene)
    assert isinstance(learner, GaussianLearner)
    if start is not None:
        learner.start_from(start)
    if gsplat:
        model = GsplatGaussians(700, learner.bands, torch.device("cpu"))
        model.start(learner.model.read())
        learner.model = model
    return learner


@pytest.mark.parametrize("gsplat", [False, True])
def test_figures_of_gaussians_count_used_pixels_alone(world: World, tmp_path: Path, gsplat: bool) -> None:
    found = []
    start = None
    with stand_in():
        for value in (0, 255):
            scene = spoilt(world.town, tmp_path / str(value), value=value)
            learner = learner_of(scene, start, gsplat=gsplat)
            start = learner.gaussians()
            for step in range(STEPS):
                learner.step(step, step / STEPS)
            found.append(learner.figures().means)
    black, white = found
    assert white["rgb"] == pytest.approx(black["rgb"], rel=1e-4)
    assert white["l1"] == pytest.approx(black["l1"], rel=1e-4)


@pytest.mark.parametrize("gsplat", [False, True])
def test_a_view_of_which_nothing_counts_leaves_the_figures(
    world: World, tmp_path: Path, gsplat: bool
) -> None:
    scene = spoilt(world.town, tmp_path / "town", value=9)
    for path in scene.masks[1:3]:
        assert path is not None and cv2.imwrite(str(path), np.zeros((24, 32), np.uint8))
    with stand_in():
        learner = learner_of(scene, gsplat=gsplat)
        for step in range(STEPS):
            learner.step(step, step / STEPS)
    figures = learner.figures()
    assert figures.skipped == 0 and all(math.isfinite(value) for value in figures.means.values())


def test_the_psnr_of_a_training_of_gaussians_is_that_of_used_pixels(world: World, tmp_path: Path) -> None:
    """White where nothing is used, and dark there in the scene: the PSNR of all pixels would be far lower."""
    spoilt(world.town, tmp_path / "town", value=255)
    flags = ["--initial", "300", "--cap", "600", "--steps", "200", "--device", "cpu", "--downscale", "1"]
    words = [
        "train",
        "fprf-splats",
        "--data",
        str(tmp_path / "town"),
        "--output",
        str(tmp_path / "run"),
        *flags,
    ]
    assert cli.main(words) == 0
    told = events(Run(tmp_path / "run"), "psnr")[-1]["psnr"]
    assert (
        cli.main(["eval", str(tmp_path / "run"), "--device", "cpu", "--split", "train", "--images", "false"])
        == 0
    )
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["psnr"] == pytest.approx(told, abs=1.0)
    assert cli.main(["eval", str(tmp_path / "run"), "--device", "cpu"]) == 0
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert metrics["used_share"] == pytest.approx(SHARE)
    assert {row["used_share"] for row in metrics["per_view"].values()} == {SHARE}
    # The photograph and the render of a held-out view, where the mask is white.
    name = next(iter(metrics["per_view"]))
    render = load_image(tmp_path / "run" / "renders" / "test" / f"{name}.png")[:, :16] / 255.0
    truth = load_image(tmp_path / "town" / "images" / f"{name}.png")[:, :16] / 255.0
    own = -10 * math.log10(float(np.square(render - truth).mean()))
    assert metrics["per_view"][name]["psnr"] == pytest.approx(own, abs=0.05)


def test_the_psnr_of_a_training_of_fields_is_that_of_used_pixels(world: World, tmp_path: Path) -> None:
    """A batch holds no pixel that is left out, so its error doesn't depend on their colours."""
    told = []
    for value in (0, 255):
        spoilt(world.town, tmp_path / str(value), value=value)
        loss = replace(world.config.loss, content=0.0, semantic=0.0)
        config: TrainConfig = replace(world.config, data=tmp_path / str(value), steps=5, loss=loss)
        run = Run(tmp_path / f"run{value}")
        run.root.mkdir()
        figures: list[float] = []
        taught(config, prepared_for(config), run, lambda event, figures=figures: figures.append(event.psnr))  # type: ignore[misc]
        told.append(figures[-1])
    assert told[0] == pytest.approx(told[1], abs=1e-3)
