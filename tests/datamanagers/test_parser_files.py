"""What a scene folder's files may say, and what they may not; poses made exact, sizes and numbers checked."""

import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from capture_files import rotations
from hypothesis import given
from hypothesis import strategies as st

from fprf.datamanagers.parsers.files import path_inside, read_npz
from fprf.datamanagers.parsers.views import rigid_pose
from fprf.errors import DataError


def test_paths_stay_inside_and_are_normalised() -> None:
    for text in (
        "/etc/passwd", "../a.png", "images/../../a.png", "..", "a\\..\\..\\b", "C:\\a.png", "/roots/a.png",
        "\\\\host\\share\\a.png", "", ".", "images/..", "a\0b", "a\nb", "a\x1b[2Jb", "\ud800", "\u2028",
    ):  # fmt: skip
        with pytest.raises(DataError, match="here: the path"):
            path_inside(Path("root"), "here", text)
    for text in ("images/a b.png", "./images/a b.png", "images//a b.png", ".\\images\\a b.png", "x/../images/a b.png"):
        assert path_inside(Path("root"), "here", text) == ("images/a b.png", Path("root/images/a b.png"))


@pytest.mark.parametrize("field", [20, 24])
def test_an_archive_that_claims_more_than_the_file_holds_takes_no_memory(tmp_path: Path, field: int) -> None:
    """Packed and unpacked size stand in the directory at its end; a gigabyte is allowed for an array."""
    path = tmp_path / "a.npz"
    np.savez(path, xyz=np.arange(9.0))
    data = path.read_bytes()
    head = data.rfind(b"PK\x01\x02")
    path.write_bytes(data[: head + field] + struct.pack("<I", 1 << 30) + data[head + field + 4 :])
    tracemalloc.start()
    try:
        with pytest.raises(DataError, match=r"claims .* bytes, but the file has 3"):
            read_npz(path, "xyz")
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
    finally:
        tracemalloc.stop()


@given(st.integers(0, 999), st.floats(0, 4e-4))
def test_rounded_rotations_are_repaired(seed: int, amount: float) -> None:
    draw = np.random.default_rng(seed)
    exact = np.concatenate([rotations(draw.normal(size=(1, 3)))[0], draw.normal(size=(3, 1))], 1)
    noisy = exact.copy()
    noisy[:, :3] += amount * draw.uniform(-0.5, 0.5, (3, 3))
    repaired = rigid_pose("here", noisy)
    assert np.abs(repaired[:, :3].T @ repaired[:, :3] - np.eye(3)).max() < 1e-14
    assert np.abs(repaired - exact).max() <= 2 * amount + 1e-14
    assert np.array_equal(repaired[:, 3], exact[:, 3])
