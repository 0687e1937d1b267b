"""Exposures measured from points that several views see."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from tiny_world import World
from torch import Tensor

from fprf.datamanagers.scene import GAMMA, Scene, exposures_differ, find_sightings, with_exposure

VIEWS = 10


def capture(world: World, gain: Tensor, wrong: float = 0.0) -> tuple[Scene, Callable[[int], Tensor]]:
    """The tiny town at 512 x 384, every point in any view that may see it; points painted as bright as `gain` says.

    Of the sightings a share is `wrong`: something else is there.
    """
    scene = replace(world.prepared.scene, cameras=world.prepared.scene.cameras.scaled(1 / 16), seen=None)
    found = find_sightings(scene)
    assert found is not None
    draw = torch.Generator().manual_seed(0)
    point = torch.unique(found.point, dim=0, return_inverse=True)[1]
    own = torch.empty(int(point.max()) + 1, dtype=torch.float64).uniform_(-2.0, -1.0, generator=draw)
    value = (own[point] + gain[found.view]).exp()
    other = torch.empty(len(value), dtype=torch.float64).uniform_(0.05, 0.9, generator=draw)
    value = torch.where(torch.rand(len(value), generator=draw) < wrong, other, value)

    def image(view: int) -> Tensor:
        width, height = scene.cameras.size[view].tolist()
        assert view in scene.train.tolist(), "held-out views are not looked at"
        painted = torch.zeros(height, width, 3, dtype=torch.float64)
        at = found.view == view
        x, y = found.pixel[at].long().unbind(1)
        painted[y, x] = value[at][:, None]
        return painted

    return scene, image


def errors(scene: Scene, image: Callable[[int], Tensor], gain: Tensor) -> Tensor:
    """What is measured less what it should be, both relative to the training views."""
    exposure = with_exposure(scene, image).exposure
    assert exposure is not None
    return GAMMA * exposure.log() - (gain - gain[scene.train].mean())


@pytest.mark.parametrize("wrong", [0.0, 0.1])
def test_what_views_were_multiplied_by_is_found(world: World, wrong: float) -> None:
    gain = 0.3 * torch.randn(VIEWS, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    scene, image = capture(world, gain, wrong)
    assert errors(scene, image, gain)[scene.train].abs().max() <= 0.02
    assert exposures_differ(with_exposure(scene, image).exposure)


def test_held_out_views_are_like_their_neighbours_where_neighbours_are_alike(world: World) -> None:
    light = torch.linspace(-0.5, 0.5, VIEWS, dtype=torch.float64)
    scene, image = capture(world, light)
    assert errors(scene, image, light)[scene.test].abs().max() <= 0.2
    collection = 0.5 * (-1.0) ** torch.arange(VIEWS, dtype=torch.float64)
    scene, image = capture(world, collection)
    assert errors(scene, image, torch.zeros(VIEWS))[scene.test].abs().max() <= 1e-7


def test_nothing_is_known_without_shared_points(world: World) -> None:
    """None at all, or each seen by one view."""
    scene, image = capture(world, torch.zeros(VIEWS))
    bare = replace(scene, points=None)
    assert with_exposure(bare, image) is bare and not exposures_differ(bare.exposure)
    alone = replace(scene, seen=world.prepared.scene.seen)
    assert with_exposure(alone, image).exposure is None
