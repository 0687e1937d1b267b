"""Contact sheets of any pictures, and frames whose files are not what they should be."""

from pathlib import Path

import numpy as np
from tiny_world import World

from fprf.evaluation.peer import read_cameras, read_depths, read_pictures


def test_depths_are_found_packed_or_plain(world: World, tmp_path: Path) -> None:
    frames = read_pictures(world.town / "images", ["0001", "0002"])
    cameras = read_cameras(world.town / "transforms.json", frames)
    first, second = (np.random.default_rng(k).uniform(1, 9, (24, 32)) for k in range(2))
    np.savez(tmp_path / "0001.npz", depth=first)
    np.save(tmp_path / "0002.npy", second)
    found = read_depths(tmp_path, frames.names, cameras, "ray")
    for depth, written in zip(found, (first, second), strict=True):
        np.testing.assert_allclose(depth.numpy(), written)
    np.save(tmp_path / "0001.npy", second)
    assert np.allclose(read_depths(tmp_path, frames.names, cameras, "ray")[0].numpy(), first), "the packed one counts"
