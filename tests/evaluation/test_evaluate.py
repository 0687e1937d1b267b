"""Metrics of held-out views, and poses that are fitted for judging."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tiny_world import World

from fprf.datamanagers.images import load_image
from fprf.evaluation.metrics import image_metrics, judge
from fprf.io.images import to_uint8, write_image
from fprf.training import views
from fprf.training.camera_optimizers import moved_cameras, rotated
from fprf.training.views import render_view


def test_metrics_are_those_of_the_renders(world: World) -> None:
    trained, scene = world.load(), world.prepared.scene
    told: list[tuple[int, int, str]] = []
    metrics, images = judge(trained, trained.known, scene, trained.known.test, lambda *of: told.append(of))
    assert [of[:2] for of in told] == [(0, 2), (1, 2), (2, 2)]
    assert len(images) == metrics["views"] == 2 and metrics["per_view"].keys() == {"0000", "0008"}
    for view, image in zip(trained.known.test, images, strict=True):
        again = render_view(trained.model, trained.known.facts, trained.known.cameras, view, trained.config.render)
        assert (to_uint8(again.rgb) == image).all()
        truth = torch.from_numpy(load_image(scene.paths[view], (32, 24))).float() / 255
        assert metrics["per_view"][scene.paths[view].stem] == image_metrics(again.rgb, truth)
    assert metrics["psnr"] == pytest.approx(sum(v["psnr"] for v in metrics["per_view"].values()) / 2)
    assert metrics["rays_per_second"] == pytest.approx(2 * 24 * 32 / metrics["render_seconds"])
    assert metrics["seconds_per_view"] == pytest.approx(metrics["render_seconds"] / 2)
    assert 0 < metrics["lpips"] < 2
    assert metrics["consistency"]["pairs"] == 1 and 0 < metrics["kept_samples_share"] <= 1


def test_a_turned_view_comes_back(world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
    monkeypatch.setattr(views, "FIT_STEPS", 60)
    moves = wrong.fit_poses(replace(world.prepared.scene, paths=tuple(paths)), [view], lambda *of: None)
    found = replace(wrong, known=replace(wrong.known, cameras=moved_cameras(wrong.known.cameras, moves)))

    def error(run: object) -> float:
        known = run.known  # type: ignore[attr-defined]
        return float((render_view(trained.model, known.facts, known.cameras, view, config).rgb - truth).square().mean())

    assert error(found) < 0.5 * error(wrong)
    others = [k for k in range(len(pose)) if k != view]
    assert torch.equal(found.known.cameras.pose[others], pose[others])
    assert all(torch.equal(t, before[name]) for name, t in trained.model.state_dict().items())
