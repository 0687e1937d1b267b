import torch
from tiny_world import World, stage_of

from fprf.evaluation.metrics import psnr
from fprf.evaluation.town_truth import true_views
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
