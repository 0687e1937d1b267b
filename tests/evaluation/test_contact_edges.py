"""Contact sheets of any pictures, and frames whose files are not what they should be."""

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny_world import World

from fprf.errors import DataError
from fprf.evaluation.peer import read_cameras, read_depths, read_pictures
from fprf.evaluation.report import commit, contact_sheet, provenance, words
from fprf.io.images import write_image


@settings(max_examples=25, deadline=None)
@given(
    st.lists(st.lists(st.tuples(st.integers(1, 30), st.integers(1, 40)), max_size=4), min_size=1, max_size=3),
    st.integers(1, 30),
)
def test_every_picture_is_on_the_sheet(sizes: list[list[tuple[int, int]]], height: int) -> None:
    rows = {f"row {k}": [torch.zeros(h, w, 3) for h, w in row] for k, row in enumerate(sizes)}
    columns = [f"{k}" for k in range(max(map(len, sizes)))]
    page = contact_sheet(rows, columns, height=height)
    assert page.shape[0] == 18 + len(rows) * (height + 3) and page.dtype == np.uint8
    left = 62
    for column in range(len(columns)):
        widths = [max(1, round(row[column][1] * height / row[column][0])) if column < len(row) else 0 for row in sizes]
        for k, width in enumerate(widths):
            top = 18 + k * (height + 3)
            assert (page[top : top + height, left : left + width] == 0).all(), "black, where the picture lies"
        left += max(widths) + 3
    assert page.shape[1] == left


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


def test_distances_along_the_ray_are_the_longer_ones(world: World, tmp_path: Path) -> None:
    frames = read_pictures(world.town / "images", ["0003"])
    cameras = read_cameras(world.town / "transforms.json", frames)
    np.save(tmp_path / "0003.npy", np.full((24, 32), 2.0))
    axis, ray = (read_depths(tmp_path, ["0003"], cameras, along)[0] for along in ("axis", "ray"))  # type: ignore[arg-type]
    assert torch.equal(ray, torch.full_like(ray, 2.0)) and bool((axis >= ray - 1e-9).all())
    assert float(axis[12, 16]) == pytest.approx(2.0, rel=1e-2) and float(axis[0, 0]) > 2.05


def test_a_file_that_is_no_array_is_named(world: World, tmp_path: Path) -> None:
    frames = read_pictures(world.town / "images", ["0001"])
    cameras = read_cameras(world.town / "transforms.json", frames)
    (tmp_path / "0001.npz").write_bytes(b"nothing of the kind")
    with pytest.raises(DataError, match=r"0001\.npz"):
        read_depths(tmp_path, frames.names, cameras, "ray")


def test_pictures_come_by_name_and_others_are_no_frames(tmp_path: Path) -> None:
    for name, level in (("b", 200), ("a", 100)):
        write_image(tmp_path / f"{name}.png", np.full((12, 16, 3), level, dtype=np.uint8))
    (tmp_path / "notes.txt").write_text("not a picture")
    frames = read_pictures(tmp_path)
    assert frames.names == ("a", "b") and float(frames.images[0].mean()) == pytest.approx(100 / 255)
    assert read_pictures(tmp_path, ["b"]).names == ("b",)


def test_provenance_says_nothing_of_the_time_or_the_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    first = provenance("cpu")
    monkeypatch.chdir(tmp_path)
    assert provenance("cpu") == first and str(tmp_path) not in words(first)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert commit(Path(__file__).parent) is None, "without git nothing is known"
    assert provenance("cpu")["commit"] is None
