import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tiny_world import World, stage_of

from fprf.errors import DataError, UsageError
from fprf.evaluation.metrics import psnr
from fprf.evaluation.town_truth import town_settings, true_views
from fprf.town.write import read_truth


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
    for rendered, photograph in zip(true_views(stage, "day"), photographs, strict=True):
        assert psnr(rendered, photograph) > 60
    night, day = true_views(stage, "night"), true_views(stage, "day")
    assert float(night[0].mean()) < 0.5 * float(day[0].mean())


def test_smaller_views_are_the_same_views(world: World) -> None:
    small = stage_of(world.load(), views=1, frames=8, longest=16)
    assert [v.restyled().rgb.shape for v in small.shown] == [(12, 16, 3)]
    assert small.truth[0].labels.shape == (12, 16)


def test_runs_of_other_scenes_are_refused(world: World, tmp_path: Path) -> None:
    folder = tmp_path / "copy"
    shutil.copytree(world.town, folder)
    trained = world.load()
    moved = replace(trained, config=replace(trained.config, data=folder))
    assert town_settings(moved.config) == town_settings(trained.config)
    (folder / "town.json").write_text(json.dumps({"settings": {"seed": 1}}))
    with pytest.raises(DataError, match=r"town\.json"):
        town_settings(moved.config)
    (folder / "town.json").unlink()
    with pytest.raises(UsageError, match="whose looks in other light nobody knows"):
        town_settings(moved.config)
