import numpy as np
import pytest
import torch
from tiny_world import World

from fprf.rendering.space import Space
from fprf.types import Boxes
from fprf.viewer.cameras import Stage, stage_of
from fprf.viewer.lines import box_lines, camera_lines, path_lines


def test_pyramids_stand_where_the_cameras_are_and_look_their_way(world: World) -> None:
    cameras = world.load().known.cameras
    stage = stage_of(cameras)
    lines = camera_lines(stage, cameras, 0.1)
    assert lines.shape == (10 * len(cameras), 2, 3) and lines.dtype == np.float32
    for view in range(len(cameras)):
        own = lines[10 * view : 10 * view + 10]
        tip = stage.to_page(cameras.pose[view, :, 3]).numpy()
        assert np.allclose(own[:4, 0], tip, atol=1e-5)
        ahead = -cameras.pose[view, :, 2].numpy()
        assert np.allclose((own[:4, 1] - tip) @ ahead, 0.1, atol=1e-5)
        up = cameras.pose[view, :, 1].numpy()
        assert ((own[8, 1] - tip) @ up) > 0 and np.allclose(own[8, 1], own[9, 0])  # the roof


def test_boxes_have_twelve_edges_of_their_own_sides() -> None:
    turn = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64))[0]
    boxes = Boxes(
        torch.tensor([[0.0, 0, 0], [1, 0, 0]], dtype=torch.float64),
        torch.tensor([[1.0, 2, 3], [2, 2, 3]], dtype=torch.float64),
        torch.stack([turn, turn]),
        0.1,
    )
    space = Space(kind="open", centre=(10.0, 20.0, 30.0), rotation=tuple(map(tuple, torch.eye(3).tolist())), scale=2.0,
                  near=0.1, far=10.0)  # fmt: skip
    stage = Stage(torch.tensor([10.0, 20.0, 30.0], dtype=torch.float64), 0.5, (0.0, 0.0, 1.0))
    lines = box_lines(stage, space, boxes)
    assert lines.shape == (24, 2, 3)
    lengths = np.sort(np.linalg.norm(lines[:12, 1] - lines[:12, 0], axis=-1))
    assert np.allclose(lengths, np.repeat([0.25, 0.5, 0.75], 4), atol=1e-5)  # sides over 2 (space) times 0.5 (page)
    corners = lines.reshape(2, 24, 3)
    inside = turn.numpy() @ (corners[0] * 4).T  # back to the space
    assert inside.min() == pytest.approx(0, abs=1e-5) and inside.max(1) == pytest.approx([1, 2, 3], abs=1e-4)
    shared = {tuple(np.round(p, 4)) for p in corners[0]} & {tuple(np.round(p, 4)) for p in corners[1]}
    assert len(shared) == 4  # neighbours share a face


def test_a_path_goes_from_frame_to_frame(world: World) -> None:
    cameras = world.load().known.cameras
    stage = stage_of(cameras)
    lines = path_lines(stage, cameras)
    assert lines.shape == (len(cameras) - 1, 2, 3) and np.array_equal(lines[:-1, 1], lines[1:, 0])
    assert path_lines(stage, cameras.select(torch.tensor([0]))).shape == (0, 2, 3)


def test_pyramids_behind_their_cameras_are_not_seen_from_there(world: World) -> None:
    cameras = world.load().known.cameras
    stage = stage_of(cameras)
    ahead, behind = camera_lines(stage, cameras, 0.1), camera_lines(stage, cameras, 0.1, behind=True)
    assert ahead.shape == behind.shape
    axis = cameras.pose[:, :, 2].repeat_interleave(10, 0).numpy()
    assert np.allclose(behind - ahead, 0.1 * axis[:, None], atol=1e-6)
