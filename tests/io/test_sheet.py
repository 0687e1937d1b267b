from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fprf.errors import DataError
from fprf.io.sheet import seam_positions, side_by_side, wipe
from fprf.io.video import missing_frames


def picture(height: int = 20, width: int = 30) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)


def flat(value: int, width: int = 40, height: int = 6) -> np.ndarray:
    return np.full((height, width, 3), value, np.uint8)


def test_beside_keeps_every_pixel() -> None:
    whole = side_by_side([flat(10), flat(20, 30), flat(30, 5)])
    assert whole.shape == (6, 40 + 2 + 30 + 2 + 5, 3)
    assert (whole[:, :40] == 10).all() and (whole[:, 42:72] == 20).all() and (whole[:, 74:] == 30).all()
    assert (whole[:, 40:42] == 255).all() and np.array_equal(side_by_side([flat(7)]), flat(7))
    with pytest.raises(DataError, match="heights"):
        side_by_side([flat(1), flat(2, height=7)])


@settings(deadline=None)
@given(st.integers(1, 6), st.floats(0, 1))
def test_seams_are_in_order_and_inside(count: int, at: float) -> None:
    found = seam_positions(count, at)
    assert len(found) == count - 1 and found == sorted(found)
    assert all(0 < seam < 1 for seam in found)


def test_strips_show_their_pictures() -> None:
    whole = wipe([flat(10), flat(20)], 0.0)
    assert whole.shape == (6, 40, 3)
    assert (whole[:, :19] == 10).all() and (whole[:, 19:21] == 255).all() and (whole[:, 21:] == 20).all()
    assert (wipe([flat(10), flat(20)], 0.25)[:, :29] == 10).all()
    assert np.array_equal(wipe([flat(3)], 0.3), flat(3))
    with pytest.raises(DataError, match="shapes"):
        wipe([flat(1), flat(2, 41)], 0)


def test_missing_frames_are_those_not_there(tmp_path: Path) -> None:
    paths = [tmp_path / f"{k}.png" for k in range(3)]
    assert missing_frames(tmp_path, "a", paths) == paths
    paths[1].write_bytes(b"x")
    (tmp_path / "mine.txt").write_text("stays")
    assert missing_frames(tmp_path, "a", paths) == [paths[0], paths[2]]
    assert missing_frames(tmp_path, "b", paths) == paths and not paths[1].exists() and (tmp_path / "mine.txt").is_file()
    (tmp_path / ".render.json").write_text("damaged")
    assert missing_frames(tmp_path, "b", paths) == paths
