"""Poses that are refined with a scene of Gaussians where a trial finds them off."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from learning import stepped
from splat_ball import equal
from torch import Tensor

from fprf.datamanagers.scene import ParsedScene
from fprf.ops.rasterise.training import Target
from fprf.splats.config import GaussiansConfig
from fprf.splats.learner import GaussianLearner, refined
from fprf.splats.pose_trial import left_out_blocks, trial_gain
from fprf.splats.setup import build
from fprf.training.camera_optimizers import moved_cameras
from fprf.training.checkpoint import Saved


@pytest.fixture(scope="module")
def learned(config: GaussiansConfig, scene: ParsedScene) -> GaussianLearner:
    return stepped(build(replace(config, poses=0.0), scene))


def gain(learned: GaussianLearner, targets: list[Target], reach: float) -> float:
    return trial_gain(
        learned.model, targets, [None] * len(targets), background=(0.0, 0.0, 0.0), ssim=0.2, reach=reach
    )


def test_only_poses_that_are_off_gain(learned: GaussianLearner, scene: ParsedScene) -> None:
    views = scene.train.tolist()[:3]
    right = [learned.levels[0][view] for view in views]
    turn = 0.06 * torch.nn.functional.normalize(torch.randn(3, 3, generator=torch.manual_seed(0)).double())
    off = []
    for target, each in zip(right, turn, strict=True):
        cameras = torch.from_numpy(target.axes)
        turned = torch.linalg.matrix_exp(skew(each)) @ cameras.T
        off.append(target.seen_from(turned.T.numpy(), target.centre))
    before = learned.gaussians()
    assert gain(learned, off, 20.0) > 0.5 > 0 > gain(learned, right, 20.0)
    assert equal(learned.gaussians(), before)


def skew(x: Tensor) -> Tensor:
    one, two, three = x.tolist()
    return torch.tensor([[0, -three, two], [three, 0, -one], [-two, one, 0]], dtype=torch.float64)


@pytest.mark.parametrize("size", [(64, 48), (70, 41)])
def test_a_quarter_of_the_pixels_is_left_out(size: tuple[int, int]) -> None:
    mask = left_out_blocks(*size)
    assert mask.shape == size[::-1] and 0.15 < mask.mean() <= 0.25


def test_left_out_pixels_do_not_count(learned: GaussianLearner, scene: ParsedScene) -> None:
    target = learned.levels[0][int(scene.train[0])]
    mask = left_out_blocks(target.width, target.height)
    rates = np.zeros(learned.model.rows, np.float32)
    found = []
    for part in (mask, ~mask, np.ones_like(mask)):
        limited = target.limited_to(part)
        found.append(learned.model.learn(limited, background=(0.0, 0.0, 0.0), ssim=0.2, rates=rates))
    shares = np.array([mask.mean(), 1 - mask.mean()])
    whole = shares @ np.array([found[0].squared, found[1].squared])
    assert whole == pytest.approx(found[2].squared, rel=1e-4)
    apart = found[0].of_camera + found[1].of_camera - found[2].of_camera
    assert np.abs(apart).max() < 1e-4 * np.abs(found[2].of_camera).max()


def test_few_views_are_never_tried_and_learn_as_if_poses_were_given(
    config: GaussiansConfig, scene: ParsedScene
) -> None:
    few = replace(scene, train=scene.train[:3])
    tried = stepped(build(config, few), 0, 120)
    given = stepped(build(replace(config, poses=0.0), few), 0, 120)
    assert equal(tried.gaussians(), given.gaussians())
    state = tried.state()
    saved = Saved(120, 0.0, state.model, state.optimizer)
    assert refined(few.cameras, few.train.tolist(), tried.facts, saved) is few.cameras


def test_it_goes_on_bit_for_bit_before_and_after_the_trial(
    config: GaussiansConfig, scene: ParsedScene
) -> None:
    moves = torch.zeros(len(scene.paths), 6, dtype=torch.float64)
    moves[scene.train, :3] = 0.05 * torch.randn(len(scene.train), 3, generator=torch.manual_seed(1)).double()
    off = replace(scene, cameras=moved_cameras(scene.cameras, moves))
    sharp = replace(config, coarse=0.0)  # blocks that are left out are larger than half of the town's views
    whole = stepped(build(sharp, off), 0, 120)
    assert whole.corrections.poses is not None
    for at in (60, 100):
        again = build(sharp, off)
        again.load(stepped(build(sharp, off), 0, at).state())
        stepped(again, at, 120)
        assert equal(again.gaussians(), whole.gaussians()) and again.corrections.choice == 1
        assert again.corrections.said() == whole.corrections.said() != ""
        assert torch.equal(again.state().optimizer["poses.moves"], whole.state().optimizer["poses.moves"])
    assert bool(whole.corrections.poses.moved_by().any())
