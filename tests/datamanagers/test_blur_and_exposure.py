"""Blurred photographs, found beside sharp ones of the same place; exposures from EXIF."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from tiny_world import World
from torch import Tensor

from fprf.datamanagers.images import Image
from fprf.datamanagers.scene import GAMMA, ParsedScene, exposures_differ, find_sightings, with_exposure
from fprf.rendering.cameras import Cameras, ideal_cameras
from fprf.splats.blur import blurred_views, detail

VIEWS = 12
SIDE = 128


def photographs() -> dict[int, Image]:
    """Leaves at all scales, cut from one picture: each view sees another part."""
    draw = np.random.default_rng(0)
    picture = sum(
        cv2.resize(draw.normal(size=(s, s, 3)).astype(np.float32), (256, 256), interpolation=cv2.INTER_CUBIC)
        for s in (8, 16, 32, 64, 128, 256)
    )
    grey = np.clip(128 + 30 * np.asarray(picture), 0, 255).astype(np.uint8)
    return {view: grey[8 * view : 8 * view + SIDE, 4 * view : 4 * view + SIDE] for view in range(VIEWS)}


def beside(views: int, turned: Sequence[int] = ()) -> Cameras:
    """Cameras in a row that look along -z; those that are turned look along z, from far off."""
    pose = torch.eye(3, 4, dtype=torch.float64).repeat(views, 1, 1)
    pose[:, 0, 3] = torch.arange(views) / views
    for view in turned:
        pose[view, :, 0], pose[view, :, 2] = -pose[view, :, 0], -pose[view, :, 2]
    return ideal_cameras(pose, 100.0, (SIDE, SIDE))


@pytest.mark.parametrize("width", [5, 9, 15])
def test_moved_photographs_are_found_and_no_others(width: int) -> None:
    images = photographs()
    for view in (0, 5, 11):
        images[view] = cv2.blur(images[view], (width, 1))
    found = blurred_views(beside(VIEWS), images, 2)
    assert found[0] == {0, 5, 11}
    assert found[1] <= {0, 5, 11} and (found[1] or width == 5)


def test_blur_that_a_scale_does_not_show_is_none_there() -> None:
    images = photographs()
    images[3] = cv2.GaussianBlur(images[3], (0, 0), 0.9)
    found = blurred_views(beside(VIEWS), images, 3)
    assert found[0] == {3} and found[2] == frozenset()


def test_nothing_is_blurred_where_all_are_alike() -> None:
    images = photographs()
    assert blurred_views(beside(VIEWS), images, 2) == (frozenset(), frozenset())
    soft = {view: np.asarray(cv2.blur(image, (9, 9))) for view, image in images.items()}
    assert blurred_views(beside(VIEWS), soft, 2) == (frozenset(), frozenset())


def test_a_softer_camera_elsewhere_is_compared_with_itself() -> None:
    images = photographs()
    far = {VIEWS + view: np.asarray(cv2.blur(image, (9, 9))) for view, image in images.items()}
    cameras = beside(2 * VIEWS, turned=list(far))
    assert blurred_views(cameras, images | far, 1) == (frozenset(),)


def test_too_few_or_empty_photographs_are_not_judged() -> None:
    images = photographs()
    images[1] = np.zeros_like(images[1])
    assert np.isnan(detail(images[1], 2)).all()
    assert blurred_views(beside(VIEWS), images, 1) == (frozenset(),)
    pair = {0: images[0], 2: np.asarray(cv2.blur(images[2], (9, 9)))}
    assert blurred_views(beside(VIEWS), pair, 1) == (frozenset(),)
    tiny = {view: image[:9, :9] for view, image in photographs().items()}
    assert blurred_views(beside(VIEWS), tiny, 3) == (frozenset(),) * 3


TOWN_VIEWS = 10


def capture(world: World, gain: Tensor, wrong: float = 0.0) -> tuple[ParsedScene, Callable[[int], Tensor]]:
    """The tiny town at 512 x 384, every point in any view that may see it; points painted as bright as `gain`
    says.

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


def errors(scene: ParsedScene, image: Callable[[int], Tensor], gain: Tensor) -> Tensor:
    """What is measured less what it should be, both relative to the training views."""
    exposure = with_exposure(scene, image).exposure
    assert exposure is not None
    return GAMMA * exposure.log() - (gain - gain[scene.train].mean())


@pytest.mark.parametrize("wrong", [0.0, 0.1])
def test_what_views_were_multiplied_by_is_found(world: World, wrong: float) -> None:
    gain = 0.3 * torch.randn(TOWN_VIEWS, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    scene, image = capture(world, gain, wrong)
    assert errors(scene, image, gain)[scene.train].abs().max() <= 0.02
    assert exposures_differ(with_exposure(scene, image).exposure)


def test_held_out_views_are_like_their_neighbours_where_neighbours_are_alike(world: World) -> None:
    light = torch.linspace(-0.5, 0.5, TOWN_VIEWS, dtype=torch.float64)
    scene, image = capture(world, light)
    assert errors(scene, image, light)[scene.test].abs().max() <= 0.2
    collection = 0.5 * (-1.0) ** torch.arange(TOWN_VIEWS, dtype=torch.float64)
    scene, image = capture(world, collection)
    assert errors(scene, image, torch.zeros(TOWN_VIEWS))[scene.test].abs().max() <= 1e-7


def test_nothing_is_known_without_shared_points(world: World) -> None:
    """None at all, or each seen by one view."""
    scene, image = capture(world, torch.zeros(TOWN_VIEWS))
    bare = replace(scene, points=None)
    assert with_exposure(bare, image) is bare and not exposures_differ(bare.exposure)
    alone = replace(scene, seen=world.prepared.scene.seen)
    assert with_exposure(alone, image).exposure is None
