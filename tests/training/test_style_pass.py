from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tiny_world import World

from fprf.config import TrainConfig
from fprf.rendering.cameras import ideal_cameras, rays_through
from fprf.rendering.renderer import march
from fprf.style.scene_style import SceneStyle, from_tensors
from fprf.training.run import Run
from fprf.training.style_pass import lattice, measure_style

SIZES = st.lists(st.tuples(st.integers(1, 9), st.integers(1, 9)), min_size=1, max_size=5)


@given(SIZES, st.integers(1, 400), st.data())
def test_the_lattice_covers_every_view_by_its_share(sizes: list[tuple[int, int]], rays: int, data: st.DataObject) -> None:
    poses = torch.eye(3, 4, dtype=torch.float64).repeat(len(sizes), 1, 1)
    cameras = replace(ideal_cameras(poses, 90.0, (1, 1)), size=torch.tensor(sizes))
    views = torch.tensor(data.draw(st.lists(st.integers(0, len(sizes) - 1), min_size=1, max_size=5, unique=True)))
    view, pixel = lattice(cameras, views, rays)
    area = cameras.size[views].prod(-1)
    count = min(rays, int(area.sum()))
    assert len(view) == len(pixel) == count
    low, high = pixel - 0.5, cameras.size[view] - pixel - 0.5
    assert bool((low >= 0).all()) and bool((high >= 0).all()) and bool((low == low.round()).all())
    assert len({(int(v), *p) for v, p in zip(view, pixel.tolist(), strict=True)}) == count, "no pixel twice"
    for one, pixels in zip(views.tolist(), area.tolist(), strict=True):
        assert abs(int((view == one).sum()) - count * pixels / int(area.sum())) <= 1


def measured(world: World, config: TrainConfig) -> SceneStyle:
    scene = world.prepared.scene
    return measure_style(config, world.load().model, scene.cameras, scene.train)


def test_statistics_do_not_depend_on_the_chunk(world: World) -> None:
    whole, small = (
        measured(world, replace(world.config, render=replace(world.config.render, chunk=chunk))) for chunk in (4096, 97)
    )
    torch.testing.assert_close(whole, small, rtol=1e-4, atol=1e-5)


def test_statistics_are_those_of_the_kept_samples(world: World) -> None:
    trained, scene = world.load(), world.prepared.scene
    style = measured(world, world.config)
    view, pixel = lattice(scene.cameras, scene.train, world.config.statistics.rays)
    with torch.inference_mode():
        rays = trained.model.space.rays(*rays_through(scene.cameras, view, pixel))
        kept = march(rays, trained.model.parts, budget=world.config.render.budget).kept
        content = trained.model.field.content(kept.latent, kept.view).double()
        share = (kept.weight.double() / kept.weight.double().sum())[:, None]
    mean = (content * share).sum(0)
    covariance = (content - mean).T @ ((content - mean) * share)
    assert torch.allclose(style.mean.double(), mean, rtol=1e-5, atol=1e-6)
    assert torch.allclose(style.covariance.double(), covariance, rtol=1e-4, atol=1e-6)


def test_regions_share_out_the_scene(world: World) -> None:
    style, saved = measured(world, world.config), from_tensors(Run(world.run).load_tensors("style"))
    assert 1 <= len(style.share) <= world.config.statistics.regions
    assert float(style.share.sum()) == pytest.approx(1, abs=1e-5)
    assert all(torch.equal(a, b) for a, b in zip(style, saved, strict=True))
    assert torch.allclose(style.contacts, style.contacts.T) and 0 < float(style.contacts.sum()) < 1
    one = measured(world, replace(world.config, statistics=replace(world.config.statistics, regions=1)))
    assert len(one.share) == 1 and torch.allclose(one.mean, style.mean)
