import pytest
import torch
from tiny_world import World

from fprf.datamanagers.images import load_image
from fprf.errors import DataError
from fprf.evaluation.evaluate import judge
from fprf.evaluation.metrics import image_metrics
from fprf.training.views import render_view


def test_metrics_are_those_of_the_renders(world: World) -> None:
    trained, scene = world.load(), world.prepared.scene
    told: list[tuple[int, int, str]] = []
    metrics, renders = judge(trained, scene, trained.known.test, lambda *of: told.append(of))
    assert [of[:2] for of in told] == [(0, 2), (1, 2), (2, 2)]
    assert len(renders) == metrics["views"] == 2 and metrics["per_view"].keys() == {"0000", "0008"}
    for view, render in zip(trained.known.test, renders, strict=True):
        again = render_view(trained.model, trained.known.facts, trained.known.cameras, view, trained.config.render)
        assert torch.equal(again.rgb, render.rgb)
        truth = torch.from_numpy(load_image(scene.paths[view], (32, 24))).float() / 255
        assert metrics["per_view"][scene.paths[view].stem] == image_metrics(render.rgb, truth)
    assert metrics["psnr"] == pytest.approx(sum(v["psnr"] for v in metrics["per_view"].values()) / 2)
    assert metrics["rays_per_second"] == pytest.approx(2 * 24 * 32 / metrics["render_seconds"])
    assert metrics["seconds_per_view"] == pytest.approx(metrics["render_seconds"] / 2)
    assert (metrics["train_steps"], metrics["train_seconds"]) == (15, trained.seconds) and metrics["lpips"] is None
    assert metrics["consistency"]["pairs"] == 1 and 0 < metrics["kept_samples_share"] <= 1


def test_no_views_is_told(world: World) -> None:
    with pytest.raises(DataError, match="no views"):
        judge(world.load(), world.prepared.scene, (), lambda *of: None)
