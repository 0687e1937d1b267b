import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tiny_world import World

from fprf.errors import DataError, UsageError
from fprf.evaluation.metrics import psnr
from fprf.evaluation.town_truth import set_stage, short_path, town_settings, town_view, true_views
from fprf.town.write import read_truth


def test_the_truth_is_the_town_itself(world: World) -> None:
    stage = set_stage(world.load(), views=2, frames=8, longest=32)
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
    small = set_stage(world.load(), views=1, frames=8, longest=16)
    assert [v.restyled().rgb.shape for v in small.shown] == [(12, 16, 3)]
    assert small.truth[0].labels.shape == (12, 16)


def test_the_path_moves_on_slowly(world: World) -> None:
    start = world.load().known.cameras.select(torch.tensor([3]))
    path = short_path(start, 9)
    assert torch.equal(path.pose[0], start.pose[0]) and len(path) == 9
    steps = (path.pose[1:, :, 3] - path.pose[:-1, :, 3]).norm(dim=1)
    assert torch.allclose(steps, steps[:1].expand(8)) and 0 < float(steps[0]) < 0.5
    assert torch.allclose(path.pose[:, 2, 3], path.pose[:1, 2, 3].expand(9)), "no higher, no lower"
    turned = path.pose[:, :, :3]
    longer = short_path(start, 3, 4.0)
    torch.testing.assert_close(longer.pose, path.pose[::4])
    assert torch.allclose(turned.transpose(1, 2) @ turned, torch.eye(3, dtype=torch.float64).expand(9, 3, 3))


def test_cameras_that_are_none_of_a_town(world: World) -> None:
    cameras = world.load().known.cameras
    view = town_view(cameras, 0)
    assert (view.width, view.height) == (32, 24)
    with pytest.raises(DataError, match="view 0: no centred pinhole"):
        town_view(replace(cameras, centre=cameras.centre + 2), 0)


def test_runs_of_other_scenes_are_refused(world: World, tmp_path: Path) -> None:
    folder = tmp_path / "copy"
    shutil.copytree(world.town, folder)
    trained = world.load()
    moved = replace(trained, config=replace(trained.config, data=folder))
    assert town_settings(moved) == town_settings(trained)
    (folder / "town.json").write_text(json.dumps({"settings": {"seed": 1}}))
    with pytest.raises(DataError, match=r"town\.json"):
        town_settings(moved)
    (folder / "town.json").unlink()
    with pytest.raises(UsageError, match="whose looks in other light nobody knows"):
        town_settings(moved)
