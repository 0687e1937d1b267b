"""Poses that are fitted for judging: a view that is given turned comes back; the scene is not touched."""

from dataclasses import replace
from pathlib import Path

import torch
from tiny_world import World

from fprf.evaluation.evaluate import AlignmentConfig, align, align_view
from fprf.io.images import to_uint8, write_image
from fprf.training.camera_optimizers import rotated
from fprf.training.views import render_view


def test_a_turned_view_comes_back(world: World, tmp_path: Path) -> None:
    """Its image is what the scene looks like from where it was; the fit starts a little beside."""
    trained = world.load()
    view = trained.known.test[0]
    cameras, config = trained.known.cameras, trained.config.render
    truth = render_view(trained.model, trained.known.facts, cameras, view, config).rgb
    write_image(tmp_path / "truth.png", to_uint8(truth))
    paths = list(world.prepared.scene.paths)
    paths[view] = tmp_path / "truth.png"
    pose = cameras.pose.clone()
    turn = torch.tensor([[0.0, 0.0, 0.03]], dtype=torch.float64)
    for axis in range(3):
        pose[view, :, axis] = rotated(pose[view, :, axis][None], turn)[0]
    wrong = replace(trained, known=replace(trained.known, cameras=replace(cameras, pose=pose)))
    before = {name: t.clone() for name, t in trained.model.state_dict().items()}
    found, moves = align(wrong, replace(world.prepared.scene, paths=tuple(paths)), [view], config=AlignmentConfig(steps=60))
    assert list(moves) == [view] and moves[view].shape == (6,)

    def error(run: object) -> float:
        known = run.known  # type: ignore[attr-defined]
        return float((render_view(trained.model, known.facts, known.cameras, view, config).rgb - truth).square().mean())

    assert error(found) < 0.5 * error(wrong)
    others = [k for k in range(len(pose)) if k != view]
    assert torch.equal(found.known.cameras.pose[others], pose[others])
    assert all(torch.equal(t, before[name]) for name, t in trained.model.state_dict().items())


def test_a_fit_is_a_function_of_its_input_and_looks_at_nothing_that_is_masked(world: World) -> None:
    trained = world.load()
    view, cameras = trained.known.test[0], trained.known.cameras
    truth = world.prepared.manager.image(view)
    where = torch.zeros(truth.shape[:2], dtype=torch.bool)
    where[:, :16] = True
    config = AlignmentConfig(steps=3, rays=64)
    spoilt = torch.where(where[..., None], truth, torch.rand(truth.shape, generator=torch.Generator().manual_seed(0)))
    first, second = (align_view(trained, cameras, view, image, 1.0, config, where) for image in (truth, spoilt))
    assert torch.equal(first, second) and float(first.abs().max()) > 0
    assert not torch.equal(first, align_view(trained, cameras, view, truth, 1.0, config))
