"""Blurred photographs: found beside sharp ones of the same place, at the scales at which they are blurred, and nowhere else."""

from collections.abc import Sequence

import cv2
import numpy as np
import pytest
import torch

from fprf.datamanagers.blur import blurred_views, detail
from fprf.datamanagers.images import Image
from fprf.rendering.cameras import Cameras, ideal_cameras

VIEWS, SIDE = 12, 128


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
