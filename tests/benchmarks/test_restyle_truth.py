"""Styles against the town in that light: the stage, scores against definitions, methods, the verdict, the verb."""

import json
from pathlib import Path

import cv2
import pytest
import torch
from tiny_world import World, stage_of

from benchmarks.__main__ import main
from benchmarks.restyle import (
    BOUND,
    FLAT,
    GLOBAL,
    GOALS,
    MATCHED,
    PLAIN,
    STYLIZERS,
)
from benchmarks.town.truth import (
    true_views,
)
from benchmarks.town.write import read_truth
from fprf.evaluation.metrics import psnr


def test_the_truth_is_the_town_itself(world: World) -> None:
    stage = stage_of(world.load(), views=2, frames=8, longest=32)
    assert stage.settings.seed == 0 and stage.settings.palette == "day"
    assert len(stage.shown) == len(stage.truth) == 2 and len(stage.passed) == len(stage.path_truth) == 8
    held_out = world.load().known.test
    for truth, view in zip(stage.truth, held_out, strict=False):
        depth, labels = read_truth(world.town, view)
        assert torch.equal(truth.labels, torch.from_numpy(labels.astype("int64")))
        assert torch.allclose(truth.depth, torch.from_numpy(depth))
    photographs = [world.prepared.manager.image(view) for view in held_out[:2]]
    for rendered, taken in zip(true_views(stage, "day"), photographs, strict=True):
        assert psnr(rendered, taken) > 60
    night, day = true_views(stage, "night"), true_views(stage, "day")
    assert float(night[0].mean()) < 0.5 * float(day[0].mean())


SMALL = ["--palettes", "night", "--views", "1", "--longest", "24", "--clusters", "4", "--device", "cpu"]
UNMATCHED = {PLAIN, *GLOBAL, MATCHED, BOUND}
METHODS = {*UNMATCHED, FLAT, *STYLIZERS, "nearest-code"}


def test_every_method_is_in_the_table(world: World, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page, sheet = tmp_path / "docs/page.md", tmp_path / "docs/sheets/all.png"
    files = ["--output", str(tmp_path / "a.json"), "--page", str(page), "--sheet", str(sheet)]
    assert main(["restyle", str(world.run), *SMALL, *files]) == 0
    document = json.loads((tmp_path / "a.json").read_text())
    assert set(document["means"]) == {"one", "three"}
    found = document["palettes"]["night"]["three"]
    assert set(found["rows"]) == METHODS and set(found["delta_e_by_class"]) == METHODS
    for name, row in found["rows"].items():
        assert 0 < row["psnr"] < 99 and -1 <= row["ssim"] <= 1 and row["delta_e"] > 0
        assert (row["match"] is not None) == (name not in UNMATCHED)
        assert (row["consistency"] is None) == (name in (MATCHED, BOUND))
    assert found["rows"]["no change"]["consistency"] == 0
    assert document["recommended"] == "region-tone" and document["means"]["three"]["no change"]["lpips"] > 0
    assert set(document["verdict"]["goals"]) == set(document["verdict"]["met"]) == set(GOALS)
    # A map that knows the truth is nearer to it than doing nothing, whatever the scene.
    assert found["rows"][BOUND]["psnr"] > found["rows"]["no change"]["psnr"]
    assert document["provenance"]["torch"] and document["settings"]["town_seed"] == 0
    text = page.read_text()
    assert "](sheets/all.png)" in text and all(name in text for name in METHODS)
    assert cv2.imread(str(sheet)) is not None
    assert "region-tone" in capsys.readouterr().out
