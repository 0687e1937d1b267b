import json
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_world import World

from fprf.errors import DataError
from fprf.evaluation.peer import read_cameras, read_depths, read_pictures
from fprf.rendering.cameras import pixel_grid, project, rays_through
from fprf.town.write import read_truth


def test_a_scene_folder_is_read_as_its_parser_reads_it(world: World) -> None:
    frames = read_pictures(world.town / "images")
    cameras = read_cameras(world.town / "transforms.json", frames)
    known = world.load().known.cameras
    assert frames.names == world.load().known.names and len(frames.images) == 10
    for field in ("pose", "focal", "centre", "size"):
        assert torch.allclose(getattr(cameras, field).double(), getattr(known, field).double())
    depths = read_depths(world.town / "depth", frames.names, cameras, "ray")
    assert torch.equal(depths[3].float(), torch.from_numpy(read_truth(world.town, 3)[0]))


def test_frames_of_another_size_have_cameras_of_that_size(world: World, tmp_path: Path) -> None:
    from fprf.io.images import write_image

    for k in (2, 5):
        write_image(tmp_path / f"{k:04d}.png", np.zeros((48, 64, 3), dtype=np.uint8))
    cameras = read_cameras(world.town / "transforms.json", read_pictures(tmp_path))
    known = world.load().known.cameras
    assert torch.allclose(cameras.focal, 2 * known.focal[[2, 5]]) and torch.equal(cameras.pose, known.pose[[2, 5]])
    assert cameras.size.tolist() == [[64, 48]] * 2


def test_depths_along_the_axis_become_distances(world: World, tmp_path: Path) -> None:
    frames = read_pictures(world.town / "images", ["0001"])
    cameras = read_cameras(world.town / "transforms.json", frames)
    np.save(tmp_path / "0001.npy", np.full((24, 32), 5.0))
    (depth,) = read_depths(tmp_path, ["0001"], cameras, "axis")
    pixel = pixel_grid(cameras, 0)
    view = torch.zeros(len(pixel), dtype=torch.int64)
    origin, direction = rays_through(cameras, view, pixel)
    _, ahead = project(cameras, view, origin + direction * depth.flatten()[:, None])
    assert torch.allclose(ahead, torch.full_like(ahead, 5.0))


def test_what_does_not_fit_is_named(world: World, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no pictures"):
        read_pictures(tmp_path)
    with pytest.raises(DataError, match="no picture named 77"):
        read_pictures(world.town / "images", ["77"])
    frames = read_pictures(world.town / "images")
    known = json.loads((world.town / "transforms.json").read_text())
    file = tmp_path / "transforms.json"
    file.write_text(json.dumps({**known, "frames": known["frames"][:4]}))
    with pytest.raises(DataError, match="cameras for 4 of 10 frames"):
        read_cameras(file, frames)
    file.write_text(json.dumps({**known, "k1": 0.1}))
    with pytest.raises(DataError, match="k1 is not 0"):
        read_cameras(file, frames)
    file.write_text(json.dumps({key: value for key, value in known.items() if not key.startswith("fl_")}))
    with pytest.raises(DataError, match="no fl_x"):
        read_cameras(file, frames)
    cameras = read_cameras(world.town / "transforms.json", frames)
    with pytest.raises(DataError, match=r"neither 0000\.npz nor 0000\.npy"):
        read_depths(tmp_path, frames.names, cameras, "ray")
    np.save(tmp_path / "0000.npy", np.zeros((3, 3)))
    with pytest.raises(DataError, match="24 rows of 32"):
        read_depths(tmp_path, frames.names[:1], cameras, "ray")


def test_entries_are_found_by_place_where_no_name_agrees(world: World, tmp_path: Path) -> None:
    from fprf.io.images import write_image

    for k in range(10):
        write_image(tmp_path / f"frame_{k}.png", np.zeros((24, 32, 3), dtype=np.uint8))
    cameras = read_cameras(world.town / "transforms.json", read_pictures(tmp_path))
    assert torch.equal(cameras.pose, world.load().known.cameras.pose)
